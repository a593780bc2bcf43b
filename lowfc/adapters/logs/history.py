"""History of a run for reports, exports and what-ifs: columns of its frequent messages, and its rare messages.

A history omits control inputs, values that other programs publish (`lowfc/bench`), offloads, images, surfaces and
commands' shapes; `History.reader` reads these.
"""

import contextlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import Any

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
from lowfc.arrays import Array, Integers, Long, Mask, Sequences, Single
from lowfc.contract.codecs.calibration_codec import decode_calibration
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import ConfigurationError, DataFileError, raised_as
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    COMMAND,
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    HEALTH,
    MIRROR_STATE,
    REQUEST,
    STEP,
    TIMING,
    TRUTH,
    Log,
    Role,
    Topic,
    from_timestamp,
    topic_of,
    wire,
)
from lowfc.contract.published import TOPICS, Published
from lowfc.contract.recorded_configuration import recorded
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.continuous import Timing
from lowfc.control.loop.safety import LoopMode

LAST_NS = (1 << 63) - 1
"""Latest time of a message that is read, in the year 2262; int64 columns of times cannot hold a later one."""
REORDERING_NS = 2_000_000_000
"""Time by which messages in a log may be out of order."""
_CAMERA_SETTINGS = ("period_ns", "exposure_ns", "gain_e_per_dn", "bias_dn", "read_noise_e", "em_gain")
_DECODED = {STEP, TRUTH, MIRROR_STATE, TIMING, CALIBRATION, CONTROLLER_STATE, CAMERA_STATE, REQUEST, HEALTH, EVENT}


_SEQUENCES: Callable[[], Any] = partial(np.zeros, 0, np.uint64)
_INTEGERS: Callable[[], Any] = partial(np.zeros, 0, np.int64)
_SINGLE: Callable[[], Any] = partial(np.zeros, 0, np.float32)
_NO_GRID: Callable[[], Any] = partial(np.zeros, (0, 0), np.float32)


@dataclass(slots=True)
class MirrorStates:
    """States of the mirror, one row per message.

    Attributes:
        sequence: sequence of the frame of the applied command.
        publish_time_ns: time at which the mirror published the state.
        stroke_nm: largest deviation of an actuator from flat, nm of surface.
        limits: bits `1 << reason` of the mirror's own limits that acted.
        highest_nm, lowest_nm: (rows, columns) extremes of each actuator over the run, nm of surface.
    """

    sequence: Sequences = field(default_factory=_SEQUENCES)
    publish_time_ns: Long = field(default_factory=_INTEGERS)
    stroke_nm: Single = field(default_factory=_SINGLE)
    limits: Long = field(default_factory=_INTEGERS)
    highest_nm: Single = field(default_factory=_NO_GRID)
    lowest_nm: Single = field(default_factory=_NO_GRID)


