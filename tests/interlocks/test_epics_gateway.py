"""`lowfc gateway epics` in this process: what it posts, requests and publishes, with a stand-in for p4p."""

import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Answer, Client
from lowfc.client.bench import bench_message
from lowfc.contract.codecs.bench_codec import decode_bench_value
from lowfc.contract.errors import BusError, RequestRefusedError
from lowfc.contract.messages import BENCH, CONTROLLER_STATE, FRAME, HEALTH, RECORD_KEY, REQUEST_KEY, image, wire
from lowfc.contract.sections import Gateway
from lowfc.programs.gateway import command
from lowfc.programs.gateway.epics import EpicsGateway
from lowfc.programs.gateway.variables import Kind, Put, Variable
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.loops import lowfc

TIMEOUT_S = 5.0
CONFIG = Gateway(prefix="night:", port=5075, bench={"mask": "BENCH:MASK"})


class Variables(dict[str, "Variables.Shared"]):
    """Stand-in for p4p: a server's variables by name, and the monitors of other servers' variables.

    Attributes:
        monitors: callbacks by variable.
        closed: what was closed or stopped, in order.
        conf: configuration of the server.
        busy: whether the port is in use.
    """

    class Shared:
        def __init__(self, nt: Any, initial: Any, handler: Any = None, queue: Any = None, **alarm: Any) -> None:
            self.nt, self.initial, self.handler, self.queue = nt, initial, handler, queue
            if nt == "image":  # an array: its alarm is set by keywords
                self.initial = {f"alarm.{key}": value for key, value in alarm.items()}
            self.posts: list[tuple[Any, int, str]] = []

        def post(self, value: Any, timestamp: float, severity: int, message: str) -> None:
            """All arguments are required here: p4p would keep an omitted one from the previous post."""
            self.posts.append((np.asarray(value).tolist(), severity, message))

    def __init__(self) -> None:
        self.monitors: dict[str, Callable[[Any], None]] = {}
        self.closed: list[str] = []
        self.conf: dict[str, str] = {}
        self.busy = False

    def server(self, providers: list[dict[str, Any]], conf: dict[str, str], useenv: bool) -> SimpleNamespace:
        if self.busy:
            conf = conf | {"EPICS_PVAS_SERVER_PORT": "43017"}
        (offered,) = providers
        self.update(offered)
        self.conf = conf
        return SimpleNamespace(conf=lambda: conf, stop=lambda: self.closed.append("server"))

    def context(self, provider: str, conf: dict[str, str], useenv: bool, nt: bool) -> SimpleNamespace:
        def monitor(name: str, callback: Callable[[Any], None], notify_disconnect: bool) -> SimpleNamespace:
            self.monitors[name] = callback
            return SimpleNamespace(close=lambda: self.closed.append(name))

        return SimpleNamespace(monitor=monitor, close=lambda: self.closed.append("context"))


@pytest.fixture
def pvs(monkeypatch: pytest.MonkeyPatch) -> Variables:
    """Variables of a stand-in for p4p; `import p4p` imports the stand-in."""
    variables = Variables()
    modules = {
        "p4p.client": {},
        "p4p.client.thread": {"Context": variables.context},
        "p4p.nt": {"NTScalar": lambda code, display: code, "NTNDArray": lambda: "image"},
        "p4p.server": {"Server": variables.server},
        "p4p.server.thread": {"SharedPV": variables.Shared},
        "p4p.util": {"ThreadedWorkQueue": lambda maxsize, daemon: SimpleNamespace(start=object)},
    }
    for name, content in {"p4p": {}, **modules}.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)
    return variables


def received(value: Any, kind: str = "epics:nt/NTScalar:1.0", severity: int = 0, **fields: Any) -> Any:
    """An update as p4p passes it to a monitor."""

    class Raw(dict[str, Any]):
        def getID(self) -> str:
            return kind

    return Raw({"value": value, "alarm.severity": severity, **fields})


def choice(index: int, *choices: str) -> Any:
    return received(None, "epics:nt/NTEnum:1.0", **{"value.choices": choices, "value.index": index})


def variable(name: str, kind: Kind, put: Put | None = None) -> Variable:
    return Variable(name, kind, "", name, None, put)


