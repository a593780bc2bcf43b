"""Between the values of the numerics and the messages of the bus, both ways."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.arrays import Single
from lowfc.contract.codecs.bench_codec import report_of, wire_report
from lowfc.contract.codecs.calibration_codec import camera_settings, decode_calibration, wire_camera
from lowfc.contract.codecs.law_codec import law_header, law_of, wire_law
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import (
    MONO16,
    RawImage,
    checked_sequence,
    checked_time_ns,
    floats,
    from_timestamp,
    timestamp,
    wire,
)
from lowfc.contract.printable import printable
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.durations import Durations
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.command_channels import PlayTable
from lowfc.control.loop.inputs import (
    Command,
    Frame,
    Input,
    Load,
    MirrorReport,
    MirrorShape,
    Reply,
    Report,
    Request,
    Step,
    Tick,
)
from lowfc.control.loop.interlocks import BenchReport
from lowfc.control.loop.safety import LoopMode, Reason
from lowfc.control.loop.wording import MOST_TEXT

_PIXEL = np.dtype("<u2")  # read from its name, it would cost every frame 0.2 us


def decode_frame(payload: bytes, sequence: int, age_ns: int, *, ahead: bool = False) -> Frame:
    """Frame of a RawImage; its pixels are None where the message holds no whole mono16 image.

    BadMessageError where its time or its sequence cannot be.
    """
    checked_sequence(sequence)
    try:
        image = RawImage.FromString(payload)
    except DecodeError:
        return Frame(sequence, 0, age_ns, None, ahead)
    pixels, data = None, image.data  # each look at it makes a copy
    rows, columns, step = image.height, image.width, image.step
    if image.encoding == MONO16 and step == 2 * columns and len(data) == step * rows > 0:
        pixels = np.frombuffer(data, _PIXEL).reshape(rows, columns)
    return Frame(sequence, checked_time_ns(image.timestamp), age_ns, pixels, ahead)


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
        input_number=taken,
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
        input_number=taken,
        safe=command.safe,
        clear_id=command.clear_id,
    )
    return message.SerializeToString()


def actuators(message: wire.MirrorCommand | wire.MirrorState) -> Single | None:
    """Actuators (rows, columns) of a message; None where the bytes are not that many float32."""
    if len(message.actuators) != 4 * message.rows * message.columns or not message.actuators:
        return None
    return floats(message.actuators, message.rows, message.columns)


def decode_mirror(payload: bytes) -> MirrorShape | None:
    """Shape of a MirrorState; None where it is none, BadMessageError where its time cannot be."""
    try:
        state = wire.MirrorState.FromString(payload)
    except DecodeError:
        return None
    checked_time_ns(state.timestamp)
    return _mirror_shape(state)


def decode_camera(payload: bytes, start_s: int) -> CameraSettings:
    """What of a CameraState must fit the calibration; it was published by a camera that started at `start_s`.

    BadMessageError where it cannot be read, is of no camera, or a number in it cannot be.
    """
    try:
        state = wire.CameraState.FromString(payload)
    except DecodeError as error:
        raise BadMessageError(str(error)) from None
    checked_time_ns(state.timestamp)
    found = camera_settings(state, start_s)
    levels = (found.bias_dn, found.saturation_dn, found.gain_e_per_dn, found.em_gain, found.read_noise_e)
    if not all(found.shape) or not np.isfinite(levels).all():
        raise BadMessageError("these are the settings of no camera")
    return found


def encode_input(taken: Report, number: int) -> bytes:
    """ControlInput of what the controller took in as its input `number`."""
    time = timestamp(taken.time_ns)
    message = wire.ControlInput(timestamp=time, input_number=number)
    match taken:
        case MirrorShape():
            message.mirror.CopyFrom(_wire_shape(taken))
        case MirrorReport():
            message.mirror_report.CopyFrom(wire.MirrorReport(timestamp=time, fault=taken.fault))
            if taken.shape is not None:
                message.mirror_report.mirror.CopyFrom(_wire_shape(taken.shape))
        case BenchReport():
            message.bench_report.CopyFrom(wire_report(taken))
        case CameraSettings():
            message.camera.CopyFrom(wire_camera(taken))
        case Load():
            message.load.CopyFrom(wire.Load(timestamp=time, calibration_id=taken.calibration.id, source=taken.source))
        case Tick():
            message.tick.CopyFrom(wire.Tick(timestamp=time, silent_ns=max(0, taken.silent_ns)))
    return message.SerializeToString()


def decode_input(message: wire.ControlInput, calibrations: Mapping[str, Calibration]) -> Input:
    """What the controller took in; ValueError where it is unknown, or its calibration not among these (by id)."""
    match message.WhichOneof("input"):
        case "mirror":
            shape = _mirror_shape(message.mirror)
            if shape is not None:
                return shape
        case "mirror_report":
            report = message.mirror_report
            shape = _mirror_shape(report.mirror) if report.HasField("mirror") else None
            return MirrorReport(from_timestamp(report.timestamp), report.fault, shape)
        case "camera":
            return camera_settings(message.camera)
        case "bench_report":
            return report_of(message.bench_report)
        case "tick":
            return Tick(from_timestamp(message.timestamp), message.tick.silent_ns)
        case "load" if message.load.calibration_id in calibrations:
            calibration = calibrations[message.load.calibration_id]
            return Load(from_timestamp(message.timestamp), calibration, message.load.source)
    raise ValueError(f"input {message.input_number} of the controller cannot be read")


def _wire_shape(shape: MirrorShape) -> wire.MirrorState:
    rows, columns = shape.actuators_nm.shape
    return wire.MirrorState(
        timestamp=timestamp(shape.time_ns),
        rows=rows,
        columns=columns,
        command_nm=shape.command_nm.tolist(),
        actuators=shape.actuators_nm.tobytes(),
        safe=shape.safe,
    )


def _mirror_shape(state: wire.MirrorState) -> MirrorShape | None:
    surface = actuators(state)
    if surface is None:
        return None
    command_nm = np.array(state.command_nm, dtype=np.float32)
    return MirrorShape(from_timestamp(state.timestamp), surface, command_nm, state.safe)


MOST_BYTES = 16_000_000
"""Of any request; the bus loses one that is far larger."""
_SMALL_BYTES = 8_000
MOST_REQUESTER = 100
"""Characters of a sender's name that are kept."""
_MOST_BYTES = {
    "channel": 4 * 128 * 128 + _SMALL_BYTES,
    "note": 4 * MOST_TEXT + _SMALL_BYTES,
    "play": MOST_BYTES,
    "law": MOST_BYTES,
    "load": MOST_BYTES,
}


