"""A loop whose camera and mirror are ImageStreamIO streams, beside a bench as CACAO has one."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.realtime import spread
from lowfc.client import Client
from lowfc.contract.messages import EVENT, STEP, Log, Role, wire
from tests.support.image_streams.cacao import CAMERA, TOTAL, file_of
from tests.support.image_streams.plain import PlainStream
from tests.support.loops import going_on, loop, run, until

pytestmark = [pytest.mark.exclusive, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
GRID = (34, 34)
CHANNEL = f"{TOTAL}03"
BENCH = """{cpus}
[camera]
rate_hz = {rate_hz}

[disturbance]
preset = "{preset}"
static_nm = {{ "2" = {tilt_nm} }}

[control]
start_mode = "closed"
tilt_gain = 0.5
gain = 0.2

[drivers.isio.camera]
stream = "camnsv"

[drivers.isio.mirror]
stream = "dm00disp03"
"""
MIRROR = "lowfc mirror isio --run bench --config bench.toml"
CAMERA_DRIVER = "lowfc camera isio --run bench --config bench.toml"
CONTROLLER = "lowfc controller --run bench --config bench.toml"
BRIDGE = "lowfc bridge isio --run bench --beside dm00disp03"
LOOP, LOOP_OF_ONE = (CAMERA_DRIVER, CONTROLLER), (f"{CONTROLLER} --camera isio",)
DOCUMENTED = (MIRROR, CAMERA_DRIVER, CONTROLLER, BRIDGE, *LOOP_OF_ONE)
"""Commands of docs/howto/cacao.md; all are run here."""


def bench_of(rate_hz: float, preset: str, tilt_nm: float) -> str:
    """Configuration of a bench; its processes are kept apart as `lowfc sim-loop` does it."""
    cpus = "\n".join(f"{key} = {value}" for key, value in spread(os.sched_getaffinity(0)).items())
    return BENCH.format(cpus=cpus, rate_hz=rate_hz, preset=preset, tilt_nm=tilt_nm)


class Bench:
    """The bench in a folder, its streams, and what the run says."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.events: list[str] = []
        self.errors_nm: list[list[float]] = []
        self.start()

    def start(self) -> None:
        words = [sys.executable, "-m", "tests.support.image_streams.cacao", self.folder / "bench.toml", self.folder]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(words, cwd=ROOT, stdin=pipe, stdout=pipe, text=True)
        until(lambda: file_of(self.folder, CAMERA).exists())

    def tell(self, word: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{word}\n")
        self.process.stdin.flush()

    def stopped(self) -> dict[str, float]:
        figures: dict[str, float] = json.loads(self.process.communicate("stop\n", timeout=60)[0])
        return figures

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()

    def stream(self, name: str) -> PlainStream:
        return PlainStream(file_of(self.folder, name), GRID[1], GRID[0], 9)

    @contextmanager
    def listening(self) -> Iterator[None]:
        def step(sample: Sample) -> None:
            self.errors_nm.append(list(wire.ControlStep.FromString(sample.payload).error_nm))

        with closing(ZenohBus(open_run("bench").links, Role.OPERATOR, HostClock())) as bus:
            bus.subscribe(EVENT, lambda sample: self.events.append(Log.FromString(sample.payload).message))
            bus.subscribe(STEP, step)
            yield

    def said(self, *words: str) -> bool:
        return any(all(word in event for word in words) for event in list(self.events))

    def held(self) -> bool:
        """Whether the last steps say that the loop holds the wavefront."""
        newest = self.errors_nm[-100:]
        return len(newest) == 100 and all(newest) and float(np.linalg.norm(np.mean(newest, axis=0))) < 2.0


@pytest.fixture
def folder(tmp_path: Path, own_runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("loop", [LOOP, LOOP_OF_ONE], ids=["two processes", "one process"])
def test_a_loop_runs_by_streams_beside_others(folder: Path, loop: tuple[str, ...]) -> None:
    (folder / "bench.toml").write_text(bench_of(rate_hz=200, preset="quiet", tilt_nm=15))
    with closing(Bench(folder)) as bench, going_on(folder, MIRROR), bench.listening():
        with going_on(folder, *loop):
            until(bench.held, 60)
            refused = run(folder, "mirror", "isio", "--run", "other", "--config", "bench.toml")
            assert refused.returncode == 2
            assert "writes stream 'dm00disp03'" in refused.stderr
            _what_others_put_on_the_mirror_is_not_undone(bench)
            theirs = bench.stream(f"{TOTAL}00")
        until(lambda: bench.said("COMMAND_EXPIRED") and not bench.stream(CHANNEL).pixels.any())
        assert theirs.pixels.any()


@pytest.mark.parametrize("loop", [LOOP, LOOP_OF_ONE], ids=["two processes", "one process"])
def test_each_fault_of_a_stream_is_named_and_recovered_from(folder: Path, loop: tuple[str, ...]) -> None:
    (folder / "bench.toml").write_text(bench_of(rate_hz=200, preset="quiet", tilt_nm=15))
    with closing(Bench(folder)) as bench, going_on(folder, MIRROR, *loop), bench.listening():
        until(bench.held, 60)
        _a_reader_that_stands_still_goes_on_with_the_newest_image(bench)
        bench.tell("renew")
        until(lambda: bench.said("STREAM_RENEWED", CAMERA))
        until(lambda: bench.said("CAMERA_RESTARTED"))
        bench.errors_nm.clear()
        until(bench.held)
        bench.tell("region")
        until(lambda: bench.said("CAMERA_CHANGED") and bench.said("closed -> open"))
        bench.tell("die")
        until(lambda: bench.said("STREAM_SILENT", "in the middle of an image"))
        until(lambda: bench.said("DRIVER_FAILED", f"'{TOTAL}' has not followed") and bench.said("MIRROR_LOST"))
        bench.process.communicate()
        bench.start()
        until(lambda: bench.said("FRAMES_BACK") and bench.said("DRIVER_BACK") and bench.said("MIRROR_BACK"))
        with Client("bench") as client:
            until(lambda: not client.status().state.mirror_fault)
            client.close_loop()
        bench.errors_nm.clear()
        until(bench.held)


def _a_reader_that_stands_still_goes_on_with_the_newest_image(bench: Bench) -> None:
    stream = PlainStream(file_of(bench.folder, CAMERA), 80, 80, 3)
    with Client("bench") as client:
        pid = client.processes()["camera"].pid
    os.kill(pid, signal.SIGSTOP)
    try:
        until(lambda: min(stream.value(index) for index in range(10)) == 10)
        count = stream.count
        until(lambda: stream.count > count + 5)
    finally:
        os.kill(pid, signal.SIGCONT)
    until(lambda: bench.said("FRAMES_LOST") or bench.said("FRAMES_MISSING"))
    bench.errors_nm.clear()
    until(bench.held)


def _what_others_put_on_the_mirror_is_not_undone(bench: Bench) -> None:
    with going_on(bench.folder, BRIDGE), Client("bench") as client:
        calibration = client.calibration()
        until(lambda: file_of(bench.folder, "lowfc_flux").exists())
        error = PlainStream(file_of(bench.folder, "lowfc_error"), len(calibration.noll), 1, 9)
        until(lambda: error.count > 20)
        dark_hole = np.random.default_rng(3).standard_normal(GRID) * 0.02
        before = bench.stream(CHANNEL).pixels[0].copy()
        bench.stream(f"{TOTAL}00").write(dark_hole)
        until(lambda: any(one.name == "external" for one in client.status().state.channels))
        bench.errors_nm.clear()
        until(bench.held)
        undone = calibration.actuators_to_modes @ (bench.stream(CHANNEL).pixels[0] - before).reshape(-1)
        seen = calibration.actuators_to_modes @ dark_hole.reshape(-1)
        assert np.linalg.norm(undone) < 0.3 * np.linalg.norm(seen)  # noise; without the channel it would be all
        state = client.status().state
        (external,) = (one for one in state.channels if one.name == "external")
        assert np.allclose(np.frombuffer(external.actuators, "f4"), dark_hole.reshape(-1) * 1000, atol=0.01)


def test_a_minute_at_500_hz_loses_nothing_and_is_as_good_as_the_direct_loop(folder: Path) -> None:
    (folder / "bench.toml").write_text(bench_of(rate_hz=500, preset="bench", tilt_nm=0))
    with going_on(folder, CONTROLLER), closing(Bench(folder)) as bench, going_on(folder, MIRROR, CAMERA_DRIVER):
        until(lambda: file_of(folder, CHANNEL).exists() and bench.stream(CHANNEL).count > 100, 60)
        with bench.listening():
            time.sleep(62)
            with Client("bench") as client:
                state = client.status().state
        assert not [event for event in bench.events if "FRAMES" in event and "LATE" not in event]
        assert sum(one.count for one in state.counts) < 0.01 * state.frames_used  # late, where the host stood still
        figures = bench.stopped()
    config = '[disturbance]\npreset = "bench"\n[control]\ntilt_gain = 0.5\ngain = 0.2\n'
    direct = loop(folder, "--no-record", "--rate", "500", "--duration", "60", config=config)
    assert figures["residual_rms_nm"] == pytest.approx(direct["residual_rms_nm"], rel=0.05)