@dataclass
class History:
    """History of a run, read from its log.

    Attributes:
        log: the log's reader, which has read to the end: metadata, attachments, whether the log is complete.
        configuration: configuration of the recorded loop; None if there is no readable one.
        remarks: sentences on parts of the configuration that this version cannot use, and on the calibration if its
            message is lost; each names the log.
        calibration: the last recorded one; without any in the log, the attached calibration that `controller` names.
        controllers: states of the controllers, in order.
        camera: camera state with the settings of most steps under `calibration`; of most closed-loop steps if any.
        under_camera: (steps,) whether the camera had the settings of `camera` in each step.
        frame_sequence, frame_publish_ns: sequence and publish time of every frame in the log.
        command_sequence, command_publish_ns: message sequence and publish time of every mirror command in the log.
        stepped_sequence: frame sequence of every step in the log, also of those that `steps` leaves out.
        steps, truths: steps and truths with the number of modes of the last calibration.
        stages_ns: (timed steps,) durations of each of `columns.STAGES`, for the frames of `timed_sequence`.
        excluded_messages: number of steps with another number of modes than the last calibration, and of messages with
            impossible values.
        requests: requests of operators and of the controller itself, with the answers.
        events: (publish time in ns, message) of each event.
        health: last Health of each process, by name.
        commands_late: commands that the camera counted as late between its first and last Health in the log, also
            across restarts; None with fewer than two Healths.
        counts: number of messages, by topic key.
        published: calibrations, laws and played tables, by identity.
        span_ns: log times of the first and the last message; the states and calibrations stored at the start of the log
            do not count as first. (0, 0) without any other message.
    """

    log: LogReader
    configuration: Configuration | None = None
    remarks: list[str] = field(default_factory=list)
    calibration: Calibration | None = None
    controllers: list[wire.ControllerState] = field(default_factory=list)
    camera: wire.CameraState | None = None
    under_camera: Mask | bool = True
    frame_sequence: Sequences = field(default_factory=_SEQUENCES)
    frame_publish_ns: Long = field(default_factory=_INTEGERS)
    command_sequence: Sequences = field(default_factory=_SEQUENCES)
    command_publish_ns: Long = field(default_factory=_INTEGERS)
    stepped_sequence: Sequences = field(default_factory=_SEQUENCES)
    steps: Steps = field(default_factory=lambda: StepRows(0).values())
    truths: Truths = field(default_factory=lambda: TruthRows(0).values())
    mirror: MirrorStates = field(default_factory=MirrorStates)
    timed_sequence: Sequences = field(default_factory=_SEQUENCES)
    stages_ns: dict[str, Long] = field(default_factory=dict)
    excluded_messages: int = 0
    requests: list[wire.Request] = field(default_factory=list)
    events: list[tuple[int, Log]] = field(default_factory=list)
    health: dict[str, wire.Health] = field(default_factory=dict)
    commands_late: int | None = None
    counts: Counter[str] = field(default_factory=Counter)
    published: Published = field(default_factory=Published)
    span_ns: tuple[int, int] = (0, 0)

    @property
    def controller(self) -> wire.ControllerState | None:
        """Last state of the controller; None if there is none."""
        return self.controllers[-1] if self.controllers else None

    @property
    def rate_hz(self) -> float:
        """Frame rate, Hz; see `frame_rate_hz`."""
        return frame_rate_hz(self.camera, self.steps)

    def camera_clock_offset_ns(self, process: str) -> int:
        """Offset to add to a frame's time for the clock of `process`, ns; a log's publish times are the recorder's."""
        camera, other = (self.health.get(name, wire.Health()) for name in (Role.CAMERA, process))
        return camera.router_offset_ns - other.router_offset_ns

    def timing(self, delay_frames: float) -> Timing:
        """Timing of the loop from the mirror's reports; that of `Timing.of` without usable reports, as in lockstep."""
        if (exposure := exposure_fraction(self.camera)) is None:
            exposure = (self.configuration or Configuration()).camera.exposure_fraction
        applied = self.mirror.sequence, self.mirror.publish_time_ns - self.camera_clock_offset_ns(Role.RECORDER)
        return measured_timing(Timing.of(delay_frames, exposure), self.steps, *applied, self.rate_hz)

    @property
    def under_calibration(self) -> Mask:
        """Whether each step (steps,) came after the last change of calibration in the log, and is `under_camera`."""
        steps, states = self.steps, self.controllers
        current_ids = ("", self.calibration.id if self.calibration is not None else "")
        if not (foreign := [number for number, state in enumerate(states) if state.calibration_id not in current_ids]):
            return np.ones(steps.sequence.shape, np.bool_) & self.under_camera
        last, *later = (state.frame_sequence for state in states[foreign[-1] :])  # a change publishes a state
        change = max(last, next(filter(None, later), 0))  # a state published at a start or by `clear` has no frame
        return (steps.sequence > change) & self.under_camera

    @cached_property
    def true(self) -> Truths | None:
        """Truths joined to the steps, NaN for steps without truth; None if no step has truth."""
        rows = rows_of(self.steps.sequence, self.truths.sequence)
        if not (rows >= 0).any():
            return None
        values = {
            part.name: joined(getattr(self.truths, part.name), rows)
            for part in fields(Truths)
            if part.name not in ("sequence", "time_ns", "instants")
        }
        instants = np.where(rows < 0, 0, self.truths.instants[rows])
        return Truths(self.steps.sequence, self.steps.time_ns, **values, instants=instants)

    def reader(self, topic: Topic) -> WholeLog:
        """New reader of the log for one topic, such as the images, which the history does not hold."""
        return WholeLog(self.log.paths, self.log.progress, topics=(topic,))


