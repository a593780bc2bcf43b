"""Snapshots of the new data on the bus or in a log: columns, pictures, and the latest states."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.names import Names
from lowfc.adapters.logs.columns import StepRows, Steps, TimingRows, TruthRows, Truths
from lowfc.arrays import Long, Mask, Pixels, Sequences, Single
from lowfc.contract.codecs.calibration_codec import decode_calibration
from lowfc.contract.codecs.codec import decode_frame
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    CONTROLLER_STATE,
    EVENT,
    FLOAT32,
    FRAME,
    HEALTH,
    MIRROR_STATE,
    STEP,
    SURFACE,
    TIMING,
    TRUTH,
    Log,
    Message,
    RawImage,
    Topic,
    checked_time_ns,
    floats,
    topic_of,
    wire,
)
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.what_if import has_new_exposure
from lowfc.control.loop.inputs import Frame
from lowfc.control.loop.safety import NOT_NEW

SHOWN = (FRAME, STEP, TRUTH, TIMING, MIRROR_STATE, SURFACE, CALIBRATION, CAMERA_STATE, CONTROLLER_STATE, EVENT, HEALTH)
"""Topics that a view shows."""

PICTURES_HZ = 30.0
PICTURES_PER_COMPLETE = 8
"""One snapshot in eight is complete: curves grow about four times a second; many points cost little more than one."""

_MAX_KNOWN_EVENTS = 5000
_UNREADABLE = (BadMessageError, DecodeError, KeyError, OverflowError, ValueError)


class Wavefronts(NamedTuple):
    """Residual wavefronts of frames, and the wavefronts with a flat mirror (`open`): all true or all measured.

    `residual_nm` and `open_nm` (frames, modes): modes; the true ones are those at the start of each exposure.
    `residual_rms_nm` and `open_rms_nm` (frames, modes): rms of each mode over the frame period if it is known,
    otherwise the modes themselves, with or without their signs. `rms_nm` (frames, 2): rms of the residual and of the
    open wavefront: over the open pupil if true, of all modes if measured.
    """

    sequence: Sequences
    time_ns: Long
    residual_nm: Single
    open_nm: Single
    residual_rms_nm: Single
    open_rms_nm: Single
    rms_nm: Single


class LastHealth(NamedTuple):
    """A process's last Health, sent at `time_ns` (host clock), and the first since its start, `start_s` (Unix time)."""

    time_ns: int
    health: wire.Health
    first: wire.Health
    start_s: int


@dataclass(frozen=True, slots=True)
class LogEnd:
    """End of the logs shown.

    Attributes:
        name: name of the last log.
        run, host: name of their run, and host of the recorder.
        no_end: why one of the logs has no end; empty if all were finished.
        damaged: number of damaged stretches that were left out.
        missing_files: number of files missing between the first and the last.
        lost: number of messages lost, as counted by the recorder at the end of each recording.
        stroke_nm: largest deviation of an actuator from flat in any mirror state; None without a mirror state.
    """

    name: str
    run: str
    host: str
    no_end: str
    damaged: int
    missing_files: int
    lost: int
    stroke_nm: float | None


