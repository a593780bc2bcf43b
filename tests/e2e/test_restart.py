"""Camera, mirror and controller started by hand: any order, and kill -9 of each."""

import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.files import calibration_file
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Client
from lowfc.contract.configuration import load
from lowfc.contract.errors import RequestRefusedError
from lowfc.contract.messages import MIRROR_STATE, STEP, Role, wire
from tests.support.loops import STILL, until
from tools.law_bench import calibrated

pytestmark = pytest.mark.exclusive

TOML = f"""{STILL}
[mirror]
on_command_timeout = "hold"
"""


class ManualRun:
    """Processes of one run, and what their messages report."""

    def __init__(self, folder: Path) -> None:
        self.run_id = new_run_id()
        self.run = open_run(self.run_id)
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.steps = 0
        self.good_frames = 0
        self.reasons: list[wire.Reason] = []
        self.shapes: list[np.ndarray] = []
        shared = ["--run", self.run_id, "--config", str(folder / "test.toml")]
        self.commands = {
            "camera": ["-m", "sim_camera", *shared],
            "mirror-dm": ["-m", "sim_dm", *shared],
            "controller": ["-m", "lowfc", "controller", *shared, "--calibration", str(folder / "calibration.fits")],
        }
        self.bus = ZenohBus(self.run.links, "operator", HostClock())
        self.bus.subscribe(STEP, self._step)
        self.bus.subscribe(MIRROR_STATE, self._shape)

    def _step(self, sample: Sample) -> None:
        step = wire.ControlStep.FromString(sample.payload)
        self.steps += 1
        self.reasons = list(step.reasons)
        good = step.mode == wire.LOOP_MODE_CLOSED and not step.reasons
        self.good_frames = self.good_frames + 1 if good and np.abs(step.error_nm).max() < 3 else 0

    def _shape(self, sample: Sample) -> None:
        self.shapes.append(np.frombuffer(wire.MirrorState.FromString(sample.payload).actuators, "<f4"))

    def start(self, name: str) -> None:
        self.running[name] = subprocess.Popen([sys.executable, *self.commands[name]], stderr=subprocess.DEVNULL)

    def kill(self, name: str) -> None:
        os.kill(self.running[name].pid, signal.SIGKILL)
        self.running.pop(name).wait()

    def wait_until_settled(self) -> None:
        """Wait for more than 20 consecutive good frames: loop closed, no refusal or limit, error below 3 nm."""
        self.good_frames = 0
        until(lambda: self.good_frames > 20)

    def stop(self) -> None:
        for process in self.running.values():
            process.terminate()
        for process in self.running.values():
            process.wait(10)
        self.bus.close()
        self.run.remove()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("by-hand")
    (path / "test.toml").write_text(TOML)
    config = load(path / "test.toml")
    calibration = calibrated(config)
    calibration_file.save(calibration, path / "calibration.fits")
    return path


ORDERS = list(itertools.permutations(["camera", "controller", "mirror-dm"]))


@pytest.fixture(scope="module", params=[ORDERS[0], *(pytest.param(one, marks=pytest.mark.slow) for one in ORDERS[1:])])
def bench(folder: Path, request: pytest.FixtureRequest) -> Iterator[ManualRun]:
    """A bench started by hand in each possible order; each process is up before the next starts."""
    bench = ManualRun(folder)
    for name in request.param:
        bench.start(name)
        until(lambda: all(bench.bus.get(f"lowfc/health/{process}", timeout_s=0.1) for process in bench.running))
    yield bench
    bench.stop()


def test_the_loop_closes_in_any_start_order(bench: ManualRun) -> None:
    bench.wait_until_settled()


def test_the_loop_recovers_from_kill_and_restart_of_each_process(bench: ManualRun) -> None:
    bench.wait_until_settled()
    for name in ("camera", "controller", "mirror-dm"):
        before = bench.shapes[-1]
        bench.kill(name)
        bench.shapes.clear()
        bench.start(name)
        until(lambda: len(bench.shapes) > 20)
        bench.wait_until_settled()
        shapes = np.array(bench.shapes.copy())
        largest_move_nm = np.abs(np.diff(shapes, axis=0)).max()
        assert largest_move_nm < 100, "no jump beyond the controller's slew limit"
        np.testing.assert_allclose(shapes[-1], before, atol=5)
        if name == "controller":  # the new one starts from the mirror's shape: only noise moves it
            assert np.abs(shapes - before).max() < 12


def test_the_controller_holds_while_the_mirror_is_dead_and_can_close_when_the_mirror_is_back(bench: ManualRun) -> None:
    bench.wait_until_settled()
    before = bench.shapes[-1]
    bench.kill("mirror-dm")
    with Client(bench.run_id) as loop:
        until(lambda: loop.processes()[Role.CONTROLLER].holding == "the mirror does not answer")
        until(lambda: bench.reasons == [wire.REASON_NO_MIRROR])
        loop.ask("open")
        with pytest.raises(RequestRefusedError, match="the mirror does not answer"):
            loop.ask("close")
        bench.start("mirror-dm")
        until(lambda: not loop.ask("status").state.mirror_fault)
        loop.ask("close")
    bench.wait_until_settled()
    np.testing.assert_allclose(bench.shapes[-1], before, atol=5)