class Operation:
    """A client's put, and its error message: "" if it succeeded."""

    def __init__(self, value: Any) -> None:
        self.value = lambda: value
        self.ended: list[str] = []

    def done(self, error: str = "") -> None:
        self.ended.append(error)


def gateway(offered: tuple[Variable, ...] = (), ask: Callable[[Put, Any], object] = print) -> EpicsGateway:
    return EpicsGateway(CONFIG, offered, ask)


def test_a_variable_is_posted_when_it_changes_and_is_invalid_with_a_fault(pvs: Variables) -> None:
    kinds = {"mode": Kind.TEXT, "rate": Kind.NUMBER, "error": Kind.NUMBERS, "close": Kind.BOOLEAN, "frame": Kind.IMAGE}
    served = gateway(tuple(variable(name, kind) for name, kind in kinds.items()))
    assert served.port == 5075
    assert pvs.conf["EPICS_PVAS_INTF_ADDR_LIST"] == "127.0.0.1"
    assert {name: pv.nt for name, pv in pvs.items()} == {
        "night:mode": "s",
        "night:rate": "d",
        "night:error": "ad",
        "night:close": "?",
        "night:frame": "image",
    }
    alarms = {(pv.initial["alarm.severity"], pv.initial["alarm.message"]) for pv in pvs.values()}
    assert alarms == {(3, "not read yet")}, "a value is invalid before the first update"
    values = {"mode": "closed", "rate": 1000.0, "error": np.array([1.0, 2.0])}
    served.update(values, "")
    served.update(values | {"rate": 999.0, "frame": np.ones((1, 2))}, "")
    served.update({}, "the controller does not answer")
    fault = (3, "the controller does not answer")
    assert {name: pv.posts for name, pv in pvs.items()} == {
        "night:mode": [("closed", 0, ""), ("", *fault)],
        "night:rate": [(1000.0, 0, ""), (999.0, 0, ""), (0.0, *fault)],
        "night:error": [([1.0, 2.0], 0, ""), ([], *fault)],
        "night:close": [(False, 0, ""), (False, *fault)],
        "night:frame": [([[1.0, 1.0]], 0, "")],
    }
    for _ in range(2):
        served.update({"rate": np.nan}, "")
    assert [severity for _, severity, _ in pvs["night:rate"].posts] == [0, 0, 3, 3], "NaN is invalid, and posted once"
    served.close()
    assert pvs.closed == ["BENCH:MASK", "context", "server"]


def test_a_put_is_a_request_and_fails_with_its_refusal(pvs: Variables) -> None:
    asked: list[tuple[Any, Any]] = []

    def ask(put: Put, value: Any) -> None:
        asked.append((put, value))
        if value == [9.0]:
            raise RequestRefusedError("gain refused: unstable")

    def put(loop: Client, value: Any) -> Answer:
        raise AssertionError("only `ask` requests")

    gateway(
        (variable("gain", Kind.NUMBERS, put), variable("close", Kind.BOOLEAN, put), variable("mode", Kind.TEXT)), ask
    )
    assert pvs["night:mode"].handler is None
    assert pvs["night:gain"].queue is not pvs["night:close"].queue, "a put waits for no put to another variable"
    ended = []
    for name, value in (("gain", np.array([0.2])), ("gain", np.array([9.0])), ("close", True), ("close", False)):
        operation = Operation(value)
        pvs[f"night:{name}"].handler.put(pvs[f"night:{name}"], operation)
        ended += operation.ended
    assert asked == [(put, [0.2]), (put, [9.0]), (put, True)], "a display writes False to reset a button"
    assert ended == ["", "gain refused: unstable", "", ""]


@pytest.mark.parametrize(
    ("update", "value"),
    [
        (received(True), True),
        (received(2), 2.0),
        (received("parked"), "parked"),
        (received("x" * 201), None),
        (choice(1, "parked", "moving"), "moving"),
        (choice(2, "parked", "moving"), None),
        (choice(0, "x" * 201), None),
        (received(np.nan), None),
        (received([1, 2]), None),
        (received(2.0, severity=3), None),
        (received({}, "epics:nt/NTTable:1.0"), None),
        (Mock(get=lambda *_: b"\xb0C".decode()), None),  # not UTF-8
        (TimeoutError("disconnected"), None),
    ],
)
def test_a_monitored_variable_is_a_bench_value_while_it_is_valid(update: Any, value: Any, pvs: Variables) -> None:
    served = gateway()
    valid = {} if value is None else {"mask": value}
    for monitored, bench in ((received("before"), {"mask": "before"}), (update, valid)):
        served.changed.clear()
        pvs.monitors["BENCH:MASK"](monitored)
        assert (served.bench, served.changed.is_set()) == (bench, True)
    assert [type(kept) for kept in served.bench.values()] == ([] if value is None else [type(value)])
    assert all(bench_message("mask", kept, 0) for kept in served.bench.values())


