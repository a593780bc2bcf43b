"""Write the golden files of the current version: `python -m tests.golden.make FOLDER`.

A short loop on an in-memory bus, with a camera that exposes on request and a clock that is advanced explicitly. Its log
has every kind of input that release 0.1 knew; reports of a mirror's faults, bench values, leases and permits are newer
and absent. The files of a released version are never changed.
"""

import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.files import calibration_file, factory, law_file
from lowfc.adapters.logs.writer import Attachment
from lowfc.adapters.process.provenance import provenance
from lowfc.client import Client
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import RequestRefusedError
from lowfc.contract.messages import CAMERA_STATE, FRAME, MIRROR_STATE, STEP, TRUTH, image, timestamp, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import LinearLaw, integrator_block, law_from_blocks
from lowfc.device.driver import CameraSettings, camera_state
from lowfc.programs.core.recording.recorder import Recorder
from lowfc.testing.clock import FakeClock
from sim_camera.driver import scene
from tests.support.in_process_loop import ThreadedRun
from tests.support.loops import until
from tools.law_bench import calibrated

ROOT = Path(__file__).parents[2]
CONFIGURATION = {
    "sensor.modes": 2,
    "mirror.rows": 12,
    "mirror.columns": 12,
    "mirror.pitches_per_pupil": 10.0,
    "mirror.settling_us": 0.0,
    "star.magnitude": 2.0,
    "camera.rate_hz": 1000.0,
    "camera.gain_e_per_dn": 10.0,  # small differences between pixels, so that the log is small
    "disturbance.preset": "bench",
    "control.delay_frames": 1.5,
    "control.frame_timeout_ms": 40.0,
    "control.start_mode": "open",
    "seed": 7,
}


class Night(ThreadedRun):
    """A run in one process: a camera that exposes on request; controller, mirror and recorder in their own threads."""

    def __init__(self, config: Configuration, calibration: Calibration, folder: Path) -> None:
        self.clock = FakeClock()
        super().__init__("golden", config, lambda: self.clock)
        self.index = self.last_step = 0
        self.shape_nm = np.zeros((config.mirror.rows, config.mirror.columns), np.float32)
        self.scene = scene(config)
        operator = self.bus("operator")
        operator.subscribe(STEP, self._on_step)
        operator.subscribe(MIRROR_STATE, self._on_mirror_state)
        self.client = Client("golden", bus=operator)
        self.start_camera()
        (folder / "run").mkdir(parents=True)
        attached = [
            Attachment("config.toml", "application/toml", config.to_toml().encode()),
            Attachment("calibration.fits", "application/fits", calibration_file.to_bytes(calibration)),
        ]
        metadata = {"lowfc": provenance("golden", config.seed) | {"host": "bench"}}
        recorder = Recorder(
            self.bus("recorder"), self.clock, "golden", folder / "logs", metadata=metadata, attachments=attached
        )
        self.start(calibration, "calibration.fits", folder / "run" / "safe", (recorder, recorder.service))
        until(lambda: recorder.service.state == "ready")

    def start_camera(self, **changes: float) -> None:
        """Start the camera, or restart it with other settings."""
        bus = self.bus("camera")
        self.frames, self.truths = bus.publisher(FRAME), bus.publisher(TRUTH)
        self.settings = bus.publisher(CAMERA_STATE)
        state = camera_state(CameraSettings.configured(self.config, *self.scene.shape), self.clock.now_ns())
        for name, value in changes.items():
            setattr(state, name, value)
        self.settings.put(state.SerializeToString())

    def _on_step(self, sample: Sample) -> None:
        self.last_step = wire.ControlStep.FromString(sample.payload).frame_sequence

    def _on_mirror_state(self, sample: Sample) -> None:
        self.shape_nm = actuators(wire.MirrorState.FromString(sample.payload))

    def expose(self, frames: int, change: Callable[[Any], Any] = lambda pixels: pixels, late_ns: int = 0) -> None:
        """Expose frames, each after the step of the previous one; `change` alters pixels, `late_ns` delays arrival."""
        for _ in range(frames):
            pixels = self.scene.expose(self.index, self.shape_nm)
            truth = self.scene.truth(self.index, self.shape_nm).sampled
            self.index += 1
            self.clock.advance(self.config.period_ns)
            time_ns = self.clock.now_ns()
            sequence = self.frames.put(
                image(change(pixels), time_ns, "camera").SerializeToString(), time_ns - late_ns
            ).sequence
            message = wire.Truth(timestamp=timestamp(time_ns), frame_sequence=sequence, **asdict(truth))
            self.truths.put(message.SerializeToString())
            until(lambda: self.last_step == sequence)  # noqa: B023  # called immediately

    def frame_timeout(self) -> None:
        """Expose no frame until the command is repeated and NO_FRAMES is raised."""
        for _ in range(3):
            self.clock.advance(20_000_000)
            time.sleep(0.05)


