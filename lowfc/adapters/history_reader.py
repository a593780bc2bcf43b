"""Reading a log into a history."""

from collections import Counter
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.adapters.bus import name_in
from lowfc.adapters.history import History, MirrorStates
from lowfc.adapters.log_reader import Logged, LogReader
from lowfc.adapters.rows import Columns, StepRows, TimingRows, TruthRows, bits_of
from lowfc.contract.calibration_codec import decode_calibration
from lowfc.contract.codec import actuators
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
    topic_of,
    wire,
)
from lowfc.contract.published import Published
from lowfc.contract.recorded_configuration import recorded

Single = npt.NDArray[np.float32]

_LAST_NS = (1 << 63) - 1


def read_history(log: LogReader, progress: Callable[[int], None] | None = None) -> History:
    """Read a log to its end.

    Args:
        log: a reader that has not been read.
        progress: called now and then with the number of messages read so far.

    Raises:
        DataFileError: as `LogReader`, or the log has a calibration that cannot be read.
    """
    gathered = _Gathered()
    number = 0
    for number, message in enumerate(log, 1):
        gathered.take(message)
        if progress is not None and number % 5000 == 0:
            progress(number)
    if progress is not None:
        progress(number)
    return gathered.history(log)


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


class _Gathered:
    """What has been read so far."""

    def __init__(self) -> None:
        self.calibration: wire.Calibration | None = None
        self.controllers: list[wire.ControllerState] = []
        self.camera: wire.CameraState | None = None
        self.requests: list[wire.Request] = []
        self.published = Published()
        self.events: list[tuple[int, Log]] = []
        self.health: dict[str, wire.Health] = {}
        self.counts: Counter[str] = Counter()
        self.span_ns = (0, 0)
        self.modes = 0
        self.left_out = 0
        self.frames = Columns(sequence="Q", publish_ns="q")
        self.commands = Columns(publish_ns="q")
        self.timings = TimingRows()
        self.mirror = Columns(sequence="Q", publish_ns="q", stroke_nm="f", limits="q")
        self.highest_nm: Single | None = None
        self.lowest_nm: Single | None = None
        self._forget_steps()

    def take(self, message: Logged) -> None:
        """Take one message of the log."""
        if max(message.log_time_ns, message.publish_time_ns) > _LAST_NS:
            self.left_out += 1
            return
        first_ns, _ = self.span_ns
        self.span_ns = (first_ns or message.log_time_ns, message.log_time_ns)
        self.counts[message.key] += 1
        try:
            topic = topic_of(message.key)
            handle = _TAKE.get(topic.key)
            if handle is not None:
                handle(self, message)
        except (KeyError, DecodeError):
            return  # a message that nobody of the loop could read either
        except OverflowError:
            self.left_out += 1  # protobuf allows it, and nobody of the loop sends it

    def frame(self, message: Logged) -> None:
        self.frames.add(sequence=message.sequence, publish_ns=message.publish_time_ns)

    def command(self, message: Logged) -> None:
        self.commands.add(publish_ns=message.publish_time_ns)

    def step(self, message: Logged) -> None:
        self.left_out += not self.steps.add(wire.ControlStep.FromString(message.payload))

    def truth(self, message: Logged) -> None:
        self.truths.add(wire.Truth.FromString(message.payload))

    def timing(self, message: Logged) -> None:
        self.timings.add(wire.ControlTiming.FromString(message.payload))

    def mirror_state(self, message: Logged) -> None:
        state = wire.MirrorState.FromString(message.payload)
        surface = actuators(state)
        if surface is None:
            return
        self.mirror.add(
            sequence=state.frame_sequence,
            publish_ns=message.publish_time_ns,
            stroke_nm=float(np.abs(surface).max()),
            limits=bits_of(state.limits_hit),
        )
        if self.highest_nm is None or self.lowest_nm is None or self.highest_nm.shape != surface.shape:
            self.highest_nm, self.lowest_nm = surface.copy(), surface.copy()
        np.maximum(self.highest_nm, surface, out=self.highest_nm)
        np.minimum(self.lowest_nm, surface, out=self.lowest_nm)

    def calibrate(self, message: Logged) -> None:
        self.calibration = wire.Calibration.FromString(message.payload)
        modes = len(self.calibration.noll)
        if modes != self.modes:
            self.left_out += len(self.steps)
            self.modes = modes
            self._forget_steps()

    def state(self, message: Logged) -> None:
        self.controllers.append(wire.ControllerState.FromString(message.payload))

    def camera_state(self, message: Logged) -> None:
        self.camera = wire.CameraState.FromString(message.payload)

    def law(self, message: Logged) -> None:
        self.published.take(LAW, message.payload)

    def play(self, message: Logged) -> None:
        self.published.take(PLAY, message.payload)

    def request(self, message: Logged) -> None:
        self.requests.append(wire.Request.FromString(message.payload))

    def event(self, message: Logged) -> None:
        self.events.append((message.log_time_ns, Log.FromString(message.payload)))

    def health_of(self, message: Logged) -> None:
        self.health[name_in(HEALTH, message.key)] = wire.Health.FromString(message.payload)

    def history(self, log: LogReader) -> History:
        """Everything as arrays."""
        mirror = self.mirror
        empty = np.zeros((0, 0), np.float32)
        timed_sequence, stages_ns = self.timings.taken()
        configuration, remarks = attached_configuration(log)
        try:
            calibration = decode_calibration(self.calibration) if self.calibration is not None else None
        except ValueError as error:
            raise DataFileError(f"{log.path}: {error}") from None
        return History(
            log=log,
            configuration=configuration,
            remarks=remarks,
            calibration=calibration,
            controllers=self.controllers,
            camera=self.camera,
            frame_sequence=self.frames.taken("sequence"),
            frame_publish_ns=self.frames.taken("publish_ns"),
            command_publish_ns=self.commands.taken("publish_ns"),
            steps=self.steps.taken(),
            truths=self.truths.taken(),
            mirror=MirrorStates(
                sequence=mirror.taken("sequence"),
                publish_time_ns=mirror.taken("publish_ns"),
                stroke_nm=mirror.taken("stroke_nm"),
                limits=mirror.taken("limits"),
                highest_nm=self.highest_nm if self.highest_nm is not None else empty,
                lowest_nm=self.lowest_nm if self.lowest_nm is not None else empty,
            ),
            timed_sequence=timed_sequence,
            stages_ns=stages_ns,
            left_out=self.left_out,
            requests=self.requests,
            events=self.events,
            health=self.health,
            counts=self.counts,
            published=self.published,
            span_ns=self.span_ns,
        )

    def _forget_steps(self) -> None:
        self.steps = StepRows(self.modes)
        self.truths = TruthRows(self.modes)


_TAKE: dict[str, Callable[[_Gathered, Logged], None]] = {
    FRAME.key: _Gathered.frame,
    STEP.key: _Gathered.step,
    COMMAND.key: _Gathered.command,
    TIMING.key: _Gathered.timing,
    TRUTH.key: _Gathered.truth,
    MIRROR_STATE.key: _Gathered.mirror_state,
    CALIBRATION.key: _Gathered.calibrate,
    CAMERA_STATE.key: _Gathered.camera_state,
    CONTROLLER_STATE.key: _Gathered.state,
    REQUEST.key: _Gathered.request,
    LAW.key: _Gathered.law,
    PLAY.key: _Gathered.play,
    EVENT.key: _Gathered.event,
    HEALTH.key: _Gathered.health_of,
}