def read_history(log: LogReader) -> History:
    """Read a log to its end; `log` has not been read yet.

    Raises:
        DataFileError: as for `LogReader`, or the log's calibration cannot be read.
    """
    builder = _HistoryBuilder(history := History(log))
    for message in log:
        builder.add(message)
    builder.finish()
    history.configuration, remarks = attached_configuration(log)
    history.remarks += remarks
    return history


def attached_configuration(log: LogReader) -> tuple[Configuration | None, list[str]]:
    """Configuration attached to a log, and remarks on the parts of it that this version cannot use.

    None if the log has no readable one: a log is never refused because of its configuration.
    """
    name, content = next((file for file in log.attachments.items() if file[0].endswith(".toml")), ("", None))
    if content is None:
        return None, []
    try:
        configuration, remarks = recorded(content)
    except ConfigurationError as error:
        return None, [f"{log.path}: its {name} cannot be used: {error}"]
    return configuration, [f"{log.path}: its {name}: {remark}" for remark in remarks]


def attached_calibration(log: LogReader, calibration_id: str) -> Calibration | None:
    """The calibration of this identity, if it is attached to a log and can be read."""
    from lowfc.adapters.files import calibration_file  # imports astropy, which takes 0.3 s

    for name, content in log.attachments.items():
        if name.endswith(".fits"):
            with contextlib.suppress(DataFileError):
                calibration = calibration_file.load(log.path / name, content)
                if calibration.id == calibration_id:
                    return calibration
    return None