def test_a_port_in_use_is_an_error_with_the_address(pvs: Variables) -> None:
    pvs.busy = True
    with pytest.raises(BusError, match=r"127\.0\.0\.1:5075: it is in use"):
        gateway()


@pytest.mark.usefixtures("restored_signals", "own_runtime")
def test_the_command_serves_a_run_until_it_is_stopped(
    pvs: Variables, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fake run restarts once; `safe` is answered while a log still ends; the first frame stops the command."""
    buses: list[MemoryBus] = []
    hub, bench, real_post, log_ended = MemoryHub(), list[Sample](), pvs.Shared.post, threading.Event()
    controller = MemoryBus(hub, "controller", HostClock())
    controller.subscribe(BENCH, bench.append)
    reply = wire.Request(accepted=True).SerializeToString()
    controller.queryable(REQUEST_KEY.format(name="*"), lambda query: query.reply(reply))
    controller.queryable(RECORD_KEY.format(name="*"), lambda query: log_ended.wait(TIMEOUT_S) and query.reply(reply))
    stop, safe = Operation(True), Operation(True)
    states = controller.publisher(CONTROLLER_STATE)
    health, frames = controller.publisher(HEALTH, "controller"), controller.publisher(FRAME)

    def make_bus(links: object, role: str, clock: HostClock, *, monitor: bool) -> MemoryBus:
        assert monitor
        buses.append(MemoryBus(hub, role, clock))
        return buses[-1]

    def watch_and_use(*arguments: Any) -> Any:
        watch = real_watch(*arguments)
        if len(buses) == 1:
            return watch
        puts = [
            threading.Thread(target=pvs[f"lowfc:{name}"].handler.put, args=(None, operation))
            for name, operation in (("record_stop", stop), ("safe", safe))
        ]
        for put in puts:
            put.start()
        puts[1].join(TIMEOUT_S)
        assert (stop.ended, safe.ended) == ([], [""])
        log_ended.set()
        puts[0].join(TIMEOUT_S)
        assert stop.ended == [""]
        states.put(wire.ControllerState(mode=wire.LOOP_MODE_CLOSED).SerializeToString())
        health.put(wire.Health(process="controller", pid=7, rate_hz=250).SerializeToString())
        frames.put(image(np.ones((2, 3), np.uint16), 1, "toy").SerializeToString())
        pvs.monitors["BENCH:MASK"](received(True))
        return watch

    def post(pv: Variables.Shared, value: Any, **more: Any) -> None:
        real_post(pv, value, **more)
        if pv.nt == "image":
            os.kill(os.getpid(), signal.SIGTERM)

    open_run("bench")  # no process listens on its ports: the gateway waits for them
    (tmp_path / "config.toml").write_text('[gateway]\nbench = { mask = "BENCH:MASK" }\n')
    real_watch = command.Watch
    monkeypatch.setattr(command, "Watch", watch_and_use)
    monkeypatch.setattr(pvs.Shared, "post", post)
    monkeypatch.setattr(command, "ZenohBus", make_bus)
    monkeypatch.setattr(
        command,
        "open_run",
        lambda run, _: SimpleNamespace(run_id=run, path=tmp_path, links=None, restarted=lambda: len(buses) == 1),
    )
    done = lowfc("gateway", "epics", "--run", "bench")
    assert done.exit_code == 0, done.output
    assert pvs["lowfc:mode"].posts == [("closed", 0, "")]
    assert pvs["lowfc:rate"].posts == [(250.0, 0, "")]
    assert pvs["lowfc:frame"].posts == [([[1] * 3] * 2, 0, "")]
    assert [(one.key, decode_bench_value(one.payload)) for one in bench] == [("lowfc/bench/mask", True)]
    assert pvs.closed == ["BENCH:MASK", "context", "server"]
