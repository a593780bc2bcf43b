"""Between the values of the numerics and the messages of the bus, both ways."""

import hashlib
from dataclasses import fields, replace

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.contract.messages import MONO16, RawImage, from_timestamp, timestamp, wire
from lowfc.control.calibration import Calibration
from lowfc.control.durations import Durations
from lowfc.control.inputs import CameraSettings, Command, Frame, MirrorShape, Reply, Request, Step
from lowfc.control.safety import LoopMode, Reason
from lowfc.control.state import State
from lowfc.optics.zernike import mode_name

Single = npt.NDArray[np.float32]


def decode_frame(payload: bytes, sequence: int, age_ns: int) -> Frame:
    """Frame of a RawImage; its pixels are None where the message holds no whole mono16 image."""
    try:
        image = RawImage.FromString(payload)
    except DecodeError:
        return Frame(sequence, 0, age_ns, None)
    pixels = None
    whole = image.step == 2 * image.width and len(image.data) == image.step * image.height > 0
    if image.encoding == MONO16 and whole:
        pixels = np.frombuffer(image.data, dtype="<u2").reshape(image.height, image.width)
    return Frame(sequence, from_timestamp(image.timestamp), age_ns, pixels)


def encode_step(step: Step) -> bytes:
    """ControlStep of a step."""
    message = wire.ControlStep(
        timestamp=timestamp(step.time_ns),
        frame_sequence=step.frame_sequence,
        mode=_mode(step.mode),
        error_nm=[] if step.error_nm is None else step.error_nm.tolist(),
        pol_nm=[] if step.pol_nm is None else step.pol_nm.tolist(),
        command_nm=step.command_nm.tolist(),
        reasons=_reasons(step.reasons),
        flux_dn=step.flux_dn,
        saturated_pixels=step.saturated_pixels,
    )
    return message.SerializeToString()


def encode_command(command: Command, valid_for_ns: int, channel: str) -> bytes:
    """MirrorCommand of a command."""
    rows, columns = command.actuators_nm.shape
    message = wire.MirrorCommand(
        timestamp=timestamp(command.time_ns),
        frame_sequence=command.frame_sequence,
        channel=channel,
        valid_for_ns=valid_for_ns,
        rows=rows,
        columns=columns,
        actuators=command.actuators_nm.tobytes(),
        command_nm=command.command_nm.tolist(),
    )
    return message.SerializeToString()


def actuators(message: wire.MirrorCommand | wire.MirrorState) -> Single | None:
    """Actuators (rows, columns) of a message; None where the bytes are not that many float32."""
    if len(message.actuators) != 4 * message.rows * message.columns or not message.actuators:
        return None
    return np.frombuffer(message.actuators, dtype="<f4").reshape(message.rows, message.columns)


def decode_mirror(payload: bytes) -> MirrorShape | None:
    """Shape of a MirrorState; None where it is none."""
    try:
        state = wire.MirrorState.FromString(payload)
    except DecodeError:
        return None
    surface = actuators(state)
    if surface is None:
        return None
    return MirrorShape(from_timestamp(state.timestamp), surface, np.array(state.command_nm, dtype=np.float32))


def decode_camera(payload: bytes) -> CameraSettings | None:
    """What of a CameraState must fit the calibration; None where the message cannot be read."""
    try:
        state = wire.CameraState.FromString(payload)
    except DecodeError:
        return None
    return CameraSettings(
        from_timestamp(state.timestamp), (state.rows, state.columns), state.bias_dn, state.saturation_dn
    )


def decode_request(payload: bytes, name: str, time_ns: int) -> Request | None:
    """Request under a key's name; None where the payload cannot be read."""
    try:
        message = wire.Request.FromString(payload)
    except DecodeError:
        return None
    return Request(time_ns, name, tuple(message.modes), tuple(message.values))


def encode_request(request: Request, reply: Reply, state: wire.ControllerState | None) -> bytes:
    """Request with its answer."""
    message = wire.Request(
        timestamp=timestamp(request.time_ns),
        name=request.name,
        modes=request.modes,
        values=request.values,
        accepted=reply.accepted,
        reply=reply.text,
        frame_sequence=reply.frame_sequence,
        state=state,
    )
    return message.SerializeToString()


def controller_state(state: State, delay_frames: float, time_ns: int) -> wire.ControllerState:
    """Everything the next command depends on, as a message."""
    message = wire.ControllerState(
        timestamp=timestamp(time_ns),
        frame_sequence=state.frame_sequence,
        mode=_mode(state.mode),
        delay_frames=delay_frames,
        counts=reason_counts(state),
        frames_used=state.frames_used,
    )
    if state.drive is not None:
        message.calibration_id = state.drive.calibration.id
        message.gain.extend(state.drive.law.gain.tolist())
        message.leak.extend(state.drive.law.leak.tolist())
        message.limit_nm.extend(state.drive.law.limit_nm.tolist())
        message.command_history_nm.extend(np.concatenate(state.drive.history_nm).tolist())
        message.actuators = state.drive.actuators_nm.tobytes()
    return message


def reason_counts(state: State) -> list[wire.ReasonCount]:
    """How often each reason was given."""
    pairs = zip(_reasons(tuple(state.counts)), state.counts.values(), strict=True)
    return [wire.ReasonCount(reason=reason, count=count) for reason, count in pairs]


def encode_calibration(calibration: Calibration, time_ns: int) -> bytes:
    """Calibration as a message."""
    message = wire.Calibration(
        timestamp=timestamp(time_ns),
        id=calibration.id,
        operator_hash=calibration.operator_hash,
        estimator=calibration.estimator,
        noll=calibration.noll,
        mode_names=[mode_name(index) for index in calibration.noll],
        wavelength_nm=calibration.wavelength_nm,
        rows=calibration.shape[0],
        columns=calibration.shape[1],
        reference=calibration.reference.tobytes(),
        response=calibration.response.tobytes(),
        reconstructor=calibration.reconstructor.tobytes(),
        mask=calibration.good.astype(np.uint8).tobytes(),
        dark=calibration.dark.tobytes(),
        flux_dn=calibration.flux_dn,
        saturation_dn=calibration.saturation_dn,
        mirror_rows=calibration.grid[0],
        mirror_columns=calibration.grid[1],
        modes_to_actuators=calibration.modes_to_actuators.tobytes(),
    )
    return message.SerializeToString()


def identified(calibration: Calibration) -> Calibration:
    """The same calibration with its identity: SHA-256 of everything else in it."""
    digest = hashlib.sha256()
    for part in fields(calibration):
        if part.name != "id":
            value = getattr(calibration, part.name)
            digest.update(part.name.encode())
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return replace(calibration, id=digest.hexdigest())


def _mode(mode: LoopMode) -> wire.LoopMode:
    return mode.value  # type: ignore[return-value]  # numbered alike, which a test holds


def _reasons(reasons: tuple[Reason, ...]) -> list[wire.Reason]:
    return [reason.value for reason in reasons]  # type: ignore[misc]  # numbered alike, which a test holds


def latency(durations: Durations) -> wire.Latency:
    """Percentiles as a message."""
    p50, p99, p99_9 = durations.percentiles_ns(0.5, 0.99, 0.999)
    return wire.Latency(count=durations.count, p50_ns=p50, p99_ns=p99, p99_9_ns=p99_9, max_ns=durations.max_ns)
