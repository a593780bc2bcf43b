"""What is new on the bus or in a log since the last look: columns, pictures, and the last of each state."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.adapters.history import Steps, Truths
from lowfc.adapters.names import Names
from lowfc.adapters.rows import StepRows, TimingRows, TruthRows
from lowfc.contract.calibration_codec import decode_calibration
from lowfc.contract.codec import decode_frame
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
    RawImage,
    Topic,
    from_timestamp,
    wire,
)
from lowfc.control.calibration import Calibration

SHOWN: tuple[Topic, ...] = (
    FRAME,
    STEP,
    TRUTH,
    TIMING,
    MIRROR_STATE,
    SURFACE,
    CALIBRATION,
    CAMERA_STATE,
    CONTROLLER_STATE,
    EVENT,
    HEALTH,
)
"""Topics that a view shows."""

PICTURES_HZ = 30.0
PICTURES_PER_WHOLE = 8
"""Moments for each that is whole: curves grow four times a second, for many rows cost hardly more than one."""

_KNOWN_EVENTS = 5000
_NO_STEPS, _NO_TRUTHS, _NO_TIMINGS = StepRows(0).taken(), TruthRows(0).taken(), TimingRows().taken()[1]


class Heard(NamedTuple):
    """A process's last Health, and when it was sent (host clock)."""

    time_ns: int
    health: wire.Health


@dataclass(frozen=True, slots=True)
class LogEnd:
    """The end of logs that are looked at.

    Attributes:
        name: of the last one.
        complete: it was finished, and all of it is there.
        run, host: of the run; empty where the log does not say.
    """

    name: str
    complete: bool
    run: str
    host: str


@dataclass(frozen=True, slots=True)
class Moment:
    """What is new, and the last of what stays.

    Attributes:
        time_ns: on the timeline: that of the newest data, and what has passed since. In lockstep it is simulated time.
        host_ns: host clock, the one of `heard_ns` and of `Heard`.
        steps, truths: new rows; `timings` the new durations of the controller's stages.
        frame: newest frame, DN; None without a new one. `frame_ns` is its time.
        mirror: newest state of the mirror; None without a new one.
        surface: newest surface over the pupil, nm; None without a new one.
        events: new ones.
        calibration, camera, controller: the last of each; None before the first.
        health: of every process heard so far, by name.
        heard_ns: when the last message of each topic was sent, by the topic's key in the table.
        whole: everything is in it; otherwise only what is newest, and rows and events wait for a later moment.
        behind_s: how late this moment is.
        ended: the end of the logs, at their last moment.
    """

    time_ns: int
    host_ns: int
    steps: Steps
    truths: Truths
    timings: dict[str, npt.NDArray[np.int64]]
    frame: npt.NDArray[np.uint16] | None
    frame_ns: int
    mirror: wire.MirrorState | None
    surface: npt.NDArray[np.float32] | None
    events: list[Log]
    calibration: Calibration | None
    camera: wire.CameraState | None
    controller: wire.ControllerState | None
    health: Mapping[str, Heard]
    heard_ns: Mapping[str, int]
    whole: bool = True
    behind_s: float = 0.0
    ended: LogEnd | None = None


