"""A chaos bench in one process and in simulated time: real controller, mirror and log.

The frames are those of the toy sensor in `tests.support.toy`.
"""

import random
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from lowfc.adapters.bus.bus import Query, Sample
from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.files import calibration_file
from lowfc.adapters.logs.writer import LogWriter
from lowfc.adapters.process.latch import NAME, Latch
from lowfc.adapters.process.service import Service
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import Envelope
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import CAMERA_STATE, FRAME, HEALTH, STEP, TRUTH, Role, image, wire
from lowfc.device.driver import CameraSettings, DriverOptions, camera_state
from lowfc.device.mirror_loop import MirrorLoop
from lowfc.programs.core.controller import Controller
from lowfc.programs.reliability.chaos.bench import CaseFailedError, ChaosBench, Outcome, ProcessEnd
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from sim_dm.driver import SimulatedMirror
from tests.support.toy import GRID, NOLL, SATURATION_DN, SHAPE, TOY, calibration

TOY_KEYS: dict[str, Any] = {
    "sensor.modes": len(NOLL),
    "mirror.rows": GRID[0],
    "mirror.columns": GRID[1],
    "camera.rate_hz": 100.0,
    "realtime.cache_warmup": False,
}
"""Configuration keys of a loop with the toy sensor."""
DRIFT_NM, DRIFT_HZ = np.array([20.0, -12.0, 8.0]), 0.3
"""Amplitude and frequency of the disturbance of each mode."""
TO_MODES = np.linalg.pinv(TOY.modes_to_actuators)
SETTLED_FRAMES = 150
"""Closed-loop frames to wait for; fewer than with real processes."""
CAMERA_PID = 1
PATIENCE_FRAMES = 3000
"""Number of frames after which a wait for a condition fails."""


class ImmediateController(Controller):
    """A controller that answers a request at once, on the requester's thread."""

    _request_lock = threading.Lock()

    def _queue_query(self, query: Query) -> None:
        with self._request_lock:
            self._answer(query)
            self._update_latch()


class Recorder(MemoryBus):
    """Writes every message to a log."""

    def __init__(self, hub: MemoryHub, clock: FakeClock, log: LogWriter) -> None:
        super().__init__(hub, Role.RECORDER, clock)
        self._log, self._log_lock, self.messages = log, threading.Lock(), 0

    def deliver(self, key: str, payload: bytes, envelope: Envelope) -> None:
        with self._log_lock:
            self.messages += 1
            self._log.write(Sample(key, payload, *envelope, self.clock.host_ns()))


