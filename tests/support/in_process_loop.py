"""Loops in one process: with the interface of `lowfc.client`, for a number of frames, or in threads."""

import contextlib
import itertools
import threading
import tomllib
from collections import deque
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.bus.bus import Publisher
from lowfc.adapters.process.clock import Clock, HostClock
from lowfc.adapters.process.latch import Latch
from lowfc.adapters.process.service import Service
from lowfc.arrays import Single
from lowfc.client import Answer, Client, MirrorWatch
from lowfc.client import Frame as Image
from lowfc.contract.codecs.state_codec import controller_state
from lowfc.contract.configuration import FIXED_GAINS, Configuration, load
from lowfc.contract.errors import CalibrationError, RequestRefusedError
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import EVENT, MIRROR_STATE, Topic, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.inputs import MirrorReport, MirrorShape, Request, Step, Tick
from lowfc.device import DriverOptions, driver
from lowfc.device.mirror_loop import MirrorLoop
from lowfc.programs.core.controller import Controller
from lowfc.testing.memory_bus import MemoryBus, MemoryHub, MemoryRing
from sim_dm.driver import SimulatedMirror
from tools.law_bench import Bench, calibrated

PATIENCE_S = 20.0
FIRST = 1 << 32  # sequence of the first frame of a camera
SMALL_MIRROR = {"mirror.rows": 12, "mirror.columns": 12, "mirror.pitches_per_pupil": 10}
"""Configuration keys for tests that do not depend on the number of actuators: calibrations are computed faster."""

BRIGHT = (
    FIXED_GAINS
    | SMALL_MIRROR
    | {
        "sensor.sam": "sam27d10_bal14",
        "star.magnitude": 0.0,
        "disturbance.preset": "quiet",
        "camera.instants": 1,  # sufficient without a disturbance
    }
)
"""Configuration keys for tests of calibrations: a bright star without a disturbance."""


def configuration(keys: dict[str, Any], **changes: Any) -> Configuration:
    """The configuration with these keys; `camera__noise=False` changes the key `camera.noise`."""
    return load(None, keys | {key.replace("__", "."): value for key, value in changes.items()})


@lru_cache(maxsize=4)
def calibration_of(toml: str) -> Calibration:
    return calibrated(Configuration.model_validate(tomllib.loads(toml)))


class ReportingBus(MemoryBus):
    """Connection of an operator's program; `report` is called whenever it subscribes with a ring buffer."""

    def __init__(self, hub: MemoryHub, report: Callable[[], object]) -> None:
        super().__init__(hub, "operator", HostClock())
        self._report = report

    def ring(self, topic: Topic, capacity: int) -> MemoryRing:
        ring = super().ring(topic, capacity)
        self._report()
        return ring


