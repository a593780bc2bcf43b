"""Between the values of the numerics and the messages of the bus, both ways."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.contract.calibration_codec import decode_calibration
from lowfc.contract.law_codec import law_of, wire_law
from lowfc.contract.messages import MONO16, RawImage, floats, from_timestamp, timestamp, wire
from lowfc.control.calibration import Calibration
from lowfc.control.durations import Durations
from lowfc.control.inputs import CameraSettings, Command, Frame, Input, Load, MirrorShape, Reply, Request, Step, Tick
from lowfc.control.safety import LoopMode, Reason

Single = npt.NDArray[np.float32]

_PIXEL = np.dtype("<u2")  # read from its name, it would cost every frame 0.2 us


def decode_frame(payload: bytes, sequence: int, age_ns: int) -> Frame:
    """Frame of a RawImage; its pixels are None where the message holds no whole mono16 image."""
    try:
        image = RawImage.FromString(payload)
    except DecodeError:
        return Frame(sequence, 0, age_ns, None)
    pixels, data = None, image.data  # each look at it makes a copy
    rows, columns, step = image.height, image.width, image.step
    if image.encoding == MONO16 and step == 2 * columns and len(data) == step * rows > 0:
        pixels = np.frombuffer(data, _PIXEL).reshape(rows, columns)
    return Frame(sequence, from_timestamp(image.timestamp), age_ns, pixels)


def encode_step(step: Step, taken: int) -> bytes:
    """ControlStep of a step, made from input number `taken`."""
    message = wire.ControlStep(
        timestamp=timestamp(step.time_ns),
        frame_sequence=step.frame_sequence,
        mode=wire_mode(step.mode),
        error_nm=[] if step.error_nm is None else step.error_nm.tolist(),
        pol_nm=[] if step.pol_nm is None else step.pol_nm.tolist(),
        command_nm=step.command_nm.tolist(),
        reasons=wire_reasons(step.reasons),
        flux_dn=step.flux_dn,
        saturated_pixels=step.saturated_pixels,
        taken=taken,
    )
    return message.SerializeToString()


def encode_command(command: Command, valid_for_ns: int, channel: str, taken: int) -> bytes:
    """MirrorCommand of a command, made from input number `taken`."""
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
        taken=taken,
    )
    return message.SerializeToString()


def actuators(message: wire.MirrorCommand | wire.MirrorState) -> Single | None:
    """Actuators (rows, columns) of a message; None where the bytes are not that many float32."""
    if len(message.actuators) != 4 * message.rows * message.columns or not message.actuators:
        return None
    return floats(message.actuators, message.rows, message.columns)


def decode_mirror(payload: bytes) -> MirrorShape | None:
    """Shape of a MirrorState; None where it is none."""
    try:
        return _mirror_shape(wire.MirrorState.FromString(payload))
    except DecodeError:
        return None


def decode_camera(payload: bytes) -> CameraSettings | None:
    """What of a CameraState must fit the calibration; None where the message cannot be read, or is of no camera."""
    try:
        found = _camera_settings(wire.CameraState.FromString(payload))
    except DecodeError:
        return None
    return found if all(found.shape) else None


def encode_input(taken: MirrorShape | CameraSettings | Load | Tick, number: int) -> bytes:
    """ControlInput of what the controller took in as its input `number`."""
    time = timestamp(taken.time_ns)
    message = wire.ControlInput(timestamp=time, taken=number)
    match taken:
        case MirrorShape():
            rows, columns = taken.actuators_nm.shape
            mirror = wire.MirrorState(timestamp=time, rows=rows, columns=columns, command_nm=taken.command_nm.tolist())
            mirror.actuators = taken.actuators_nm.tobytes()
            message.mirror.CopyFrom(mirror)
        case CameraSettings():
            rows, columns = taken.shape
            camera = wire.CameraState(timestamp=time, rows=rows, columns=columns)
            camera.bias_dn, camera.saturation_dn = taken.bias_dn, taken.saturation_dn
            message.camera.CopyFrom(camera)
        case Load():
            message.load.CopyFrom(wire.Load(timestamp=time, calibration_id=taken.calibration.id, source=taken.source))
        case Tick():
            message.tick.CopyFrom(wire.Tick(timestamp=time, silent_ns=max(0, taken.silent_ns)))
    return message.SerializeToString()


def decode_input(message: wire.ControlInput, calibrations: Mapping[str, Calibration]) -> Input:
    """What the controller took in.

    Raises:
        ValueError: it is an input that this version does not know, or its calibration is not among these (by id).
    """
    match message.WhichOneof("input"):
        case "mirror":
            shape = _mirror_shape(message.mirror)
            if shape is not None:
                return shape
        case "camera":
            return _camera_settings(message.camera)
        case "tick":
            return Tick(from_timestamp(message.timestamp), message.tick.silent_ns)
        case "load" if message.load.calibration_id in calibrations:
            calibration = calibrations[message.load.calibration_id]
            return Load(from_timestamp(message.timestamp), calibration, message.load.source)
    raise ValueError(f"input {message.taken} of the controller cannot be read")


def _mirror_shape(state: wire.MirrorState) -> MirrorShape | None:
    surface = actuators(state)
    if surface is None:
        return None
    return MirrorShape(from_timestamp(state.timestamp), surface, np.array(state.command_nm, dtype=np.float32))


def _camera_settings(state: wire.CameraState) -> CameraSettings:
    shape = (state.rows, state.columns)
    return CameraSettings(from_timestamp(state.timestamp), shape, state.bias_dn, state.saturation_dn)


def decode_request(payload: bytes, name: str, time_ns: int) -> Request:
    """Request under a key's name.

    Raises:
        ValueError: the payload cannot be read, or what it holds is not whole.
    """
    try:
        message = wire.Request.FromString(payload)
    except DecodeError:
        raise ValueError("the request could not be read") from None
    return request(message, name, time_ns)


def request(
    message: wire.Request, name: str, time_ns: int, calibrations: Mapping[str, Calibration] = MappingProxyType({})
) -> Request:
    """Request of a message; of a logged one, whose calibration is no more than an identity, it is one of those.

    Raises:
        ValueError: what it holds is not whole.
    """
    calibration = None
    if message.HasField("calibration"):
        known = calibrations.get(message.calibration.id)
        calibration = decode_calibration(message.calibration) if known is None else known
    return Request(
        time_ns,
        name,
        tuple(message.modes),
        tuple(message.values),
        message.text,
        floats(message.actuators, -1),
        floats(message.table, -1, message.columns or 1),
        law_of(message.law) if message.HasField("law") else None,
        calibration,
    )


def encode_request(request: Request, reply: Reply, taken: int, state: wire.ControllerState | None) -> bytes:
    """Request with its answer; it was input number `taken`, or 0 where it could not be read."""
    message = wire.Request(
        timestamp=timestamp(request.time_ns),
        name=request.name,
        modes=request.modes,
        values=request.values,
        accepted=reply.accepted,
        reply=reply.text,
        frame_sequence=reply.frame_sequence,
        state=state,
        taken=taken,
        text=request.text,
        actuators=request.actuators_nm.tobytes(),
        table=request.table.tobytes(),
        columns=request.table.shape[1] if request.table.size else 0,
        law=None if request.law is None else wire_law(request.law),
        calibration=None if request.calibration is None else wire.Calibration(id=request.calibration.id),
    )
    return message.SerializeToString()


def encode_offload(step: Step, noll: tuple[int, ...], mean_nm: npt.NDArray[np.float64], frames: int) -> bytes:
    """ModalOffload of the mean modal command (modes,) over some frames, of which the last one made `step`."""
    message = wire.ModalOffload(
        timestamp=timestamp(step.time_ns),
        frame_sequence=step.frame_sequence,
        noll=noll,
        command_nm=mean_nm.tolist(),
        frames=frames,
    )
    return message.SerializeToString()


def wire_mode(mode: LoopMode) -> wire.LoopMode:
    """A loop mode as on the wire."""
    return mode.value  # type: ignore[return-value]  # numbered alike, which a test holds


def wire_reasons(reasons: tuple[Reason, ...]) -> list[wire.Reason]:
    """Reasons as on the wire."""
    return [reason.value for reason in reasons]  # type: ignore[misc]  # numbered alike, which a test holds


def latency(durations: Durations) -> wire.Latency:
    """Percentiles as a message."""
    p50, p99, p99_9 = durations.percentiles_ns(0.5, 0.99, 0.999)
    return wire.Latency(count=durations.count, p50_ns=p50, p99_ns=p99, p99_9_ns=p99_9, max_ns=durations.max_ns)
