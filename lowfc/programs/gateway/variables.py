"""Process variables of a gateway, independent of its protocol: readings, and writable variables that send requests.

Every request but `status` and `configuration` is offered if it has a `lowfc ctl` command, and needs no value, only
numbers, or one text. It applies to all modes.
"""

from collections.abc import Callable, Iterator
from enum import Enum
from math import nan
from typing import Any, NamedTuple

import numpy as np

from lowfc.client import Answer, Client
from lowfc.client.requests import DECLARED, Declaration
from lowfc.contract.messages import Role, wire
from lowfc.programs.cli.status import interlocks_in_words
from lowfc.programs.gateway.watch import RunView


class Kind(Enum):
    """Type of a variable."""

    BOOLEAN = "boolean"
    NUMBER = "number"
    TEXT = "text"
    NUMBERS = "numbers"
    IMAGE = "image"


Put = Callable[[Client, Any], Answer]


class Variable(NamedTuple):
    """A variable; its name, in lower case, follows the gateway's prefix.

    `read` is None if a request has no reading of the same name, `put` if a reading has no request of the same name.
    """

    name: str
    kind: Kind
    unit: str
    description: str
    read: Callable[[RunView, dict[str, Any]], Any] | None
    put: Put | None = None


def _status(key: str, empty: Any) -> Callable[[RunView, dict[str, Any]], Any]:
    return lambda view, status: empty if status[key] is None else status[key]


def _latency(percentile: str) -> Callable[[RunView, dict[str, Any]], Any]:
    def read(view: RunView, status: dict[str, Any]) -> float:
        latency = view.processes.get(Role.CONTROLLER, wire.Health()).frame_to_command
        return float(getattr(latency, f"{percentile}_ns") * 1e-3) if latency.count else nan

    return read


def _step(field: str) -> Callable[[RunView, dict[str, Any]], Any]:
    def read(view: RunView, status: dict[str, Any]) -> Any:
        values = getattr(view.steps, field)[-1:].ravel().astype(float)
        return values[np.isfinite(values)]  # a refused frame has no error

    return read


READINGS = (
    Variable("mode", Kind.TEXT, "", "Starting, idle, open (also when paused), closed or safe.", _status("mode", "")),
    Variable("verdict", Kind.TEXT, "", "State of the loop in a sentence.", lambda view, _: view.verdict.headline),
    Variable("verdict_level", Kind.TEXT, "", "Level of the verdict.", lambda view, _: view.verdict.level.name.lower()),
    Variable("holding", Kind.TEXT, "", "Why a closed loop holds its command.", _status("holding", "")),
    Variable("interlocks", Kind.TEXT, "", "Interlocks that act.", lambda _, status: interlocks_in_words(status)),
    Variable("reserved_for", Kind.TEXT, "", "Holder of the loop's reservation.", _status("reserved_for", "")),
    Variable("residual", Kind.NUMBER, "nm", "Modal error with noise, rms over 1 s.", _status("residual_rms_nm", nan)),
    Variable("flux", Kind.NUMBER, "", "Flux relative to the calibration.", _status("flux_fraction", nan)),
    Variable("rate", Kind.NUMBER, "Hz", "Frame rate.", _status("rate_hz", 0.0)),
    Variable("frames_missing", Kind.NUMBER, "", "Frames that never arrived.", _status("frames_missing", 0)),
    Variable("latency_p50", Kind.NUMBER, "us", "Frame-to-command latency since the start, p50.", _latency("p50")),
    Variable("latency_p99", Kind.NUMBER, "us", "Frame-to-command latency since the start, p99.", _latency("p99")),
    Variable("latency_max", Kind.NUMBER, "us", "Frame-to-command latency since the start, max.", _latency("max")),
    Variable("law", Kind.TEXT, "", "Control law in use.", lambda _, status: status["law"]["name"]),
    Variable("recording", Kind.TEXT, "", "Recording, stopped, failed or none.", _status("recording", "")),
    Variable("error", Kind.NUMBERS, "nm", "Modal error of the newest frame.", _step("error_nm")),
    Variable("pol", Kind.NUMBERS, "nm", "Pseudo-open-loop modes of the newest frame.", _step("pol_nm")),
    Variable("command", Kind.NUMBERS, "nm", "Modal command.", _step("command_nm")),
    Variable("gain", Kind.NUMBERS, "", "Integrator gain of each mode.", _status("gain", [])),
    Variable("leak", Kind.NUMBERS, "", "Integrator leak of each mode.", _status("leak", [])),
    Variable("limit", Kind.NUMBERS, "nm", "Largest modal command of each mode.", _status("limit_nm", [])),
    Variable("offset", Kind.NUMBERS, "nm", "Offset (target) of each mode.", _status("offset_nm", [])),
    Variable("frame", Kind.IMAGE, "DN", "The newest frame.", lambda view, _: view.frame),
)


def _request(declared: Declaration) -> Variable | None:
    fields, name = {field for field, _ in declared.fields}, declared.name
    has_command, simple = bool(declared.example), fields <= {"modes", "values", "text", "lease_id"}
    if not (has_command and simple) or name in ("status", "configuration"):
        return None
    put: Put
    if declared.key.startswith("lowfc/record/"):
        starts = name == "start"
        name, kind, put = f"record_{name}", Kind.BOOLEAN, lambda loop, value: loop.record(starts)
    elif "text" in fields and "modes" not in fields:  # `gain` has both: its numbers are used
        kind, put = Kind.TEXT, lambda loop, value: loop.ask(declared.name, text=value)
    elif "values" in fields:
        kind, put = Kind.NUMBERS, lambda loop, value: loop.ask(declared.name, values=value)
    else:
        kind, put = Kind.BOOLEAN, lambda loop, value: loop.ask(declared.name)
    return Variable(name, kind, "", declared.description, None, put)


def variables() -> Iterator[Variable]:
    """All variables: readings, writable if a request has the same name, then the other requests."""
    puts = {variable.name: variable for declared in DECLARED if (variable := _request(declared)) is not None}
    for reading in READINGS:
        request = puts.pop(reading.name, None)
        yield reading if request is None else reading._replace(put=request.put)
    yield from puts.values()
