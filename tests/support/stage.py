"""Helpers for tests of the view: a scripted run of the toy sensor, and a stream that stores what is drawn."""

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.bus.bus import Sample
from lowfc.arrays import Array
from lowfc.contract.codecs.calibration_codec import encode_calibration, with_identity
from lowfc.contract.envelope import sequence_of
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    CONTROLLER_STATE,
    FRAME,
    HEALTH,
    MIRROR_STATE,
    STEP,
    TIMING,
    TRUTH,
    Message,
    Topic,
    image,
    timestamp,
    wire,
)
from lowfc.control.loop.safety import LoopMode, Rejection
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.view.snapshot import Accumulator, Snapshot
from lowfc.programs.view.verdicts.tile import Tile, Verdict
from lowfc.programs.view.verdicts.verdict import judge
from lowfc.programs.view.verdicts.watcher import Watcher
from tests.support.toy import FLUX_DN, NOLL, SATURATION_DN, START, TOY, calibration

NM_PER_MAS = tilt_nm_per_mas(2.0)


def tile(verdict: Verdict, title: str) -> Tile:
    return next(one for one in verdict.tiles if one.title == title)


def accumulated(samples: Iterable[Sample]) -> Accumulator:
    accumulator = Accumulator()
    for one in samples:
        accumulator.add(one)
    return accumulator


def snapshot_of(samples: list[Sample]) -> Snapshot:
    """Snapshot of all messages of a run."""
    return accumulated(samples).snapshot(samples[-1].publish_time_ns)


class Stage:
    """A scripted run: messages as from the processes of a loop with the sensor of `tests.support.toy`.

    Attributes:
        silent: processes that no longer send; a silent camera sends no frames, and so on.
        states: state in each process's Health.
        health: further fields of a process's Health.
        reasons: reasons of every step; with a rejection the frame counts as refused.
        saturated_pixels: number of pixels at full well in every frame.
        flux: light in every frame, relative to the calibration.
        residual_nm, open_nm: residual and disturbance in the first mode, nm rms of wavefront.
        behind_s: time by which the view is behind the run.
        on_snapshot: called with every snapshot.
    """

    def __init__(self, *, data_ns: int = START * 10**9) -> None:
        self.host_ns, self.data_ns = START * 10**9, data_ns
        self.accumulator, self.watcher = Accumulator(), Watcher()
        self.on_snapshot: Callable[[Snapshot], object] = lambda snapshot: None
        self.silent: set[str] = set()
        self.states = dict.fromkeys(("camera", "controller", "mirror-dm", "recorder"), "running")
        self.health: dict[str, dict[str, object]] = {"recorder": {"recording": wire.Recording(file="logs/a.mcap")}}
        self.mode, self.reasons = LoopMode.CLOSED, ()
        self.truth, self.residual_nm, self.open_nm = True, 5.0, 40.0
        self.flux, self.saturated_pixels = 1.0, 0
        self.stroke_nm, self.latency_us = 100.0, 500
        self.status, self.limits_hit = wire.MIRROR_STATUS_FOLLOWING, ()
        self.refused = 0
        self.frames, self.start_s = 0, START
        self.behind_s = 0.0

    def send(self, topic: Topic, message: Message | bytes, name: str = "dm") -> None:
        payload = message if isinstance(message, bytes) else message.SerializeToString()
        self.accumulator.add(Sample(topic.at(name), payload, 0, self.host_ns, self.host_ns))

    def begin(self) -> None:
        self.send(CALIBRATION, encode_calibration(with_identity(calibration()), self.data_ns))
        settings = wire.ControllerSettings(stroke_nm=700.0, min_flux_fraction=0.2)
        self.send(CONTROLLER_STATE, wire.ControllerState(mode=self.mode.value, settings=settings))
        self.send(CAMERA_STATE, wire.CameraState(period_ns=20_000_000))

    def run(self, seconds: float) -> Verdict:
        """Send frames at 50 Hz and Health at 2 Hz, with a snapshot at 10 Hz; return the verdict at the end."""
        for _ in range(round(seconds * 50)):
            self.host_ns += 20_000_000
            self.data_ns += 20_000_000
            self._frame()
            if self.frames % 25 == 0:
                for name in sorted(self.states.keys() - self.silent):
                    health = wire.Health(process=name, state=self.states[name], pid=7, **self.health.get(name, {}))
                    if name == "controller":
                        health.mode = self.mode.value
                    self.send(HEALTH, health, name)
            if self.frames % 5 == 0:
                snapshot = self.accumulator.snapshot(self.host_ns, behind_s=self.behind_s)
                self.watcher.feed(snapshot)
                self.on_snapshot(snapshot)
        assert not self.accumulator.unreadable
        return judge(self.watcher.state(), NM_PER_MAS)

    def _runs(self, name: str) -> bool:
        return name not in self.silent and self.states.get(name) == "running"

    def _frame(self) -> None:
        self.frames += 1
        frame = {"timestamp": timestamp(self.data_ns), "frame_sequence": sequence_of(self.start_s, self.frames)}
        residual_nm, open_nm = ([size, 0.0, 0.0] for size in (self.residual_nm, self.open_nm))
        if self._runs("camera"):
            pixels = TOY.pixels([0.0] * len(NOLL), self.flux * FLUX_DN)
            pixels.flat[: self.saturated_pixels] = SATURATION_DN
            self.send(FRAME, image(pixels, self.data_ns, "toy"))
            if self.truth:
                truth = wire.Truth(**frame, disturbance_nm=open_nm, residual_nm=residual_nm)
                truth.disturbance_rms_nm, truth.residual_rms_nm = self.open_nm, self.residual_nm
                self.send(TRUTH, truth)
        if self._runs("mirror-dm"):
            shape = np.full(4, self.stroke_nm, "<f4").tobytes()
            state = wire.MirrorState(status=self.status, rows=2, columns=2, actuators=shape)
            state.limits_hit.extend(self.limits_hit)
            state.refused = self.refused
            self.send(MIRROR_STATE, state)
        if self._runs("camera") and self._runs("controller"):
            step = wire.ControlStep(**frame, mode=self.mode.value, command_nm=[0.0] * 3)
            step.reasons.extend(reason.value for reason in self.reasons)
            if not any(isinstance(reason, Rejection) for reason in self.reasons):
                step.error_nm.extend(residual_nm)
                step.pol_nm.extend(open_nm)
            self.send(STEP, step)
            stages = dict.fromkeys(("transport_ns", "wakeup_ns", "compute_ns", "publish_ns"), (1,))
            latency_ns = (1000 * self.latency_us,)
            sequence = (frame["frame_sequence"],)
            self.send(TIMING, wire.ControlTiming(frame_sequence=sequence, frame_to_command_ns=latency_ns, **stages))