class InProcessLoop(Client):
    """Camera, controller and mirror, one frame at a time, with the interface of a client.

    Attributes:
        hub: hub on which the mirror's process reports.
        mirror_bus: connection of the mirror's process; once closed, the mirror keeps its shape.
        first: sequence of frame 0.
        surfaces_nm: shape of the mirror in each exposure, nm of surface.
    """

    def __init__(
        self,
        config: Configuration,
        calibration: Calibration | None = None,
        world: Configuration | None = None,
        lose: Callable[[int], bool] = lambda index: False,
        cut: int | None = None,
    ) -> None:
        """Start a loop with `config` in a simulated `world` (default: `config`); frames that `lose` selects are lost.

        With `cut`, frames lack that many pixels at each edge, and no calibration is computed.
        """
        self.config, self.run_id = config, "folded"
        self._cut = cut or 0
        grid = (config.mirror.rows, config.mirror.columns)
        flat = MirrorShape(0, np.zeros(grid, np.float32), np.zeros(0, np.float32))
        if cut is None and calibration is None:
            calibration = calibration_of(config.to_toml())
        self._bench = Bench(config, flat if calibration is None else calibration, world=world)
        self.scene = self._bench.scene
        self.hub = MemoryHub()
        self._operator = ReportingBus(self.hub, self.expose)
        self.start_mirror()
        self._lose = lose
        self._listeners: list[tuple[str, deque[Any]]] = []
        self.surfaces_nm: list[Single] = []
        self.stops = self.lease_id = 0
        self.first = FIRST

    def start_mirror(self) -> None:
        self._bench.start_mirror()
        self.mirror_bus = MemoryBus(self.hub, "mirror-dm", HostClock())
        self._states: Publisher = self.mirror_bus.publisher(MIRROR_STATE, "dm")

    def expose(self) -> None:
        surface_nm, image = self._bench.expose()
        pixels = image[self._cut : image.shape[0] - self._cut, self._cut : image.shape[1] - self._cut]
        self.surfaces_nm.append(surface_nm)
        if self._lose(len(self.surfaces_nm) - 1):
            return
        frame = self._bench.frame(pixels, self.first)
        outputs = self._bench.process_input(frame)
        if not self.mirror_bus.closed:
            self._bench.move_mirror(frame, outputs.command)
            self._states.put(wire.MirrorState(frame_sequence=frame.sequence).SerializeToString())
        for kind, queue in self._listeners:
            queue.append(Image(frame.sequence, frame.time_ns, pixels) if kind == "frames" else outputs.step)

    def silence_camera(self) -> None:
        """Let the frame timeout pass without a frame, and publish the events that the controller raises."""
        for event in self._bench.process_input(Tick(0, 60_000_000)).events:
            message = EVENTS[event.name].log("controller", 0, **event.details)
            self.mirror_bus.publisher(EVENT).put(message.SerializeToString())

    def report_mirror(self, fault: str) -> None:
        """Report a fault of the mirror to the controller; an empty text reports that the mirror follows again."""
        self._bench.process_input(MirrorReport(0, fault))

    def residual_nm(self, first: int, last: int | None = None) -> npt.NDArray[np.float64]:
        """True residual modes (frames, modes), nm rms, at the starts of the exposures in the slice `first:last`."""
        frames = range(len(self.surfaces_nm))[first:last]
        truths = [self.scene.truth(index, self.surfaces_nm[index]) for index in frames]
        return np.array([truth.sampled.residual_nm for truth in truths], np.float64)

    def run(self, frames: int) -> None:
        for _ in range(frames):
            self.expose()

    def ask(self, name: str, modes: Any = (), values: Any = (), **fields: Any) -> Answer:
        fields = {"lease_id": self.lease_id} | {key: value for key, value in fields.items() if value is not None}
        if "actuators_nm" in fields:
            fields["actuators_nm"] = fields["actuators_nm"].reshape(-1)
        if name == "stop":
            self.stops += 1
        numbers = tuple(np.atleast_1d(np.asarray(values, float)).tolist())
        request = Request(0, name, tuple(np.atleast_1d(modes).tolist()) if np.size(modes) else (), numbers, **fields)
        outputs = self._bench.process_input(request)
        if not outputs.reply.accepted:
            raise RequestRefusedError(f"{name} refused: {outputs.reply.text}")
        state = controller_state(self._bench.state, self._bench.settings, 0) if name == "status" else None
        return Answer(True, outputs.reply.text, outputs.reply.frame_sequence, state=state)

    def play(self, basis_nm: npt.ArrayLike, table: npt.ArrayLike) -> Answer:
        self.expose()  # a frame passes during the request
        return super().play(basis_nm, table)

    def disconnect(self) -> None:
        """Do nothing."""

    @contextlib.contextmanager
    def reserved(self, purpose: str, duration_s: float | None = None) -> Iterator[SimpleNamespace]:
        self.lease_id = 1
        self.ask("lease", values=60.0, text=purpose)
        try:
            # As `lowfc.client.lease.Lease`, without a report of the remaining time.
            yield SimpleNamespace(expecting=lambda progress, rate_hz: progress)
        finally:
            self.ask("release")
            self.lease_id = 0

    def check_lease(self) -> None:
        if self.lease_id:
            try:
                self.ask("renew", values=60.0, text="a test")
            except RequestRefusedError as fault:
                raise CalibrationError(str(fault)) from None

    def calibration(self) -> Calibration:
        return self._bench.state.loop.calibration

    def configuration(self) -> str:
        return self.config.to_toml()

    def camera(self) -> CameraSettings | None:
        return self._bench.state.conditions.camera

    def camera_state(self) -> wire.CameraState:
        side = 80 - 2 * self._cut
        return driver.camera_state(driver.CameraSettings.configured(self.config, side, side), 1)

    def laws(self) -> dict[str, LinearLaw]:
        law_runner = self._bench.state.loop.law_runner
        return {} if law_runner is None else {law_runner.law.id: law_runner.law}

    def frames(self, count: int | None = None) -> Iterator[Image]:
        return self._listen("frames", count)

    def steps(self, count: int | None = None) -> Iterator[Step]:
        return self._listen("steps", count)

    def mirror_watch(self) -> MirrorWatch:
        return MirrorWatch(self._operator)

    def _listen(self, kind: str, count: int | None) -> Iterator[Any]:
        queue: deque[Any] = deque()
        listener = (kind, queue)
        self._listeners.append(listener)

        def received() -> Iterator[Any]:
            try:
                for _ in itertools.islice(itertools.count(), count):
                    while not queue:
                        self.expose()
                    yield queue.popleft()
            finally:
                self._listeners = [one for one in self._listeners if one is not listener]

        return received()


