"""Driver processes that hang for 5 s, or die and are restarted as by a service manager."""

import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Client
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import EVENT, FRAME, MIRROR_STATE, STEP, Log, Role, wire
from lowfc.device.camera_loop import PATIENCE_S
from tests.support.loops import LOWFC, STILL, in_background, run, until

DYING = """
import os, time
import numpy as np
from lowfc.device import CameraSettings, Exposure

class Dying:
    def __init__(self, options, config):
        self.number, self.restarted = 0, os.path.exists("died")

    def settings(self):
        return CameraSettings(8, 8, exposure_ns=5_000_000, period_ns=10_000_000)

    def expose(self):
        time.sleep(0.01)
        self.number += 1
        if self.number == 30 and not self.restarted:
            open("died", "w").close()
            os._exit(7)
        return Exposure(np.full((8, 8), self.number, np.uint16), None, self.number)

    def close(self):
        pass
"""


def test_a_restarted_camera_process_publishes_frames_of_a_new_start(tmp_path: Path) -> None:
    (tmp_path / "dying.py").write_text(DYING)
    arguments = ("camera", "dying.py:Dying", "--run", "dying")
    starts: list[int] = []
    with closing(ZenohBus(open_run("dying").links, Role.RECORDER, HostClock())) as bus:
        bus.subscribe(FRAME, lambda sample: starts.append(start_of(sample.sequence)))
        died = subprocess.run([*LOWFC, *arguments], cwd=tmp_path, timeout=60, check=False)
        assert died.returncode == 7, "status 7 is a failure: the units in deploy restart it"
        with in_background(tmp_path, f"lowfc {' '.join(arguments)}"):
            until(lambda: len(set(starts)) == 2)
    assert starts == sorted(starts)


HANGS_S = 5.0
FAULTY = (
    f"HANGS_S = {HANGS_S}"
    + """
import os, time
import numpy as np
from lowfc.contract.errors import LowfcError
from lowfc.device import geometry
from sim_camera.driver import SimulatedCamera

def inject(name):
    if os.path.exists(name):
        fault = open(name).read()
        os.remove(name)
        if fault == "die":
            os._exit(7)
        if fault == "refuse":
            raise LowfcError("its lens cap is on")
        time.sleep(HANGS_S)

class Camera(SimulatedCamera):
    def expose(self):
        inject("camera")
        return super().expose()

class Mirror:
    def __init__(self, options, config):
        self.geometry = geometry(config)
        self.calls = open("calls", "a", buffering=1)

    def apply(self, actuators_nm):
        self.calls.write(f"{np.abs(actuators_nm).max()}\\n")
        inject("mirror")

    def close(self):
        pass
"""
)
ON_BENCH = "--run bench --config bench.toml"
CAMERA, MIRROR = (f"lowfc {kind} faulty.py:{kind.capitalize()} {ON_BENCH}" for kind in ("camera", "mirror"))
CONTROLLER = f"lowfc controller {ON_BENCH}"


class Bench:
    """The messages of a run, and faults injected into its drivers."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.events: list[tuple[str, str]] = []
        self.steps: list[wire.ControlStep] = []
        self.states: list[wire.MirrorState] = []
        self.starts: set[int] = set()

    @contextmanager
    def listening(self) -> Iterator[None]:
        def event(sample: Sample) -> None:
            log = Log.FromString(sample.payload)
            self.events.append((log.name, log.message.partition(" ")[0]))

        with closing(ZenohBus(open_run("bench").links, Role.OPERATOR, HostClock())) as bus:
            bus.subscribe(EVENT, event)
            bus.subscribe(STEP, lambda sample: self.steps.append(wire.ControlStep.FromString(sample.payload)))
            bus.subscribe(MIRROR_STATE, lambda sample: self.states.append(wire.MirrorState.FromString(sample.payload)))
            bus.subscribe(FRAME, lambda sample: self.starts.add(start_of(sample.sequence)))
            yield

    def inject(self, name: str, fault: str) -> None:
        """Let a driver hang or die, and clear the events."""
        self.events.clear()
        (self.folder / "fault").write_text(fault)
        (self.folder / "fault").rename(self.folder / name)  # renamed when complete: the driver must not read it empty
        until(lambda: not (self.folder / name).exists())

    def count_of(self, process: str, event: str) -> int:
        """Number of these events since the last injected fault."""
        return self.events.count((process, event))

    def wait_until_settled(self) -> None:
        """Wait for 50 frames in a row in closed loop without a rejection or limit and with modal errors below 3 nm."""
        self.steps.clear()

        def settled() -> bool:
            newest = self.steps[-50:]
            closed = all(step.mode == wire.LOOP_MODE_CLOSED and not step.reasons for step in newest)
            return len(newest) == 50 and closed and all(max(map(abs, step.error_nm)) < 3 for step in newest)

        until(settled, 60)

    def is_commanded(self, command_nm: list[float]) -> bool:
        """Whether each mode of the last command is within 3 nm, the noise, of this command."""
        return bool(np.allclose(self.steps[-1].command_nm, command_nm, rtol=0, atol=3))

    def calls_nm(self) -> list[float]:
        """Largest magnitude of an actuator in each command that the mirror's driver has received."""
        return [float(line) for line in (self.folder / "calls").read_text().splitlines()]


