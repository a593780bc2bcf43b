"""EPICS PV Access, by default on loopback: serve the variables as PVs, read other servers' PVs for interlocks."""

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from lowfc.adapters.process.extras import package_required
from lowfc.contract.errors import BusError, LowfcError, raised_as
from lowfc.contract.sections import Gateway
from lowfc.control.loop.interlocks import MAX_TEXT_LENGTH, Value
from lowfc.programs.gateway.variables import Kind, Put, Variable

_CODES = {Kind.BOOLEAN: "?", Kind.NUMBER: "d", Kind.TEXT: "s", Kind.NUMBERS: "ad"}
_EMPTY: dict[Kind, Any] = {Kind.BOOLEAN: False, Kind.NUMBER: 0.0, Kind.TEXT: "", Kind.NUMBERS: []}
_INVALID = 3
"""Alarm severity of an invalid value."""
_NOT_READ = "not read yet"
CarryOut = Callable[[Put, Any], object]
"""Function that carries out a put; LowfcError if it is refused."""


def protocol() -> Any:
    """The package p4p with the modules used; ConfigurationError if it is not installed."""
    with package_required("lowfc gateway epics needs p4p", "epics"):
        import p4p
        import p4p.client.thread
        import p4p.nt
        import p4p.server.thread
        import p4p.util
    return p4p


class EpicsGateway:
    """Serves variables of the loop as PVs, and monitors PVs of other servers.

    Attributes:
        variables: the served variables.
        bench: valid values of the monitored PVs, by name.
        changed: set by each update of a monitored PV.
    """

    def __init__(self, config: Gateway, variables: Sequence[Variable], carry_out: CarryOut) -> None:
        """Serve; BusError if it cannot listen."""
        p4p = protocol()
        self.variables, self.bench, self.changed = variables, dict[str, Value](), threading.Event()
        self._last: dict[str, Any] = {}
        self._pvs: dict[str, Any] = {}
        for one in variables:
            if one.kind is Kind.IMAGE:
                initial: Any = np.zeros((1, 1), np.uint16)
                self._pvs[one.name] = p4p.server.thread.SharedPV(
                    nt=p4p.nt.NTNDArray(), initial=initial, severity=_INVALID, message=_NOT_READ
                )
                continue
            nt = p4p.nt.NTScalar(_CODES[one.kind], display=True)
            described = {"value": _EMPTY[one.kind], "display.description": one.description, "display.units": one.unit}
            described |= {"alarm.severity": _INVALID, "alarm.message": _NOT_READ}
            handler: dict[str, Any] = {}
            if one.put is not None:  # a thread for each PV: by default p4p has four for all, and `safe` would wait
                handler["queue"] = p4p.util.ThreadedWorkQueue(maxsize=0, daemon=True).start()
                handler["handler"] = _PutHandler(one.kind, one.put, carry_out)
            self._pvs[one.name] = p4p.server.thread.SharedPV(nt=nt, initial=described, **handler)
        address, port = config.listen, config.port
        server_settings = {
            "EPICS_PVAS_INTF_ADDR_LIST": address,
            "EPICS_PVAS_SERVER_PORT": str(port),
            "EPICS_PVAS_BROADCAST_PORT": str(port + 1),
            "EPICS_PVAS_AUTO_BEACON_ADDR_LIST": "NO",
            "EPICS_PVAS_BEACON_ADDR_LIST": address,
        }
        provided = {f"{config.prefix}{name}": pv for name, pv in self._pvs.items()}
        with raised_as(BusError, RuntimeError, f"cannot serve PV Access on {address}:{port}"):
            self._server = p4p.server.Server(providers=[provided], conf=server_settings, useenv=False)
        if self.port != port:  # the port is in use: the library chose another one
            self._server.stop()
            raise BusError(f"cannot serve PV Access on {address}:{port}: it is in use; set another gateway.port")
        client_settings = {"EPICS_PVA_ADDR_LIST": config.search, "EPICS_PVA_AUTO_ADDR_LIST": "NO"}
        # p4p ends a monitor silently if an update cannot be converted: `_value_of` converts instead.
        self._context = p4p.client.thread.Context("pva", conf=client_settings, useenv=False, nt=False)
        self._monitors = [
            self._context.monitor(pv, partial(self._receive, name), notify_disconnect=True)
            for name, pv in config.bench.items()
        ]

    @property
    def port(self) -> int:
        """TCP port of the server."""
        return int(self._server.conf()["EPICS_PVAS_SERVER_PORT"])

    def update(self, values: dict[str, Any], fault: str) -> None:
        """Post a new image and each changed variable; a variable is invalid if there is a `fault`, or if it is NaN."""
        for one in self.variables:
            value = values.get(one.name, _EMPTY.get(one.kind))
            if value is None:
                continue
            pv = self._pvs[one.name]
            if one.kind is Kind.IMAGE:
                pv.post(value, severity=0, message="", timestamp=time.time())
                continue
            why = fault or ("not measured now" if one.kind is Kind.NUMBER and np.isnan(value) else "")
            update = str(np.asarray(value).tolist()), why  # as text, since NaN differs from itself
            if self._last.get(one.name) != update:
                self._last[one.name] = update
                pv.post(value, severity=_INVALID if why else 0, message=why, timestamp=time.time())

    def close(self) -> None:
        """Stop the server and the monitors."""
        for monitor in self._monitors:
            monitor.close()
        self._context.close()
        self._server.stop()

    def _receive(self, name: str, update: Any) -> None:
        value = _value_of(update)
        if value is None:
            self.bench.pop(name, None)
        else:
            self.bench[name] = value
        self.changed.set()


class _PutHandler:
    """Carries out puts to a variable; a refused put fails with the controller's message."""

    def __init__(self, kind: Kind, put: Put, carry_out: CarryOut) -> None:
        self._kind, self._put, self._carry_out = kind, put, carry_out

    def put(self, pv: Any, operation: Any) -> None:
        """Carry out one put, on the variable's own thread."""
        try:
            value = operation.value()
            if self._kind is not Kind.BOOLEAN or value:  # a display writes 0 to reset a button
                self._carry_out(self._put, value.tolist() if isinstance(value, np.ndarray) else value)
        except LowfcError as fault:
            operation.done(error=str(fault))
        else:
            operation.done()


def _value_of(value: Any) -> Value | None:
    """The bench value of a monitor's update; None if disconnected, invalid, too long, not finite or no scalar."""
    plain: Any
    try:
        if value.get("alarm.severity", 0) >= _INVALID:
            return None
        if value.getID().startswith("epics:nt/NTEnum"):
            choices, index = value["value.choices"], value["value.index"]
            plain = str(choices[index]) if 0 <= index < len(choices) else None
        else:
            plain = value["value"]
    except (AttributeError, LookupError, TypeError, ValueError):  # disconnected, a structure, or not UTF-8
        return None
    if isinstance(plain, bool):
        return plain
    if isinstance(plain, str):
        return plain if len(plain) <= MAX_TEXT_LENGTH else None
    return float(plain) if isinstance(plain, int | float) and np.isfinite(plain) else None