def run_loop(config: Configuration, frames: int, calibration: Calibration | None = None) -> SimpleNamespace:
    """Run the loop of a configuration; every frame must be used.

    Returns, in nm rms: error_nm, pol_nm, command_nm (frames, modes) of the steps; and of the truth, disturbance_nm,
    residual_nm (frames, modes), and over the open pupil disturbance_rms_nm, residual_rms_nm (frames,).
    """
    bench = Bench(config, calibration or calibrated(config))
    bench.run(frames)
    assert not bench.frames_refused
    columns = {name: [getattr(step, name) for step in bench.steps] for name in ("error_nm", "pol_nm", "command_nm")}
    for name in ("disturbance_nm", "residual_nm", "disturbance_rms_nm", "residual_rms_nm"):
        columns[name] = [getattr(truth.sampled, name) for truth in bench.truths]
    return SimpleNamespace(**{name: np.array(rows, np.float64) for name, rows in columns.items()})


class ThreadedRun:
    """Controller and mirror in threads; a subclass adds the camera, and other processes if it needs them."""

    def __init__(self, run_id: str, config: Configuration, new_clock: Callable[[], Clock]) -> None:
        """Each connection and each service has its own clock, made by `new_clock`."""
        self.run_id, self.config, self.new_clock, self.hub = run_id, config, new_clock, MemoryHub()

    def bus(self, role: str) -> MemoryBus:
        return MemoryBus(self.hub, role, self.new_clock())

    def service(self, role: str) -> Service:
        return Service(role, self.run_id, self.new_clock(), self.bus(role))

    def start(self, calibration: Calibration, source: str, latch: Path, *others: tuple[Any, Service]) -> None:
        """Start the controller, the mirror, and other processes with their services."""
        controller, mirror = self.service("controller"), self.service("mirror-dm")
        self.controller = Controller(self.config, controller, calibration, source, Latch([latch]))
        self.mirror = MirrorLoop(SimulatedMirror(DriverOptions(), self.config), mirror, self.config)
        processes = ((self.controller, controller), (self.mirror, mirror), *others)
        self.services = [service for _, service in processes]
        self.threads = [threading.Thread(target=process.run, daemon=True) for process, _ in processes]
        for thread in self.threads:
            thread.start()

    def stop(self) -> None:
        """Stop the processes, one after another."""
        for service, thread in zip(self.services, self.threads, strict=True):
            service.stop("the test is over")
            thread.join(PATIENCE_S)
            assert not thread.is_alive()