class Tape:
    """Stand-in for rerun's RecordingStream; it stores what is drawn.

    Attributes:
        now_ns: time of the next logged item.
        logged: (time in ns, archetypes) by entity path; the time is None for static items.
        rows: (times in ns, values (rows, series)) of columns of scalars, by entity path.
    """

    def __init__(self) -> None:
        self.now_ns: int | None = None
        self.logged: dict[str, list[tuple[int | None, tuple[Any, ...]]]] = defaultdict(list)
        self.rows: dict[str, list[tuple[npt.NDArray[np.int64], Array]]] = defaultdict(list)

    def set_time(self, timeline: str, *, timestamp: np.datetime64) -> None:
        assert timeline == "time"
        self.now_ns = int(timestamp.astype("datetime64[ns]").astype(np.int64))

    def log(self, path: str, *archetypes: Any, static: bool = False) -> None:
        self.logged[path].append((None if static else self.now_ns, archetypes))

    def send_columns(self, path: str, indexes: list[Any], columns: Any) -> None:
        (index,) = indexes
        assert index.timeline_name() == "time"
        times_ns = np.array(index.as_arrow_array().cast("int64"))
        self.rows[path].append((times_ns, np.array(values_of(next(iter(columns))), float)))

    def disconnect(self) -> None:
        pass

    flush = disconnect

    @property
    def paths(self) -> set[str]:
        """Entity paths with content other than static style."""
        timed = {path for path, found in self.logged.items() if any(at is not None for at, _ in found)}
        return timed | set(self.rows)

    def column(self, path: str) -> tuple[npt.NDArray[np.int64], Array]:
        times, values = zip(*self.rows[path], strict=True)
        return np.concatenate(times), np.concatenate(values)

    def names(self, path: str) -> list[str]:
        return values_of(self.last(path).names)

    def texts(self, path: str) -> list[str]:
        return [values_of(line.text)[0] for _, (line,) in list(self.logged[path])]

    def last(self, path: str) -> Any:
        return self.logged[path][-1][1][0]


def values_of(component: Any) -> list[Any]:
    return list(component.as_arrow_array().to_pylist())


def pixels(tape: Tape, path: str) -> npt.NDArray[np.uint8]:
    """Colours (rows, columns, 3) of the last image at a path; its format may have been logged earlier."""

    def last(component: str) -> Any:
        logged = [batches for _, (batches, *_) in tape.logged[path]]
        parts = [part for one in logged for part in (one if isinstance(one, list) else one.as_component_batches())]
        named = [part for part in parts if part.component_descriptor().component == f"Image:{component}"]
        return values_of(named[-1])[0]

    shape = last("format")
    return np.array(last("buffer"), np.uint8).reshape(shape["height"], shape["width"], -1)
