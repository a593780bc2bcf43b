"""The history of a run, as columns: everything that a log has of every step, for reports, exports and what-ifs.

Frames are not in it (read them from the log); everything else that is known of a frame is one row.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import Any, cast

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample, name_in
from lowfc.adapters.logs.columns import (
    Columns,
    StepRows,
    Steps,
    TimingRows,
    TruthRows,
    Truths,
    bits_of,
    exposure_fraction,
    frame_rate_hz,
    joined,
    rows_of,
)
from lowfc.adapters.logs.parts import WholeLog
from lowfc.adapters.logs.reader import LogReader
from lowfc.arrays import Long, Sequences, Single
from lowfc.contract.codecs.calibration_codec import decode_calibration
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    COMMAND,
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    HEALTH,
    LAW,
    MIRROR_STATE,
    PLAY,
    REQUEST,
    STEP,
    TIMING,
    TRUTH,
    Log,
    Topic,
    topic_of,
    wire,
)
from lowfc.contract.published import Published
from lowfc.contract.recorded_configuration import recorded
from lowfc.control.calibration.calibration import Calibration

_LAST_NS = (1 << 63) - 1
_DECODED = {STEP, TRUTH, MIRROR_STATE, TIMING, CALIBRATION, CONTROLLER_STATE, CAMERA_STATE, REQUEST, HEALTH, EVENT}


_SEQUENCES, _WHOLE, _SINGLE = (
    cast("Callable[[], Any]", partial(np.zeros, 0, kind)) for kind in (np.uint64, np.int64, np.float32)
)
_NOWHERE = cast("Callable[[], Any]", partial(np.zeros, (0, 0), np.float32))


@dataclass(slots=True)
class MirrorStates:
    """One row for every state of the mirror.

    Attributes:
        sequence: of the frame behind the command applied.
        publish_time_ns: when the mirror reported it.
        stroke_nm: largest deviation of an actuator from flat.
        limits: bit `1 << reason` for each of the mirror's own limits that acted.
        highest_nm, lowest_nm: (rows, columns) extremes of each actuator over the run.
    """

    sequence: Sequences = field(default_factory=_SEQUENCES)
    publish_time_ns: Long = field(default_factory=_WHOLE)
    stroke_nm: Single = field(default_factory=_SINGLE)
    limits: Long = field(default_factory=_WHOLE)
    highest_nm: Single = field(default_factory=_NOWHERE)
    lowest_nm: Single = field(default_factory=_NOWHERE)


@dataclass
class History:
    """Everything that a log has of a run, but the frames.

    Attributes:
        log: the reader, read to its end: metadata, attachments, whether the log is complete.
        configuration: that the log was recorded with; None without one that can be read.
        remarks: what of that this version cannot use, a sentence each that names the log.
        controllers: states of the controllers, in order.
        frame_sequence, frame_publish_ns: of every frame in the log.
        command_publish_ns: of every mirror command in the log.
        stages_ns: (timed steps,) each of `STAGES`, for the frames of `timed_sequence`.
        left_out: steps of another number of modes than the last calibration's, or with impossible values.
        requests: what operators asked, with the answers.
        events: (log time ns, message).
        health: the last of each process.
        counts: messages by topic key.
        published: laws and tables that were played, by identity.
        span_ns: log times of the first and the last message; (0, 0) for none.
    """

    log: LogReader
    configuration: Configuration | None = None
    remarks: list[str] = field(default_factory=list)
    calibration: Calibration | None = None
    controllers: list[wire.ControllerState] = field(default_factory=list)
    camera: wire.CameraState | None = None
    frame_sequence: Sequences = field(default_factory=_SEQUENCES)
    frame_publish_ns: Long = field(default_factory=_WHOLE)
    command_publish_ns: Long = field(default_factory=_WHOLE)
    steps: Steps = field(default_factory=lambda: StepRows(0).taken())
    truths: Truths = field(default_factory=lambda: TruthRows(0).taken())
    mirror: MirrorStates = field(default_factory=MirrorStates)
    timed_sequence: Sequences = field(default_factory=_SEQUENCES)
    stages_ns: dict[str, Long] = field(default_factory=dict)
    left_out: int = 0
    requests: list[wire.Request] = field(default_factory=list)
    events: list[tuple[int, Log]] = field(default_factory=list)
    health: dict[str, wire.Health] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    published: Published = field(default_factory=Published)
    span_ns: tuple[int, int] = (0, 0)

    @property
    def controller(self) -> wire.ControllerState | None:
        """The controller's last state; None without one."""
        return self.controllers[-1] if self.controllers else None

    @property
    def rate_hz(self) -> float:
        """See `frame_rate_hz`."""
        return frame_rate_hz(self.camera, self.steps)

    @property
    def exposure_fraction(self) -> float | None:
        """See `columns.exposure_fraction`."""
        return exposure_fraction(self.camera)

    @cached_property
    def true(self) -> Truths | None:
        """The truths by step, NaN for one that has none; None without any."""
        rows = rows_of(self.steps.sequence, self.truths.sequence)
        if not (rows >= 0).any():
            return None
        known = self.truths
        values = {
            one.name: joined(getattr(known, one.name), rows)
            for one in fields(Truths)
            if one.name not in ("sequence", "time_ns", "instants")
        }
        instants = np.where(rows < 0, 0, known.instants[rows])
        return Truths(self.steps.sequence, self.steps.time_ns, **values, instants=instants)

    def again(self, topic: Topic) -> WholeLog:
        """The log once more, for what the history does not hold: its messages of one topic."""
        log = WholeLog(self.log.paths, topics=(topic,), skip_damaged=True)
        log.progress = self.log.progress
        return log