@pytest.fixture
def folder(tmp_path: Path, own_runtime: Path) -> Path:
    """Folder with the drivers and the configuration."""
    (tmp_path / "faulty.py").write_text(FAULTY)
    (tmp_path / "bench.toml").write_text(STILL)
    return tmp_path


@pytest.fixture
def bench(folder: Path) -> Iterator[Bench]:
    bench = Bench(folder)
    with bench.listening(), in_background(folder, CONTROLLER, CAMERA):
        yield bench


@pytest.mark.slow
@pytest.mark.exclusive
def test_a_camera_hang_of_five_seconds_is_reported_and_the_loop_holds_and_resumes(bench: Bench) -> None:
    with in_background(bench.folder, MIRROR):
        bench.wait_until_settled()
        bench.inject("camera", "hang")
        until(lambda: bench.count_of("camera", "DRIVER_HANGS") and bench.count_of("controller", "NO_FRAMES"))
        until(lambda: bench.count_of("controller", "FRAMES_BACK") and bench.count_of("camera", "DRIVER_BACK"))
        assert bench.count_of("camera", "DRIVER_HANGS") == 1
        bench.wait_until_settled()
    assert len(bench.starts) == 1, "the camera's process has not restarted"


@pytest.mark.slow
@pytest.mark.exclusive
def test_a_mirror_hang_of_five_seconds_blocks_commands_and_the_mirror_goes_flat_before_the_next_command(
    bench: Bench,
) -> None:
    with in_background(bench.folder, MIRROR):
        bench.wait_until_settled()
        bench.inject("mirror", "hang")
        begun_s = time.monotonic()
        until(lambda: bench.count_of("mirror-dm", "DRIVER_HANGS") and bench.count_of("controller", "MIRROR_LOST"))
        before = bench.calls_nm()
        assert min(before[-20:]) > 1, "the mirror has a shape to return from"
        assert (bench.states[-1].actuators, bench.states[-1].status) == (b"", wire.MIRROR_STATUS_EXPIRED)
        until(lambda: list(bench.steps[-1].reasons) == [wire.REASON_NO_MIRROR])
        until(lambda: len(bench.calls_nm()) > len(before))
        assert time.monotonic() - begun_s > 4, "no command arrived while the mirror hung"
        until(lambda: bench.count_of("mirror-dm", "DRIVER_BACK") and bench.count_of("controller", "MIRROR_BACK"))
        repeated_nm, flat_nm = bench.calls_nm()[len(before) :][:2]
        assert (repeated_nm, flat_nm) == (pytest.approx(before[-1], abs=1), 0), "the mirror's last shape, then flat"
        assert bench.count_of("mirror-dm", "DRIVER_HANGS") == bench.count_of("controller", "MIRROR_LOST") == 1
        bench.wait_until_settled()


@pytest.mark.exclusive
def test_a_hanging_camera_in_the_controllers_process_does_not_block_the_controller(folder: Path) -> None:
    bench = Bench(folder)
    controller_with_camera = f"{CONTROLLER} --camera faulty.py:Camera"
    with bench.listening(), in_background(folder, MIRROR, controller_with_camera), ExitStack() as stack:
        bench.wait_until_settled()
        client = stack.enter_context(Client("bench"))
        processes = client.processes()
        assert processes["camera"].pid == processes["controller"].pid
        bench.inject("camera", "hang")
        until(lambda: bench.count_of("camera", "DRIVER_HANGS") and bench.count_of("controller", "NO_FRAMES"))
        client.safe()
        assert client.status().state.mode == wire.LOOP_MODE_SAFE
        ending_s = time.monotonic()
    assert time.monotonic() - ending_s < HANGS_S - PATIENCE_S, "the controller did not wait for its camera"


def test_a_fault_of_the_controllers_camera_gives_an_error_message(folder: Path) -> None:
    (folder / "camera").write_text("refuse")
    refused = run(folder, *CONTROLLER.split()[1:], "--camera", "faulty.py:Camera")
    assert refused.returncode == 2
    assert "error: its lens cap is on" in refused.stderr
    assert "Traceback" not in refused.stderr


@pytest.mark.exclusive
def test_a_dead_mirror_process_is_reported_and_the_loop_holds_until_its_restart(bench: Bench) -> None:
    with subprocess.Popen([*LOWFC, *MIRROR.split()[1:]], cwd=bench.folder) as process:
        try:
            bench.wait_until_settled()
            # After a fault, the controller returns to the command of two Healths before, which must be settled.
            time.sleep(1.2)
            before_nm = list(bench.steps[-1].command_nm)
            bench.inject("mirror", "die")
            assert process.wait(10) == 7, "status 7 is a failure: the units in deploy restart it"
        finally:
            process.kill()
    until(lambda: bench.count_of("controller", "MIRROR_LOST"))
    until(lambda: list(bench.steps[-1].reasons) == [wire.REASON_NO_MIRROR] and bench.is_commanded(before_nm))
    calls = len(bench.calls_nm())
    with in_background(bench.folder, MIRROR):
        until(lambda: bench.count_of("controller", "MIRROR_BACK"))
        assert bench.calls_nm()[calls] == 0, "the mirror goes flat before it follows commands"
        bench.wait_until_settled()
        assert bench.is_commanded(before_nm)
    assert bench.count_of("controller", "MIRROR_LOST") == 1