class Gatherer:
    """Takes messages and makes moments of them; what cannot be read is left out and counted in `unreadable`."""

    def __init__(self, simulated_ns: int | None = None) -> None:
        """With the time at which a run in lockstep begins: its data's clock is not the host's."""
        self._simulated_ns = simulated_ns
        self.unreadable = 0
        self._steps = StepRows(0)
        self._truths = TruthRows(0)
        self._timings = TimingRows()
        self._newest: dict[str, bytes] = {}
        self._events: list[Log] = []
        self._known_events: dict[tuple[int, bytes], None] = {}
        self._calibration: Calibration | None = None
        self._camera: wire.CameraState | None = None
        self._controller: wire.ControllerState | None = None
        self._names = Names()
        self._health: dict[str, Heard] = {}
        self._heard_ns: dict[str, int] = {}
        self._sequences: dict[str, int] = {}
        self._data_ns = 0
        self._data_host_ns = 0

    def take(self, topic: Topic, key: str, payload: bytes, publish_time_ns: int, sequence: int = 0) -> None:
        """Take one message of one of `SHOWN`; a state that is older than one taken before is none."""
        try:
            self._names.admit(topic, key)
        except BadMessageError:
            self.unreadable += 1
            return
        if topic.queryable:
            if sequence < self._sequences.get(key, 0):
                return
            self._sequences[key] = sequence
        if topic is EVENT and not self._is_new(sequence, payload):
            return
        self._heard_ns[topic.key] = max(publish_time_ns, self._heard_ns.get(topic.key, 0))
        if topic.newest_only:
            self._newest[topic.key] = payload
            return
        try:
            self._read(topic, key, payload, publish_time_ns)
        except (BadMessageError, DecodeError, OverflowError, ValueError):
            self.unreadable += 1

    def moment(self, host_ns: int, *, whole: bool = True, behind_s: float = 0.0, ended: LogEnd | None = None) -> Moment:
        """What is new at this time of the host's clock; the next moment begins here.

        Args:
            host_ns: now.
            whole: take rows and events too; otherwise they wait for a later moment, in which more come at once.
            behind_s: how late it is.
            ended: the end of the logs, where this is their last moment.
        """
        frame, frame_ns = self._frame()
        if frame is not None:
            self._date(frame_ns, self._heard_ns[FRAME.key])
        steps, truths, timings, events = _NO_STEPS, _NO_TRUTHS, _NO_TIMINGS, list[Log]()
        if whole:
            steps, truths, timings = self._steps.taken(), self._truths.taken(), self._timings.taken()[1]
            self._steps, self._truths = StepRows(self._steps.modes), TruthRows(self._truths.modes)
            self._timings = TimingRows()
            events, self._events = self._events, events
        mirror, surface = self._mirror(), self._surface()
        self._newest.clear()
        return Moment(
            time_ns=self._time_ns(host_ns),
            host_ns=host_ns,
            steps=steps,
            truths=truths,
            timings=timings,
            frame=frame,
            frame_ns=frame_ns,
            mirror=mirror,
            surface=surface,
            events=events,
            calibration=self._calibration,
            camera=self._camera,
            controller=self._controller,
            health=self._health,
            heard_ns=self._heard_ns,
            whole=whole,
            behind_s=behind_s,
            ended=ended,
        )

    def _is_new(self, sequence: int, payload: bytes) -> bool:
        """Whether an event is new: those of the last minutes come by the bus, and in a log that is being written."""
        known, identity = self._known_events, (sequence, payload)
        if identity in known:
            return False
        known[identity] = None
        if len(known) > _KNOWN_EVENTS:
            del known[next(iter(known))]
        return True

    def _time_ns(self, host_ns: int) -> int:
        if self._simulated_ns is not None:
            return self._data_ns or self._simulated_ns
        return self._data_ns + max(0, host_ns - self._data_host_ns) if self._data_ns else host_ns

    def _read(self, topic: Topic, key: str, payload: bytes, publish_time_ns: int) -> None:
        if topic is STEP:
            step = wire.ControlStep.FromString(payload)
            if not self._steps.add(step):
                rows = StepRows(len(step.command_nm))
                if not rows.add(step):
                    raise ValueError("a step whose modes differ in number")
                self._steps = rows
            self._date(from_timestamp(step.timestamp), publish_time_ns)
        elif topic is TRUTH:
            truth = wire.Truth.FromString(payload)
            if not self._truths.add(truth):
                others = TruthRows(len(truth.residual_nm))
                if not others.add(truth):
                    raise ValueError("a truth whose modes differ in number")
                self._truths = others
        elif topic is TIMING:
            self.unreadable += not self._timings.add(wire.ControlTiming.FromString(payload))
        elif topic is HEALTH:
            name, health = self._names.health(key, payload)
            self._health[name] = Heard(publish_time_ns, health)
        elif topic is EVENT:
            self._events.append(Log.FromString(payload))
        elif topic is CALIBRATION:
            self._calibration = decode_calibration(wire.Calibration.FromString(payload))
        elif topic is CAMERA_STATE:
            self._camera = wire.CameraState.FromString(payload)
        elif topic is CONTROLLER_STATE:
            self._controller = wire.ControllerState.FromString(payload)

    def _date(self, data_ns: int, publish_time_ns: int) -> None:
        if data_ns >= self._data_ns:
            self._data_ns, self._data_host_ns = data_ns, publish_time_ns

    def _frame(self) -> tuple[npt.NDArray[np.uint16] | None, int]:
        payload = self._newest.get(FRAME.key)
        if payload is None:
            return None, 0
        frame = decode_frame(payload, 0, 0)
        self.unreadable += frame.pixels is None
        return frame.pixels, frame.time_ns

    def _mirror(self) -> wire.MirrorState | None:
        try:
            return wire.MirrorState.FromString(self._newest[MIRROR_STATE.key])
        except KeyError:
            return None
        except DecodeError:
            self.unreadable += 1
            return None

    def _surface(self) -> npt.NDArray[np.float32] | None:
        payload = self._newest.get(SURFACE.key)
        if payload is None:
            return None
        try:
            image = RawImage.FromString(payload)
            if image.encoding != FLOAT32:
                raise ValueError(f"a surface is {FLOAT32}, got {image.encoding!r}")
            return np.frombuffer(image.data, "<f4").reshape(image.height, image.width)
        except (DecodeError, ValueError):
            self.unreadable += 1
            return None