def read_history(log: LogReader) -> History:
    """Read a log, with a reader that has not been read, to its end.

    Raises:
        DataFileError: as `LogReader`, or the log has a calibration that cannot be read.
    """
    rows = _Rows(history := History(log))
    for message in log:
        rows.take(message)
    rows.finish()
    history.configuration, history.remarks = attached_configuration(log)
    return history


def attached_configuration(log: LogReader) -> tuple[Configuration | None, list[str]]:
    """The configuration that a log was recorded with, and remarks on what of it this version cannot use.

    None where the log has none that can be read: a log is never refused for its configuration.
    """
    name, content = next((one for one in log.attachments.items() if one[0].endswith(".toml")), ("", None))
    if content is None:
        return None, []
    try:
        found, remarks = recorded(content)
    except ConfigurationError as error:
        return None, [f"{log.path}: its {name} cannot be used: {error}"]
    return found, [f"{log.path}: its {name}: {remark}" for remark in remarks]


class _Rows:
    """The columns of a history while they grow; what has none of its own goes there at once."""

    def __init__(self, history: History) -> None:
        self._history = history
        self._calibration: wire.Calibration | None = None
        self._frames = Columns(sequence="Q", publish_ns="q")
        self._commands = Columns(publish_ns="q")
        self._timings = TimingRows()
        self._mirror = Columns(sequence="Q", publish_time_ns="q", stroke_nm="f", limits="q")
        self._steps, self._truths = StepRows(0), TruthRows(0)

    def take(self, message: Sample) -> None:
        """Take one message of the log."""
        history = self._history
        if max(message.receive_time_ns, message.publish_time_ns) > _LAST_NS:
            history.left_out += 1
            return
        first_ns, _ = history.span_ns
        history.span_ns = (first_ns or message.receive_time_ns, message.receive_time_ns)
        history.counts[message.key] += 1
        try:
            self._decode(message)
        except (KeyError, DecodeError):
            return  # a message that nobody of the loop could read either
        except OverflowError:
            history.left_out += 1  # protobuf allows it, and nobody of the loop sends it

    def _decode(self, message: Sample) -> None:
        topic, history = topic_of(message.key), self._history
        if topic is FRAME:
            self._frames.add(sequence=message.sequence, publish_ns=message.publish_time_ns)
        elif topic is COMMAND:
            self._commands.add(publish_ns=message.publish_time_ns)
        elif topic in (LAW, PLAY):
            history.published.take(topic, message.payload)
        if topic not in _DECODED:
            return
        body = topic.message.FromString(message.payload)
        if isinstance(body, wire.ControlStep):
            history.left_out += not self._steps.add(body)
        elif isinstance(body, wire.Truth):
            self._truths.add(body)
        elif isinstance(body, wire.MirrorState):
            self._mirror_state(body, message.publish_time_ns)
        elif isinstance(body, wire.ControlTiming):
            self._timings.add(body)
        elif isinstance(body, wire.Calibration):
            self._calibrate(body)
        elif isinstance(body, wire.ControllerState):
            history.controllers.append(body)
        elif isinstance(body, wire.CameraState):
            history.camera = body
        elif isinstance(body, wire.Request):
            history.requests.append(body)
        elif isinstance(body, wire.Health):
            history.health[name_in(HEALTH, message.key)] = body
        elif isinstance(body, Log):
            history.events.append((message.receive_time_ns, body))

    def _mirror_state(self, state: wire.MirrorState, publish_time_ns: int) -> None:
        surface = actuators(state)
        if surface is None:
            return
        self._mirror.add(
            sequence=state.frame_sequence,
            publish_time_ns=publish_time_ns,
            stroke_nm=float(np.abs(surface).max()),
            limits=bits_of(state.limits_hit),
        )
        extremes = self._history.mirror
        if extremes.highest_nm.shape != surface.shape:
            extremes.highest_nm, extremes.lowest_nm = surface.copy(), surface.copy()
        np.maximum(extremes.highest_nm, surface, out=extremes.highest_nm)
        np.minimum(extremes.lowest_nm, surface, out=extremes.lowest_nm)

    def _calibrate(self, calibration: wire.Calibration) -> None:
        self._calibration = calibration
        modes = len(calibration.noll)
        if modes != self._steps.modes:
            self._history.left_out += len(self._steps)
            self._steps, self._truths = StepRows(modes), TruthRows(modes)

    def finish(self) -> None:
        """Everything as arrays."""
        history = self._history
        history.frame_sequence, history.frame_publish_ns = map(self._frames.taken, ("sequence", "publish_ns"))
        history.command_publish_ns = self._commands.taken("publish_ns")
        history.steps, history.truths = self._steps.taken(), self._truths.taken()
        for name in ("sequence", "publish_time_ns", "stroke_nm", "limits"):
            setattr(history.mirror, name, self._mirror.taken(name))
        history.timed_sequence, history.stages_ns = self._timings.taken()
        try:
            history.calibration = None if self._calibration is None else decode_calibration(self._calibration)
        except ValueError as error:
            raise DataFileError(f"{history.log.path}: {error}") from None