@dataclass(frozen=True, slots=True)
class Snapshot:
    """New data, and the latest states.

    Attributes:
        time_ns: time on the timeline: time of the newest step (without a controller, of the newest frame) plus the host
            time passed since then; in lockstep, only the simulated time of that step.
        host_ns: time of the snapshot by the host clock. `sent_ns`, the time of each topic's last message, and
            `LastHealth` are by the same clock.
        steps, truths, timings, events: new rows and events; timings are the durations of the controller's stages.
        frame, mirror, surface: newest frame (DN, at `frame_ns`), mirror state, and surface over the pupil (nm); None if
            none has arrived since the last snapshot or, in a `complete` one, since the last complete one. If there is a
            controller, `frame_ns` is at most `time_ns`, because the camera's clock may be ahead.
        calibration, camera, controller: the latest of each; None before the first. health: the latest by process.
        complete: whether all new data are included. An incomplete snapshot has only the newest frame, mirror state and
            surface; rows and events wait for a complete one.
        behind_s: longest time for which the messages of this snapshot may have waited.
        ended: end of the logs, in their last snapshot; None in all others.
    """

    time_ns: int
    host_ns: int
    steps: Steps
    truths: Truths
    timings: dict[str, Long]
    frame: Pixels | None
    frame_ns: int
    mirror: wire.MirrorState | None
    surface: Single | None
    events: list[Log]
    calibration: Calibration | None
    camera: wire.CameraState | None
    controller: wire.ControllerState | None
    health: Mapping[str, LastHealth]
    sent_ns: Mapping[Topic, int]
    complete: bool
    behind_s: float
    ended: LogEnd | None

    @property
    def period_ns(self) -> int:
        """Frame period; 0 if the camera does not report it."""
        return self.camera.period_ns if self.camera is not None else 0

    @property
    def noll(self) -> tuple[int, ...]:
        """Modes of the calibration; empty before the first."""
        return self.calibration.noll if self.calibration is not None else ()

    @property
    def stroke_nm(self) -> float:
        """Limit of an actuator's deviation from flat; 0 if the controller has not reported it."""
        return self.controller.settings.stroke_nm if self.controller is not None else 0.0

    @property
    def new_exposures(self) -> Mask:
        """Whether the frame of each step is a new exposure: only then is the step's time the time of an exposure."""
        return has_new_exposure(self.steps.reasons)

    @property
    def used(self) -> Mask:
        """Whether the frame of each step was used."""
        error_nm = self.steps.error_nm
        return np.asarray(np.isfinite(error_nm).all(axis=1) & (error_nm.shape[1] > 0))

    def wavefronts(self, *, true: bool) -> Wavefronts:
        """New wavefronts: the true ones of a simulation, or those measured in the frames that were used."""
        if true:
            new = self.truths
            rms_nm = np.stack([new.residual_rms_nm, new.disturbance_rms_nm], axis=1)
            modes_rms_nm = new.modes_residual_rms_nm, new.modes_disturbance_rms_nm
            return Wavefronts(new.sequence, new.time_ns, new.residual_nm, new.disturbance_nm, *modes_rms_nm, rms_nm)
        steps, used = self.steps, self.used
        modes_nm = steps.error_nm[used], steps.pol_nm[used]
        rms_nm = np.stack([np.linalg.norm(one, axis=1) for one in modes_nm], axis=1)
        return Wavefronts(steps.sequence[used], steps.time_ns[used], *modes_nm, *modes_nm, rms_nm)


