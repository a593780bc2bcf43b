"""Reading a log into a history."""

import tempfile
from array import array
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.adapters.bus import name_in
from lowfc.adapters.history import STAGES, History, MirrorStates, Steps, Truths
from lowfc.adapters.log_reader import Logged, LogReader
from lowfc.contract.calibration_codec import decode_calibration
from lowfc.contract.codec import actuators
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import DataFileError
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
    from_timestamp,
    topic_of,
    wire,
)

Single = npt.NDArray[np.float32]

_BITS = 63  # of a column of whole numbers, but for the sign
_LAST_NS = (1 << _BITS) - 1


def read_history(log: LogReader, progress: Callable[[int], None] | None = None) -> History:
    """Read a log to its end.

    Args:
        log: a reader that has not been read.
        progress: called now and then with the number of messages read so far.

    Raises:
        DataFileError: as `LogReader`, or the log has a calibration or a configuration that cannot be read.
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


def attached_configuration(log: LogReader) -> Configuration | None:
    """The configuration that a log was recorded with; None where it has none.

    Raises:
        ConfigurationError: this version cannot read it.
    """
    content = next((data for name, data in log.attachments.items() if name.endswith(".toml")), None)
    if content is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.toml"
        path.write_bytes(content)
        return load(path)


class _Columns:
    """Columns that grow by rows: whole numbers, and vectors of one length."""

    def __init__(self, **kinds: str) -> None:
        self._columns = {name: array(kind) for name, kind in kinds.items()}

    def add(self, **values: int | float | Iterable[int | float]) -> None:
        """Add to every column, or to none.

        Raises:
            OverflowError: a value is beyond what its column can hold.
        """
        added: dict[str, array[Any]] = {
            name: array(self._columns[name].typecode, (value,) if isinstance(value, int | float) else value)
            for name, value in values.items()
        }
        for name, more in added.items():
            self._columns[name].extend(more)

    def taken(self, name: str, width: int | None = None) -> npt.NDArray[Any]:
        column = np.array(self._columns[name])
        return column if width is None else column.reshape(len(self._columns["sequence"]), width)


class _Gathered:
    """What has been read so far."""

    def __init__(self) -> None:
        self.calibration: wire.Calibration | None = None
        self.controllers: list[wire.ControllerState] = []
        self.camera: wire.CameraState | None = None
        self.requests: list[wire.Request] = []
        self.events: list[tuple[int, Log]] = []
        self.health: dict[str, wire.Health] = {}
        self.counts: Counter[str] = Counter()
        self.span_ns = (0, 0)
        self.modes = 0
        self.left_out = 0
        self.frames = _Columns(sequence="Q", publish_ns="q")
        self.commands = _Columns(publish_ns="q")
        self.timings = _Columns(sequence="Q", **dict.fromkeys(STAGES, "q"))
        self.mirror = _Columns(sequence="Q", publish_ns="q", stroke_nm="f", limits="q")
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
        step = wire.ControlStep.FromString(message.payload)
        nothing, modes = self._nothing, self.modes
        error_nm, pol_nm = step.error_nm or nothing, step.pol_nm or nothing
        if not len(step.command_nm) == len(error_nm) == len(pol_nm) == modes:
            self.left_out += 1
            return
        self.steps.add(
            sequence=step.frame_sequence,
            time_ns=from_timestamp(step.timestamp),
            mode=step.mode,
            reasons=_bits(step.reasons),
            error_nm=error_nm,
            pol_nm=pol_nm,
            command_nm=step.command_nm,
            flux_dn=step.flux_dn,
            saturated_pixels=step.saturated_pixels,
        )

    def truth(self, message: Logged) -> None:
        truth = wire.Truth.FromString(message.payload)
        if len(truth.residual_nm) == len(truth.disturbance_nm) == self.modes:
            self.truths.add(
                sequence=truth.frame_sequence,
                disturbance_nm=truth.disturbance_nm,
                residual_nm=truth.residual_nm,
                disturbance_rms_nm=truth.disturbance_rms_nm,
                residual_rms_nm=truth.residual_rms_nm,
            )

    def timing(self, message: Logged) -> None:
        timing = wire.ControlTiming.FromString(message.payload)
        stages = {one: getattr(timing, f"{one}_ns") for one in STAGES}
        if all(len(stage) == len(timing.frame_sequence) for stage in stages.values()):
            self.timings.add(sequence=timing.frame_sequence, **stages)

    def mirror_state(self, message: Logged) -> None:
        state = wire.MirrorState.FromString(message.payload)
        surface = actuators(state)
        if surface is None:
            return
        self.mirror.add(
            sequence=state.frame_sequence,
            publish_ns=message.publish_time_ns,
            stroke_nm=float(np.abs(surface).max()),
            limits=_bits(state.limits_hit),
        )
        if self.highest_nm is None or self.lowest_nm is None or self.highest_nm.shape != surface.shape:
            self.highest_nm, self.lowest_nm = surface.copy(), surface.copy()
        np.maximum(self.highest_nm, surface, out=self.highest_nm)
        np.minimum(self.lowest_nm, surface, out=self.lowest_nm)

    def calibrate(self, message: Logged) -> None:
        self.calibration = wire.Calibration.FromString(message.payload)
        modes = len(self.calibration.noll)
        if modes != self.modes:
            self.left_out += len(self.steps.taken("sequence"))
            self.modes = modes
            self._forget_steps()

    def state(self, message: Logged) -> None:
        self.controllers.append(wire.ControllerState.FromString(message.payload))

    def camera_state(self, message: Logged) -> None:
        self.camera = wire.CameraState.FromString(message.payload)

    def request(self, message: Logged) -> None:
        self.requests.append(wire.Request.FromString(message.payload))

    def event(self, message: Logged) -> None:
        self.events.append((message.log_time_ns, Log.FromString(message.payload)))

    def health_of(self, message: Logged) -> None:
        self.health[name_in(HEALTH, message.key)] = wire.Health.FromString(message.payload)

    def history(self, log: LogReader) -> History:
        """Everything as arrays."""
        modes, steps, truths, mirror = self.modes, self.steps, self.truths, self.mirror
        empty = np.zeros((0, 0), np.float32)
        try:
            calibration = decode_calibration(self.calibration) if self.calibration is not None else None
        except ValueError as error:
            raise DataFileError(f"{log.path}: {error}") from None
        return History(
            log=log,
            configuration=attached_configuration(log),
            calibration=calibration,
            controllers=self.controllers,
            camera=self.camera,
            frame_sequence=self.frames.taken("sequence"),
            frame_publish_ns=self.frames.taken("publish_ns"),
            command_publish_ns=self.commands.taken("publish_ns"),
            steps=Steps(
                sequence=steps.taken("sequence"),
                time_ns=steps.taken("time_ns"),
                mode=steps.taken("mode"),
                reasons=steps.taken("reasons"),
                error_nm=steps.taken("error_nm", modes),
                pol_nm=steps.taken("pol_nm", modes),
                command_nm=steps.taken("command_nm", modes),
                flux_dn=steps.taken("flux_dn"),
                saturated_pixels=steps.taken("saturated_pixels"),
            ),
            truths=Truths(
                sequence=truths.taken("sequence"),
                disturbance_nm=truths.taken("disturbance_nm", modes),
                residual_nm=truths.taken("residual_nm", modes),
                disturbance_rms_nm=truths.taken("disturbance_rms_nm"),
                residual_rms_nm=truths.taken("residual_rms_nm"),
            ),
            mirror=MirrorStates(
                sequence=mirror.taken("sequence"),
                publish_time_ns=mirror.taken("publish_ns"),
                stroke_nm=mirror.taken("stroke_nm"),
                limits=mirror.taken("limits"),
                highest_nm=self.highest_nm if self.highest_nm is not None else empty,
                lowest_nm=self.lowest_nm if self.lowest_nm is not None else empty,
            ),
            timed_sequence=self.timings.taken("sequence"),
            stages_ns={stage: self.timings.taken(stage) for stage in STAGES},
            left_out=self.left_out,
            requests=self.requests,
            events=self.events,
            health=self.health,
            counts=self.counts,
            span_ns=self.span_ns,
        )

    def _forget_steps(self) -> None:
        self._nothing = [np.nan] * self.modes
        self.steps = _Columns(
            sequence="Q",
            time_ns="q",
            mode="B",
            reasons="q",
            error_nm="f",
            pol_nm="f",
            command_nm="f",
            flux_dn="f",
            saturated_pixels="q",
        )
        self.truths = _Columns(
            sequence="Q", disturbance_nm="f", residual_nm="f", disturbance_rms_nm="f", residual_rms_nm="f"
        )


def _bits(reasons: Iterable[int]) -> int:
    """Bit `1 << reason` for each.

    Raises:
        OverflowError: there is no such bit.
    """
    bits = 0
    for reason in reasons:
        if not 0 <= reason < _BITS:
            raise OverflowError(f"a reason is a bit below {_BITS}; got {reason}")
        bits |= 1 << reason
    return bits


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
    EVENT.key: _Gathered.event,
    HEALTH.key: _Gathered.health_of,
}