def expect_refusal(request: Callable[..., object], *arguments: object) -> None:
    """Make a request that must be refused."""
    try:
        request(*arguments)
    except RequestRefusedError:
        return
    raise AssertionError("the request was accepted")


def law(config: Configuration) -> LinearLaw:
    """An integrator on pseudo-open-loop modes, whose state includes past commands."""
    settings = factory.settings(config)
    delay, gains = settings.delay_frames, settings.integrator(config.noll).gain.astype(float).tolist()
    blocks = [integrator_block(gain, 0.01, "pol", delay) for gain in gains]
    return law_from_blocks(blocks, "pol", "golden integrator", config.noll, delay, config.camera.rate_hz)


def main(folder: Path) -> None:
    """Write all golden files."""
    folder.mkdir(parents=True)
    config = load(None, CONFIGURATION)
    calibration, golden_law = calibrated(config), law(config)
    calibration_file.save(calibration, folder / "calibration.fits")
    law_file.save(golden_law, folder / "law.fits")
    (folder / "lowfc.toml").write_text(config.to_toml())
    for path in (ROOT / "deploy/layouts").glob("*.*"):
        if path.suffix != ".rbl":  # binary format of one version of rerun
            shutil.copy(path, folder / path.name)
    shutil.copy(ROOT / "lowfc/contract/wire/lowfc.desc", folder / "lowfc.desc")

    work = folder / "work"
    night = Night(config, calibration, work)
    loop = night.client
    night.expose(2)
    loop.note("golden files")
    loop.close_loop()
    night.expose(5)
    loop.gain(0.4, (2, 3))
    loop.leak(0.01)
    loop.limit([120.0, 110.0], (2, 3))
    expect_refusal(loop.gain, 3.0)
    expect_refusal(loop.ask, "dance")
    night.expose(3)
    loop.offset([2.0, -1.0], (2, 3))
    ramp_nm = np.linspace(-40, 40, 144, dtype=np.float32).reshape(12, 12)
    loop.channel("dark-hole", ramp_nm)
    loop.channel("flat", ramp_nm.T / 4)
    night.expose(3)
    loop.law(golden_law)
    night.expose(4)
    loop.play(np.stack([ramp_nm / 20, ramp_nm.T / 20]), [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.5], [0.0, 0.0]])
    night.expose(2)
    expect_refusal(loop.play_offset, np.ones((2, 2)))
    night.expose(3)
    part = next((work / "logs").glob("*.part"))
    before = part.stat().st_size
    night.clock.advance(250_000_000)  # so that the recorder flushes
    until(lambda: part.stat().st_size > before)
    killed = part.read_bytes()
    (folder / "killed.mcap").write_bytes(killed[: len(killed) - 300])
    loop.play_offset(np.full((4, 2), 3.0))
    night.expose(2)
    loop.stop()
    loop.channel("dark-hole")
    loop.offset()
    night.frames.put(b"", sequence=night.last_step + 2)  # unreadable; the frame before it is missing
    night.expose(1, lambda pixels: pixels[:3])  # of the wrong size
    night.expose(1, lambda pixels: np.full_like(pixels, 100))  # dark
    night.expose(1, lambda pixels: np.full_like(pixels, 65_535))  # saturated
    night.expose(1, late_ns=25_000_000)
    stuck = night.scene.expose(night.index, night.shape_nm)
    night.expose(6, lambda _: stuck)
    night.frame_timeout()
    night.expose(115)  # the law observes for a hundred frames, and is then in its cross-fade
    loop.law()
    loop.status()
    loop.pause()
    loop.step(2)
    night.expose(3)
    loop.reset()
    night.expose(2)
    loop.load(with_identity(replace(calibration, reconstructor=calibration.reconstructor * np.float32(0.9))))
    loop.close_loop()
    night.expose(2)
    night.clock.advance(1_000_000_000)
    night.start_camera(bias_dn=300.0)
    night.expose(3)
    loop.safe()
    night.expose(2)
    expect_refusal(loop.close_loop)
    loop.clear()
    night.expose(1)
    night.stop()
    (log,) = (work / "logs").glob("*.mcap")
    log.rename(folder / "night.mcap")
    shutil.rmtree(work)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