class Accumulator:
    """Receives messages and makes snapshots of them; unreadable messages are left out and counted in `unreadable`."""

    def __init__(self, simulated_ns: int | None = None) -> None:
        """`simulated_ns`: start of a lockstep run by its simulated clock; None if the run is not in lockstep."""
        self._simulated_ns = simulated_ns
        self.unreadable = 0
        self._steps, self._truths, self._timings = StepRows(0), TruthRows(0), TimingRows()
        self._newest: dict[Topic, bytes] = {}
        self._decoded: dict[Topic, Any] = {}
        self._events: list[Log] = []
        self._known_events: dict[tuple[int, bytes], None] = {}
        self._states: dict[Topic, Any] = {}
        self._names = Names()
        self._health: dict[str, LastHealth] = {}
        self._sent_ns: dict[Topic, int] = {}
        self._sequences: dict[str, int] = {}
        self._data_ns = self._data_host_ns = 0  # newest time of the data, and publish time of its message

    def add(self, message: Sample) -> None:
        """Add a message of one of the topics `SHOWN`; a state older than the last one is left out."""
        key, sequence = message.key, message.sequence
        try:
            topic = topic_of(key)
            self._names.admit(topic, key)
            if topic.queryable:
                if sequence < self._sequences.get(key, 0):
                    return
                self._sequences[key] = sequence
            if topic is EVENT and not self._is_new(sequence, message.payload):
                return
            self._sent_ns[topic] = max(message.publish_time_ns, self._sent_ns.get(topic, 0))
            if topic.latest_only:
                self._newest[topic] = message.payload
            else:
                self._read(topic, message)
        except _UNREADABLE:
            self.unreadable += 1

    def snapshot(
        self, host_ns: int, *, complete: bool = True, behind_s: float = 0.0, ended: LogEnd | None = None
    ) -> Snapshot:
        """Return the data since the last snapshot; `host_ns` is the present host time. Arguments: see `Snapshot`."""
        frame: Frame | None = self._newest_of(FRAME, _frame, complete=complete)
        frame_ns = frame.time_ns if frame is not None else 0
        if STEP in self._sent_ns:
            frame_ns = min(frame_ns, self._time_ns(host_ns))
        elif frame is not None:
            self._set_data_time(frame_ns, self._sent_ns[FRAME])
        step_rows, truth_rows, timing_rows, events = StepRows(0), TruthRows(0), TimingRows(), list[Log]()
        if complete:
            step_rows, self._steps = self._steps, StepRows(self._steps.modes)
            truth_rows, self._truths = self._truths, TruthRows(self._truths.modes)
            timing_rows, self._timings = self._timings, TimingRows()
            events, self._events = self._events, []
        steps, truths = step_rows.values(), truth_rows.values()
        self.unreadable += len(step_rows) - len(steps.sequence) + len(truth_rows) - len(truths.sequence)
        return Snapshot(
            time_ns=self._time_ns(host_ns),
            host_ns=host_ns,
            steps=steps,
            truths=truths,
            timings=timing_rows.values()[1],
            frame=frame.pixels if frame is not None else None,
            frame_ns=frame_ns,
            mirror=self._newest_of(MIRROR_STATE, wire.MirrorState.FromString, complete=complete),
            surface=self._newest_of(SURFACE, _surface, complete=complete),
            events=events,
            calibration=self._states.get(CALIBRATION),
            camera=self._states.get(CAMERA_STATE),
            controller=self._states.get(CONTROLLER_STATE),
            health=self._health,
            sent_ns=self._sent_ns,
            complete=complete,
            behind_s=behind_s,
            ended=ended,
        )

    def _is_new(self, sequence: int, payload: bytes) -> bool:
        """Whether an event is new: recent events arrive on the bus and again from the log that is being written."""
        known, identity = self._known_events, (sequence, payload)
        if identity in known:
            return False
        known[identity] = None
        if len(known) > _MAX_KNOWN_EVENTS:
            del known[next(iter(known))]
        return True

    def _time_ns(self, host_ns: int) -> int:
        if self._simulated_ns is not None:
            return self._data_ns or self._simulated_ns
        return self._data_ns + max(0, host_ns - self._data_host_ns) if self._data_ns else host_ns

    def _read(self, topic: Topic, message: Sample) -> None:
        """Read a message of a topic whose messages are all kept; rows of another number of modes are discarded."""
        if topic is STEP:
            step = wire.ControlStep.FromString(message.payload)
            time_ns = checked_time_ns(step.timestamp)
            if not self._steps.add(step):
                self._steps = _added_or_raise(StepRows(len(step.command_nm)), step)
            if NOT_NEW.isdisjoint(step.reasons):
                self._set_data_time(time_ns, message.publish_time_ns)
        elif topic is TRUTH:
            truth = wire.Truth.FromString(message.payload)
            checked_time_ns(truth.timestamp)
            if not self._truths.add(truth):
                self._truths = _added_or_raise(TruthRows(len(truth.residual_nm)), truth)
        elif topic is TIMING:
            _added_or_raise(self._timings, wire.ControlTiming.FromString(message.payload))
        elif topic is HEALTH:
            name, health = self._names.health(message.key, message.payload)
            before, start_s = self._health.get(name), start_of(message.sequence)
            first = before.first if before is not None and before.start_s == start_s else health
            self._health[name] = LastHealth(message.publish_time_ns, health, first, start_s)
        elif topic is EVENT:
            event = Log.FromString(message.payload)
            checked_time_ns(event.timestamp)
            self._events.append(event)
        else:
            state = topic.message.FromString(message.payload)
            if isinstance(state, wire.ControllerState):
                checked_time_ns(state.mode_timestamp)
                if any(len(channel.actuators) % 4 for channel in state.channels):
                    raise ValueError("a channel whose actuators are not a multiple of four bytes")
                if any(acting.number >= len(state.settings.interlocks) for acting in state.interlocks_acting):
                    raise ValueError("an interlock that is not in its settings")
            self._states[topic] = decode_calibration(state) if isinstance(state, wire.Calibration) else state

    def _set_data_time(self, data_ns: int, publish_time_ns: int) -> None:
        if data_ns >= self._data_ns:
            self._data_ns, self._data_host_ns = data_ns, publish_time_ns

    def _newest_of(self, topic: Topic, decode: Callable[[bytes], Any], *, complete: bool) -> Any:
        """The newest message of a topic, decoded; None if there is no new one that can be read.

        A complete snapshot has the newest message since the last complete one, even if an incomplete one had it too:
        some panels draw only complete snapshots.
        """
        decoded = None
        if (payload := self._newest.pop(topic, None)) is not None:
            try:
                decoded = self._decoded[topic] = decode(payload)
            except _UNREADABLE:
                self.unreadable += 1
        return self._decoded.pop(topic, None) if complete else decoded


def _added_or_raise(rows: Any, message: Message) -> Any:
    if not rows.add(message):
        raise ValueError("a message with another number of columns or modes")
    return rows


def _frame(payload: bytes) -> Frame:
    frame = decode_frame(payload, 0, 0)
    if frame.pixels is None:
        raise ValueError("a frame that cannot be read")
    return frame


def _surface(payload: bytes) -> Single:
    image = RawImage.FromString(payload)
    if image.encoding != FLOAT32:
        raise ValueError(f"a surface is {FLOAT32}, got {image.encoding!r}")
    return floats(image.data, image.height, image.width)
