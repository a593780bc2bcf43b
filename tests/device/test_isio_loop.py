"""A loop whose camera and mirror are ImageStreamIO streams, on an emulated CACAO bench."""

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
from tests.support.image_streams.cacao import CAMERA, TOTAL
from tests.support.image_streams.plain import FLOAT32, UINT16, PlainStream, file_of
from tests.support.loops import in_background, loop, run, until

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
TWO_PROCESSES, ONE_PROCESS = (CAMERA_DRIVER, CONTROLLER), (f"{CONTROLLER} --camera isio",)
DOCUMENTED = (MIRROR, CAMERA_DRIVER, CONTROLLER, BRIDGE, *ONE_PROCESS)
"""Commands documented in docs/howto/cacao.md; all are run here."""


def bench_of(rate_hz: float, preset: str, tilt_nm: float) -> str:
    """Configuration of a bench, with processes pinned to processors as by `lowfc sim-loop`."""
    cpus = "\n".join(f"{key} = {value}" for key, value in spread(os.sched_getaffinity(0)).items())
    return BENCH.format(cpus=cpus, rate_hz=rate_hz, preset=preset, tilt_nm=tilt_nm)


class Bench:
    """The emulated bench in a folder, its streams, and the events and errors of the run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.events: list[str] = []
        self.errors_nm: list[list[float]] = []
        self.start()

    def start(self) -> None:
        arguments = [sys.executable, "-m", "tests.support.image_streams.cacao", self.folder / "bench.toml", self.folder]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(arguments, cwd=ROOT, stdin=pipe, stdout=pipe, text=True)
        until(lambda: file_of(self.folder, CAMERA).exists())

    def send(self, request: str) -> None:
        self.process.stdin.write(f"{request}\n")
        self.process.stdin.flush()

    def stop(self) -> dict[str, float]:
        """Stop the bench; return its number of frames and its residual."""
        return json.loads(self.process.communicate("stop\n", timeout=60)[0])

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()

    def stream(self, name: str) -> PlainStream:
        return PlainStream(file_of(self.folder, name), GRID[1], GRID[0], FLOAT32)

    @contextmanager
    def listening(self) -> Iterator[None]:
        def step(sample: Sample) -> None:
            self.errors_nm.append(list(wire.ControlStep.FromString(sample.payload).error_nm))

        with closing(ZenohBus(open_run("bench").links, Role.OPERATOR, HostClock())) as bus:
            bus.subscribe(EVENT, lambda sample: self.events.append(Log.FromString(sample.payload).message))
            bus.subscribe(STEP, step)
            yield

    def has_event(self, *texts: str) -> bool:
        return any(all(text in event for text in texts) for event in list(self.events))

    def converged(self) -> bool:
        """Whether the mean error of the last 100 steps is below 2 nm rms."""
        newest = self.errors_nm[-100:]
        return len(newest) == 100 and all(newest) and float(np.linalg.norm(np.mean(newest, axis=0))) < 2.0


@pytest.fixture
def folder(tmp_path: Path, own_runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("commands", [TWO_PROCESSES, ONE_PROCESS], ids=["two processes", "one process"])
def test_a_loop_runs_on_streams_with_other_mirror_channels(folder: Path, commands: tuple[str, ...]) -> None:
    (folder / "bench.toml").write_text(bench_of(rate_hz=200, preset="quiet", tilt_nm=15))
    with closing(Bench(folder)) as bench, in_background(folder, MIRROR), bench.listening():
        with in_background(folder, *commands):
            until(bench.converged, 60)
            refused = run(folder, "mirror", "isio", "--run", "other", "--config", "bench.toml")
            assert refused.returncode == 2
            assert "writes stream 'dm00disp03'" in refused.stderr
            _other_channels_are_not_undone(bench)
            other_channel = bench.stream(f"{TOTAL}00")
        until(lambda: bench.has_event("COMMAND_EXPIRED") and not bench.stream(CHANNEL).pixels.any())
        assert other_channel.pixels.any()


@pytest.mark.parametrize("commands", [TWO_PROCESSES, ONE_PROCESS], ids=["two processes", "one process"])
def test_stream_faults_are_reported_and_recovered_from(folder: Path, commands: tuple[str, ...]) -> None:
    (folder / "bench.toml").write_text(bench_of(rate_hz=200, preset="quiet", tilt_nm=15))
    with closing(Bench(folder)) as bench, in_background(folder, MIRROR, *commands), bench.listening():
        until(bench.converged, 60)
        _a_stopped_reader_resumes_with_the_newest_image(bench)
        bench.send("renew")
        until(lambda: bench.has_event("STREAM_RENEWED", CAMERA))
        until(lambda: bench.has_event("CAMERA_RESTARTED"))
        bench.errors_nm.clear()
        until(bench.converged)
        bench.send("region")
        until(lambda: bench.has_event("CAMERA_CHANGED") and bench.has_event("closed -> open"))
        bench.send("die")
        until(lambda: bench.has_event("STREAM_SILENT", "in the middle of an image"))
        until(lambda: bench.has_event("DRIVER_FAILED", f"'{TOTAL}' has not followed"))
        until(lambda: bench.has_event("MIRROR_LOST"))
        bench.process.communicate()
        bench.start()
        until(lambda: all(map(bench.has_event, ("FRAMES_BACK", "DRIVER_BACK", "MIRROR_BACK"))))
        with Client("bench") as client:
            until(lambda: not client.status().state.mirror_fault)
            client.close_loop()
        bench.errors_nm.clear()
        until(bench.converged)


def _a_stopped_reader_resumes_with_the_newest_image(bench: Bench) -> None:
    stream = PlainStream(file_of(bench.folder, CAMERA), 80, 80, UINT16)
    with Client("bench") as client:
        pid = client.processes()["camera"].pid
    os.kill(pid, signal.SIGSTOP)
    try:
        # No reader takes an image: every semaphore reaches its highest value.
        until(lambda: min(stream.value(index) for index in range(10)) == 10)
        count = stream.count
        until(lambda: stream.count > count + 5)
    finally:
        os.kill(pid, signal.SIGCONT)
    until(lambda: bench.has_event("FRAMES_LOST") or bench.has_event("FRAMES_MISSING"))
    bench.errors_nm.clear()
    until(bench.converged)


def _other_channels_are_not_undone(bench: Bench) -> None:
    with in_background(bench.folder, BRIDGE), Client("bench") as client:
        calibration = client.calibration()
        until(lambda: all(file_of(bench.folder, f"lowfc_{name}").exists() for name in ("flux", "error")))
        error = PlainStream(file_of(bench.folder, "lowfc_error"), len(calibration.noll), 1, FLOAT32)
        until(lambda: error.count > 20)
        dark_hole = np.random.default_rng(3).standard_normal(GRID) * 0.02
        before = bench.stream(CHANNEL).pixels[0].copy()
        bench.stream(f"{TOTAL}00").write(dark_hole)
        until(lambda: any(channel.name == "external" for channel in client.status().state.channels))
        bench.errors_nm.clear()
        until(bench.converged)
        correction_nm = calibration.actuators_to_modes @ (bench.stream(CHANNEL).pixels[0] - before).reshape(-1)
        external_nm = calibration.actuators_to_modes @ dark_hole.reshape(-1)
        # A loop that undid the shape would give a ratio of 1; noise gives less than 0.3.
        assert np.linalg.norm(correction_nm) < 0.3 * np.linalg.norm(external_nm)
        state = client.status().state
        (external,) = (channel for channel in state.channels if channel.name == "external")
        assert np.allclose(np.frombuffer(external.actuators, "f4"), dark_hole.reshape(-1) * 1000, atol=0.01)


def test_a_minute_at_500_hz_loses_no_frame_and_matches_the_simulated_loop(folder: Path) -> None:
    (folder / "bench.toml").write_text(bench_of(rate_hz=500, preset="bench", tilt_nm=0))
    with (
        in_background(folder, CONTROLLER),
        closing(Bench(folder)) as bench,
        in_background(folder, MIRROR, CAMERA_DRIVER),
    ):
        until(lambda: file_of(folder, CHANNEL).exists() and bench.stream(CHANNEL).count > 100, 60)
        with bench.listening():
            time.sleep(62)
            with Client("bench") as client:
                state = client.status().state
        assert not [event for event in bench.events if "FRAMES" in event and "LATE" not in event]
        assert sum(entry.count for entry in state.counts) < 0.01 * state.frames_used  # refused, such as late ones
        results = bench.stop()
    config = '[disturbance]\npreset = "bench"\n[control]\ntilt_gain = 0.5\ngain = 0.2\n'
    direct = loop(folder, "--no-record", "--rate", "500", "--duration", "60", config=config)
    assert results["residual_rms_nm"] == pytest.approx(direct["residual_rms_nm"], rel=0.05)