class _HistoryBuilder:
    """Fills a history message by message; columns grow here, all other content is stored in the history directly."""

    def __init__(self, history: History) -> None:
        self._history = history
        self._calibration: wire.Calibration | None = None
        self._cameras: list[tuple[Array, wire.CameraState]] = []  # settings and state at each change of the settings
        self._frames, self._commands = (Columns(sequence="Q", publish_ns="q") for _ in range(2))
        self._stepped, self._timings = Columns(sequence="Q"), TimingRows()
        self._mirror = Columns(sequence="Q", publish_time_ns="q", stroke_nm="f", limits="q")
        self._rows: dict[int, tuple[StepRows, TruthRows]] = {}  # by number of modes
        self._set_modes(0)
        self._last_late: tuple[int, int] | None = None  # the camera's start, and its count of late commands

    def add(self, message: Sample) -> None:
        """Add one message of the log."""
        history = self._history
        if max(message.receive_time_ns, message.publish_time_ns) > LAST_NS:
            history.excluded_messages += 1
            return
        history.counts[message.key] += 1
        try:
            self._decode(message)
        except (KeyError, DecodeError):
            return  # an unknown topic or a damaged message: the loop ignores it as well
        except OverflowError:  # valid in protobuf, but never sent by the loop
            history.excluded_messages += 1

    def _decode(self, message: Sample) -> None:
        topic, history = topic_of(message.key), self._history
        first_ns, last_ns = history.span_ns
        if first_ns or not topic.queryable:  # states and calibrations at the start may be hours old
            history.span_ns = (first_ns or message.receive_time_ns, max(last_ns, message.receive_time_ns))
        if topic is FRAME:
            self._frames.add(sequence=message.sequence, publish_ns=message.publish_time_ns)
        elif topic is COMMAND:
            self._commands.add(sequence=message.sequence, publish_ns=message.publish_time_ns)
        elif topic in TOPICS:
            history.published.store(topic, message.payload)
        if topic not in _DECODED:
            return
        body = topic.message.FromString(message.payload)
        if isinstance(body, wire.ControlStep):
            if not self._steps.modes and len(body.command_nm):
                self._set_modes(len(body.command_nm))  # the message of the calibration is lost
            self._stepped.add(sequence=body.frame_sequence)
            history.excluded_messages += not self._steps.add(body)
        elif isinstance(body, wire.Truth):
            self._truths.add(body)
        elif isinstance(body, wire.MirrorState):
            self._mirror_state(body, message.publish_time_ns)
        elif isinstance(body, wire.ControlTiming):
            self._timings.add(body)
        elif isinstance(body, wire.Calibration) and body.noll:  # former versions also wrote a calibration without modes
            self._calibration = body
            self._set_modes(len(body.noll))
        elif isinstance(body, wire.ControllerState):
            history.controllers.append(body)
        elif isinstance(body, wire.CameraState):
            settings = np.nan_to_num([getattr(body, name) for name in _CAMERA_SETTINGS])
            if not self._cameras or not np.allclose(settings, self._cameras[-1][0], rtol=0.01, atol=0):
                self._cameras.append((settings, body))
        elif isinstance(body, wire.Request):
            history.requests.append(body)
        elif isinstance(body, wire.Health):
            history.health[name_in(HEALTH, message.key)] = body
            if name_in(HEALTH, message.key) == Role.CAMERA:
                self._count_late(start_of(message.sequence), body.commands_late)
        elif isinstance(body, Log):
            history.events.append((message.publish_time_ns, body))

    def _mirror_state(self, state: wire.MirrorState, publish_time_ns: int) -> None:
        if (surface := actuators(state)) is None:
            return
        if not np.isfinite(surface).all():
            self._history.excluded_messages += 1
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

    def _set_modes(self, modes: int) -> None:
        """Add further steps and truths to the rows with this number of modes; all other rows remain as they are."""
        self._steps, self._truths = self._rows.setdefault(modes, (StepRows(modes), TruthRows(modes)))

    def _count_late(self, start_s: int, count: int) -> None:
        """Add the camera's late commands since its previous Health; a restarted camera counts from 0."""
        if self._last_late is not None:
            last_start_s, last_count = self._last_late
            since = count - last_count if start_s == last_start_s else count
            self._history.commands_late = (self._history.commands_late or 0) + max(0, since)
        self._last_late = start_s, count

    def finish(self) -> None:
        """Convert all columns to arrays."""
        history = self._history
        history.frame_sequence, history.frame_publish_ns = map(self._frames.values, ("sequence", "publish_ns"))
        history.command_sequence, history.command_publish_ns = map(self._commands.values, ("sequence", "publish_ns"))
        history.calibration = self._last_calibration()
        self._set_modes(len(history.calibration.noll) if history.calibration is not None else 0)
        history.excluded_messages += sum(len(steps) for steps, _ in self._rows.values() if steps is not self._steps)
        history.stepped_sequence = self._stepped.values("sequence")
        history.steps, history.truths = self._steps.values(), self._truths.values()
        for rows, valid in ((self._steps, history.steps), (self._truths, history.truths)):
            history.excluded_messages += len(rows) - len(valid.sequence)
        for name in ("sequence", "publish_time_ns", "stroke_nm", "limits"):
            setattr(history.mirror, name, self._mirror.values(name))
        history.timed_sequence, history.stages_ns = self._timings.values()
        if self._cameras:
            steps, considered = history.steps, history.under_calibration
            if (closed := considered & (steps.mode == LoopMode.CLOSED)).any():
                considered = closed
            begun_ns = np.maximum.accumulate([float(from_timestamp(state.timestamp)) for _, state in self._cameras])
            settings = np.array([settings for settings, _ in self._cameras])
            # Index of the first state with the same settings; a camera may return to earlier settings.
            first = np.array([np.isclose(settings, row, rtol=0.01, atol=0).all(axis=1).argmax() for row in settings])
            in_force = first[np.maximum(np.searchsorted(begun_ns, steps.time_ns) - 1, 0)]
            most_frequent = np.bincount(in_force[considered]).argmax() if considered.any() else first[-1]
            history.camera = self._cameras[np.flatnonzero(first == most_frequent)[-1]][1]
            history.under_camera = in_force == most_frequent

    def _last_calibration(self) -> Calibration | None:
        history = self._history
        if self._calibration is not None:
            with raised_as(DataFileError, ValueError, history.log.path):
                return decode_calibration(self._calibration)
        calibration_id = history.controller.calibration_id if history.controller is not None else ""
        attached = attached_calibration(history.log, calibration_id) if calibration_id else None
        if attached is not None:
            history.remarks.append(
                f"{history.log.path}: the message of its calibration is lost; the attached one is used"
            )
        return attached


def measured_timing(timing: Timing, steps: Steps, applied: Sequences, applied_ns: Integers, rate_hz: float) -> Timing:
    """Timing if the commands of the frames `applied` were applied at `applied_ns`, ns of the camera's clock."""
    rows = rows_of(applied, steps.sequence)
    if not (rows >= 0).any():
        return timing
    waited_ns = (applied_ns - steps.time_ns[rows])[rows >= 0]
    return Timing.measured(timing.delay, timing.exposure, float(np.median(waited_ns)) * 1e-9 * rate_hz)
