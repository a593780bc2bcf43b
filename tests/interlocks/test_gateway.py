"""`lowfc gateway epics`: its variables, and a real IOC and a scan that drive an interlock and a gain."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import free_ports
from lowfc.adapters.process.service import Service
from lowfc.client import Client, running
from lowfc.client.requests import DECLARED
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import CONTROLLER_STATE, HEALTH, STEP, wire
from lowfc.control.loop.interlocks import Action, Interlock
from lowfc.programs.core.bench_values import BenchValues
from lowfc.programs.gateway.variables import Kind, variables
from lowfc.programs.gateway.watch import Watch
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.loops import interrupt, refusal, started, until

Process = subprocess.Popen[str]
IOC = """
from softioc import asyncio_dispatcher, builder, softioc

builder.SetDeviceName("BENCH:MASK")
builder.boolOut("MOVING", ZNAM="parked", ONAM="moving", initial_value=0)
builder.LoadDatabase()
softioc.iocInit(asyncio_dispatcher.AsyncioDispatcher())
softioc.non_interactive_ioc()
"""
SCAN = """
import json

import bluesky.plan_stubs as bps
import numpy as np
from bluesky import RunEngine
from ophyd_async.core import Array1D, init_devices
from ophyd_async.epics.core import epics_signal_r, epics_signal_rw

engine, rows = RunEngine(), []
with init_devices():
    gain = epics_signal_rw(Array1D[np.float64], "pva://lowfc:gain", name="gain")
    residual = epics_signal_r(float, "pva://lowfc:residual", name="residual")


def scan():
    yield from bps.open_run()
    for value in (0.05, 0.1, 0.2):
        yield from bps.abs_set(gain, np.array([value]), wait=True)
        yield from bps.sleep(1.5)
        yield from bps.create()
        yield from bps.read(residual)
        yield from bps.read(gain)
        yield from bps.save()
    yield from bps.close_run()


def store(kind, document):
    if kind == "event":
        rows.append([document["data"]["residual"], np.asarray(document["data"]["gain"]).tolist()])