def most_bytes(name: str) -> int:
    """Size that a request of this name may have; a larger one is refused before it is decoded."""
    return _MOST_BYTES.get(name, _SMALL_BYTES)


def requester_alone(payload: bytes) -> bytes:
    """A request of which nothing but its sender is kept, whatever it is."""
    try:
        return wire.Request(requester=wire.Request.FromString(payload[:_SMALL_BYTES]).requester).SerializeToString()
    except DecodeError:
        return b""


def decode_request(payload: bytes, name: str, time_ns: int) -> Request:
    """Request under a key's name; ValueError where it is too large, cannot be read, or holds what is not whole."""
    if len(payload) > most_bytes(name):
        raise ValueError(f"a request of this name holds at most {most_bytes(name)} bytes, got {len(payload)}")
    try:
        message = wire.Request.FromString(payload)
    except DecodeError:
        raise ValueError("the request could not be read") from None
    return request(message, name, time_ns)


def request(
    message: wire.Request,
    name: str,
    time_ns: int,
    calibrations: Mapping[str, Calibration] = MappingProxyType({}),
    laws: Mapping[str, LinearLaw] = MappingProxyType({}),
    plays: Mapping[str, PlayTable] = MappingProxyType({}),
) -> Request:
    """Request of a message; of a logged one, calibration, law and table are identities, and are among those.

    ValueError where what it holds is not whole.
    """
    table, basis = floats(message.table, -1, message.columns or 1), floats(message.actuators, -1)
    if message.play_id:
        if message.play_id not in plays:
            raise ValueError(f"the table {message.play_id[:12]} of a play is not there")
        known_table = plays[message.play_id]
        table, basis = known_table.rows, known_table.basis.reshape(-1)
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
        basis,
        table,
        law_of(message.law, laws) if message.HasField("law") else None,
        calibration,
        lease_id=message.lease_id,
        requester=printable(message.requester[:MOST_REQUESTER]),
        prior_nm2=tuple(message.prior_nm2),
        flux_dn=message.flux_dn,
    )


def encode_request(request: Request, reply: Reply, taken: int, state: wire.ControllerState | None) -> bytes:
    """Request with its answer; it was input number `taken`, or 0 where it could not be read.

    Of the law and the table of a request that was prepared, it has the identity: they are published by themselves.
    """
    played = request.played
    message = wire.Request(
        timestamp=timestamp(request.time_ns),
        name=request.name,
        modes=request.modes,
        values=request.values,
        accepted=reply.accepted,
        reply=reply.text,
        frame_sequence=reply.frame_sequence,
        state=state,
        input_number=taken,
        text=request.text,
        actuators=b"" if played is not None else request.actuators_nm.tobytes(),
        table=b"" if played is not None else request.table.tobytes(),
        columns=request.table.shape[1] if request.table.size else 0,
        law=None if request.law is None else (law_header if request.prepared else wire_law)(request.law),
        play_id="" if played is None else played.id,
        lease_id=request.lease_id,
        requester=request.requester,
        prior_nm2=request.prior_nm2,
        flux_dn=request.flux_dn,
        calibration=None if request.calibration is None else wire.Calibration(id=request.calibration.id),
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