class ToyBench(ChaosBench):
    """The bench of one case in simulated time: while a case waits, frames are exposed (see `replace_time`)."""

    def __init__(self, config: Configuration, folder: Path, rng: random.Random, fault: dict[str, Any] | None) -> None:
        self.config, self.folder, self.rng, self.outcome = config, folder, rng, Outcome(folder, config)
        self.mirror, self.newest_frame, self.health = mirror_role(config.mirror.name), 0, dict[str, wire.Health]()
        self._steps = self._closed_frames = self._index = 0
        self._services: dict[str, Service] = {}
        self.hub, self.clock = MemoryHub(), FakeClock()
        self._start_error, self._noise = "", np.random.default_rng(rng.getrandbits(32))
        path = folder / "run"
        path.mkdir()
        self.run: Any = SimpleNamespace(path=path, run_id="toy", links=None, remove=lambda: None)
        file = path / "calibration.fits"
        calibration_file.save(with_identity(calibration()), file)
        pids = {Role.CAMERA: CAMERA_PID, Role.CONTROLLER: CAMERA_PID + 1}
        self.children: Any = {
            name: SimpleNamespace(
                name=name, command=["lowfc", name, str(file)], status=None, process=SimpleNamespace(pid=pid)
            )
            for name, pid in pids.items()
        }
        self._log = LogWriter(folder / "toy.mcap", self.clock.now_ns(), {})
        self._recorder = Recorder(self.hub, self.clock, self._log)

    def connection(self, role: str) -> MemoryBus:
        return MemoryBus(self.hub, role, self.clock)

    def replace_time(self, module: ModuleType, patch: Callable[..., None]) -> None:
        """Let a module wait in simulated time; only the main thread waits, others continue at once."""
        patch(module, "time", SimpleNamespace(monotonic=lambda: self.clock.now_ns() * 1e-9, sleep=self._sleep))

    def begin(self) -> None:
        self.bus: Any = self.connection(Role.LAUNCHER)
        for topic in (HEALTH, STEP, TRUTH):
            self.bus.subscribe(topic, self._receive)
        camera, mirror = self._service(Role.CAMERA), self._service(self.mirror)
        self._frames, self._truths = camera.publisher(FRAME), camera.publisher(TRUTH)
        settings = replace(CameraSettings.configured(self.config, *SHAPE), saturation_dn=SATURATION_DN)
        camera.publisher(CAMERA_STATE).put(camera_state(settings, self.clock.now_ns()).SerializeToString())
        self._mirror = MirrorLoop(SimulatedMirror(DriverOptions(), self.config), mirror, self.config)
        self.restart(Role.CONTROLLER)
        self.await_settled()
        self.outcome.settled_ns = self.clock.host_ns()

    def wait(self, condition: Callable[[], bool], what: str, timeout_s: float = 0.0) -> None:
        for _ in range(PATIENCE_FRAMES):
            if condition():
                return
            self.expose()
        raise CaseFailedError(f"waited in vain for {what}")

    def await_settled(self, frames: int = SETTLED_FRAMES) -> None:
        super().await_settled(frames)

    def pause(self, shortest_s: float, longest_s: float) -> None:
        self._sleep(self.rng.uniform(shortest_s, longest_s))

    def kill(self, name: str) -> None:
        self._latch.close()  # waits for its thread, which writes in real time
        self._services.pop(name).bus.close()
        self.outcome.ended.append(ProcessEnd(name, -signal.SIGKILL, 0.0, True))

    def restart(self, name: str, command: list[str] | None = None, *, ready: bool = True) -> None:
        """Start a controller; its calibration file is the last argument of the command."""
        try:
            loaded = calibration_file.load(Path((command or self.children[Role.CONTROLLER].command)[-1]))
        except LowfcError as fault:
            self._start_error = str(fault)
            return
        service = self._service(name)
        self._latch = Latch([self.run.path / NAME], lambda why: service.event("LATCH_FAILED", why=why))
        self._controller = ImmediateController(self.config, service, loaded, "a test", self._latch)
        service.fill = self._controller.fill
        self._mirror._publish(self.clock.now_ns())  # the mirror's state, from which a controller starts
        self._controller._camera.await_first()
        self._controller._adopt_mirror()
        self._controller._bench.query()
        self._controller._mirror_adopted = True

    def await_end(self, name: str, status: int) -> str:
        assert self._start_error
        self.outcome.ended.append(ProcessEnd(name, status, 0.0, True))
        return self._start_error

    def end(self, timeout_s: float = 0.0) -> None:
        self.outcome.end_ns = self.clock.host_ns()
        for name, service in self._services.items():
            service.finish()
            self.outcome.ended.append(ProcessEnd(name, 0, 0.0, True))
        self._latch.close()
        self._log.finish({})
        self.health[Role.RECORDER] = wire.Health(recording=wire.Recording(messages=self._recorder.messages))

    def expose(self) -> None:
        """Expose one frame, and let the processes handle it and what was sent before."""
        self.clock.advance(self.config.period_ns)
        disturbance_nm = DRIFT_NM * np.sin(2 * np.pi * DRIFT_HZ * self._index / self.config.camera.rate_hz)
        surface_nm = self._mirror._status.surface_nm.reshape(-1)
        residual_nm = disturbance_nm + TO_MODES @ surface_nm
        self._index += 1
        pixels = TOY.pixels(residual_nm) + self._noise.integers(0, 3, SHAPE).astype(np.uint16)
        self._truths.put(wire.Truth(residual_rms_nm=np.linalg.norm(residual_nm)).SerializeToString())
        self._frames.put(image(pixels, self.clock.now_ns(), "toy").SerializeToString())
        self._mirror._idle()
        if Role.CONTROLLER in self._services:
            self._controller._between_frames(self._controller._camera.mailbox.take(0))
            while self._controller._gain_requests:
                self._controller._carry_out_internal(self._controller._gain_requests.popleft())
        for service in self._services.values():
            assert service.running, service.why
            service.beat()

    def _service(self, name: str) -> Service:
        self._services[name] = Service(name, "toy", self.clock, self.connection(name))
        return self._services[name]

    def _sleep(self, seconds: float) -> None:
        if threading.current_thread() is threading.main_thread():
            for _ in range(max(1, round(seconds * self.config.camera.rate_hz))):
                self.expose()