engine(scan(), store)
print(json.dumps(rows))
"""
CONFIG = """
[camera]
rate_hz = 200
[gateway]
port = {port}
search = "127.0.0.1:{search_port}"
bench = {{ mask = "BENCH:MASK:MOVING" }}
[[interlocks]]
name = "mask"
value = "moving"
action = "hold"
max_age_s = 2.0
"""


class Text(str):
    """Like a string of p4p: `str()` puts a time before it."""

    def __str__(self) -> str:
        return f"Thu Jan  1 00:00:00 1970 {self!r}"


def test_requests_with_numbers_or_a_text_are_variables_with_unique_names() -> None:
    offered = {variable.name: variable for variable in variables()}
    assert len(offered) == len(list(variables()))
    for request in DECLARED:
        fields = {field for field, _ in request.fields}
        name = request.name if "record" not in request.key else f"record_{request.name}"
        is_simple = fields <= {"modes", "values", "text", "lease_id"} and request.example != ""
        writable = is_simple and name not in ("status", "configuration")
        assert (name in offered and offered[name].put is not None) is writable, name
    loop = Mock()
    for name, value, arguments in (
        ("gain", [0.2], {"values": [0.2]}),
        ("step", [7.0], {"values": [7.0]}),
        ("permit", Text("the mask"), {"text": "the mask"}),
        ("close", True, {}),
    ):
        put = offered[name].put
        assert put is not None
        put(loop, value)
        loop.ask.assert_called_with(name, **arguments)
    assert offered["gain"].kind is Kind.NUMBERS
    assert all(variable.read is not None or variable.put is not None for variable in offered.values())


def test_missing_p4p_is_reported_with_install_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "p4p", None)
    fault = refusal("gateway", "epics", kind=ConfigurationError)
    assert "needs p4p" in fault
    assert "pip install" in fault


class DeafBus(MemoryBus):
    """A bus whose queries time out while it is deaf."""

    deaf = True

    def get(self, key: str, payload: bytes = b"", timeout_s: float = 1.0) -> list[Sample]:
        return [] if self.deaf else super().get(key, payload, timeout_s)


def test_states_that_were_not_received_are_queried_again() -> None:
    hub, clock = MemoryHub(), FakeClock()
    controller, deaf_bus = MemoryBus(hub, "controller", clock), DeafBus(hub, "operator", clock)
    controller.publisher(CONTROLLER_STATE).put(wire.ControllerState(calibration_id="night").SerializeToString())
    watch = Watch(deaf_bus, clock)
    controller.publisher(HEALTH, "controller").put(wire.Health(process="controller", pid=7).SerializeToString())
    watch.update()
    deaf_bus.deaf = False
    assert [watch.update().state.calibration_id for _ in range(2)] == ["", ""], "at most one query in 5 s"
    clock.advance(6_000_000_000)
    assert [watch.update().state.calibration_id for _ in range(2)] == ["", "night"]


def test_a_silent_process_other_than_the_controller_is_left_out() -> None:
    hub, clock = MemoryHub(), FakeClock()
    watch = Watch(MemoryBus(hub, "operator", clock), clock)
    MemoryBus(hub, "recorder", clock).publisher(HEALTH, "recorder").put(wire.Health(pid=7).SerializeToString())
    assert watch.update().processes.keys() == {"recorder"}
    clock.advance(3_000_000_000)
    assert not watch.update().processes


def test_a_value_queried_at_the_start_is_as_old_as_its_publication() -> None:
    hub, clock, report = MemoryHub(), FakeClock(), Mock()
    Client(bus=MemoryBus(hub, "operator", clock)).bench("mask", True)
    clock.advance(9)
    service = Service("controller", "night", clock, MemoryBus(hub, "controller", clock))
    BenchValues(service, [Interlock("mask", "equal", False, Action.HOLD, 5)], report).query()
    assert report.call_args.args[0].age_ns == 9


def test_an_unreadable_step_does_not_replace_the_previous_one() -> None:
    hub, clock = MemoryHub(), FakeClock()
    steps = MemoryBus(hub, "controller", clock).publisher(STEP)
    watch = Watch(MemoryBus(hub, "operator", clock), clock)
    read_error = {one.name: one for one in variables()}["error"].read
    assert read_error is not None
    assert read_error(watch.update(), {}).tolist() == []
    steps.put(wire.ControlStep(mode=wire.LOOP_MODE_CLOSED, error_nm=[1, 2], command_nm=[0, 0]).SerializeToString())
    assert read_error(watch.update(), {}).tolist() == [1, 2]
    steps.put(b"\xff")
    assert read_error(watch.update(), {}).tolist() == [1, 2]
    steps.put(wire.ControlStep(mode=wire.LOOP_MODE_CLOSED, command_nm=[1, 2]).SerializeToString())
    assert read_error(watch.update(), {}).tolist() == []


@pytest.mark.parametrize(
    "damaged",
    [
        wire.ControllerState(channels=[wire.Channel(name="cut", actuators=b"123")]),
        wire.ControllerState(interlocks_acting=[wire.ActingInterlock(number=1)]),
    ],
)
def test_an_unusable_state_does_not_replace_the_previous_one(damaged: wire.ControllerState) -> None:
    hub, clock = MemoryHub(), FakeClock()
    states = MemoryBus(hub, "controller", clock).publisher(CONTROLLER_STATE)
    watch = Watch(MemoryBus(hub, "operator", clock), clock)
    for state in (wire.ControllerState(calibration_id="night"), damaged):
        states.put(state.SerializeToString())
        assert watch.update().state.calibration_id == "night"


@pytest.fixture
def ioc() -> Iterator[tuple[Process, int]]:
    """A running IOC, and the UDP port on which it answers searches."""
    pytest.importorskip("softioc", reason="needs softioc")
    tcp, udp, channel_access = free_ports(3)
    ports = {"EPICS_PVAS_SERVER_PORT": tcp, "EPICS_PVAS_BROADCAST_PORT": udp, "EPICS_CA_SERVER_PORT": channel_access}
    local = dict.fromkeys(("EPICS_PVAS_INTF_ADDR_LIST", "EPICS_CAS_INTF_ADDR_LIST"), "127.0.0.1")
    environment = os.environ | {name: str(port) for name, port in ports.items()} | local
    process = subprocess.Popen([sys.executable, "-c", IOC], env=environment, stdout=subprocess.DEVNULL, text=True)
    yield process, udp
    process.kill()
    process.wait()


@pytest.mark.epics
@pytest.mark.slow
@pytest.mark.exclusive
def test_ioc_drives_an_interlock_and_scan_changes_a_gain(tmp_path: Path, ioc: tuple[Process, int]) -> None:
    pytest.importorskip("ophyd_async", reason="needs ophyd-async")
    process, search_port = ioc
    (port,) = free_ports(1)
    (tmp_path / "bench.toml").write_text(CONFIG.format(port=port, search_port=search_port))
    options = ("--run", "epics", "--config", "bench.toml")
    with started(tmp_path, "sim-loop", *options, "--duration", "600", "--no-record") as loop:
        until(lambda: "epics" in running(), 60)
        with started(tmp_path, "gateway", "epics", *options) as gateway:
            run_scan(loop, gateway, process, f"127.0.0.1:{port + 1} 127.0.0.1:{search_port}")


def run_scan(loop: Process, gateway: Process, ioc: Process, addresses: str) -> None:
    """Drive the interlock, run the scan, then stop the IOC and the loop."""
    thread = pytest.importorskip("p4p.client.thread", reason="needs p4p")
    with thread.Context("pva", conf={"EPICS_PVA_ADDR_LIST": addresses, "EPICS_PVA_AUTO_ADDR_LIST": "NO"}) as pvs:

        def read(name: str) -> Any:
            return pvs.get(f"lowfc:{name}", timeout=30.0)

        until(lambda: read("mode") == "closed" and read("interlocks") == "none of 1 acts")
        assert read("frame").shape == (80, 80)
        assert len(read("error")) == len(read("gain")) == 14
        pvs.put("BENCH:MASK:MOVING", 1)
        until(lambda: read("interlocks") == "mask is 'moving' (hold)")
        until(lambda: "mask is 'moving'" in read("holding"))
        with pytest.raises(thread.RemoteError, match="an interlock acts: mask is 'moving'"):
            pvs.put("lowfc:close", True)
        pvs.put("BENCH:MASK:MOVING", 0)
        until(lambda: read("interlocks") == "none of 1 acts")
        with pytest.raises(thread.RemoteError, match=r"gain refused: .* becomes unstable"):
            pvs.put("lowfc:gain", [9.0])
        environment = os.environ | {"EPICS_PVA_ADDR_LIST": addresses, "EPICS_PVA_AUTO_ADDR_LIST": "NO"}
        scan = subprocess.run(
            [sys.executable, "-c", SCAN], env=environment, capture_output=True, text=True, check=False
        )
        assert scan.returncode == 0, scan.stderr
        rows = json.loads(scan.stdout)
        assert [gains for _, gains in rows] == [pytest.approx([value] * 14) for value in (0.05, 0.1, 0.2)]
        assert all(residual > 0 for residual, _ in rows)
        ioc.kill()
        until(lambda: read("interlocks") == "no value of mask for more than 2 s (hold)")
        interrupt(loop)
        until(lambda: read("mode").severity == 3)
    _, stderr = interrupt(gateway)
    assert gateway.returncode == 0, stderr
    assert "Traceback" not in stderr
