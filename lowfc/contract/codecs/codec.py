"""Conversion between the messages of the bus and values of `lowfc.control`."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.arrays import Single
from lowfc.contract.codecs.bench_codec import report_of, wire_report
from lowfc.contract.codecs.calibration_codec import camera_settings, decode_calibration, wire_camera
from lowfc.contract.codecs.law_codec import law_header, law_of, wire_law
from lowfc.contract.errors import BadMessageError, raised_as
from lowfc.contract.messages import (
    MONO16,
    RawImage,
    checked_sequence,
    checked_time_ns,
    fields_of,
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
from lowfc.control.loop.wording import MAX_NOTE_LENGTH

_PIXEL = np.dtype("<u2")  # parsing its name would cost 0.2 us in every frame


def decode_frame(payload: bytes, sequence: int, age_ns: int, *, ahead: bool = False) -> Frame:
    """Frame of a RawImage; its pixels are None if the message has no complete mono16 image.

    `ahead`: whether the camera's start time, encoded in `sequence`, is too far in the future. BadMessageError if the
    time or the sequence is out of range.
    """
    checked_sequence(sequence)
    try:
        image = RawImage.FromString(payload)
    except DecodeError:
        return Frame(sequence, 0, age_ns, None, ahead)
    pixels, data = None, image.data  # each access of `data` copies it
    rows, columns, step = image.height, image.width, image.step
    if image.encoding == MONO16 and step == 2 * columns and len(data) == step * rows > 0:
        pixels = np.frombuffer(data, _PIXEL).reshape(rows, columns)
    return Frame(sequence, checked_time_ns(image.timestamp), age_ns, pixels, ahead)


def encode_step(step: Step, input_number: int) -> bytes:
    """ControlStep of a step, which was computed from the input with this number."""
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
        input_number=input_number,
    )
    return message.SerializeToString()


def encode_command(command: Command, valid_for_ns: int, channel: str, input_number: int) -> bytes:
    """MirrorCommand of a command, which was computed from the input with this number."""
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
        input_number=input_number,
        safe=command.safe,
        clear_id=command.clear_id,
    )
    return message.SerializeToString()


def actuators(message: wire.MirrorCommand | wire.MirrorState) -> Single | None:
    """Actuators (rows, columns) of a message; None if the number of bytes does not match."""
    if len(message.actuators) != 4 * message.rows * message.columns or not message.actuators:
        return None
    return floats(message.actuators, message.rows, message.columns)


def decode_mirror(payload: bytes) -> MirrorShape | None:
    """Shape of a MirrorState; None if it cannot be read or has none, BadMessageError if its time is out of range."""
    try:
        state = wire.MirrorState.FromString(payload)
    except DecodeError:
        return None
    checked_time_ns(state.timestamp)
    return _mirror_shape(state)


def decode_camera(payload: bytes, start_s: int) -> CameraSettings:
    """Camera settings of a CameraState, from a camera that started at `start_s` (unix seconds).

    BadMessageError if it cannot be read, has no pixels, or a number in it is invalid.
    """
    with raised_as(BadMessageError, DecodeError):
        state = wire.CameraState.FromString(payload)
    checked_time_ns(state.timestamp)
    camera = camera_settings(state, start_s)
    levels = (camera.bias_dn, camera.saturation_dn, camera.gain_e_per_dn, camera.em_gain, camera.read_noise_e)
    if not all(camera.shape) or not np.isfinite(levels).all():
        raise BadMessageError("the camera settings have no pixels, or a number that is not finite")
    return camera


def encode_input(report: Report, input_number: int) -> bytes:
    """ControlInput of an input other than a frame or a request."""
    time = timestamp(report.time_ns)
    message = wire.ControlInput(timestamp=time, input_number=input_number)
    match report:
        case MirrorShape():
            message.mirror.CopyFrom(_wire_shape(report))
        case MirrorReport():
            message.mirror_report.CopyFrom(wire.MirrorReport(timestamp=time, fault=report.fault))
            if report.shape is not None:
                message.mirror_report.mirror.CopyFrom(_wire_shape(report.shape))
        case BenchReport():
            message.bench_report.CopyFrom(wire_report(report))
        case CameraSettings():
            message.camera.CopyFrom(wire_camera(report))
        case Load():
            load = wire.Load(timestamp=time, calibration_id=report.calibration.id, source=report.source)
            message.load.CopyFrom(load)
        case Tick():
            message.tick.CopyFrom(wire.Tick(timestamp=time, silent_ns=max(0, report.silent_ns)))
    return message.SerializeToString()


def decode_input(message: wire.ControlInput, calibrations: Mapping[str, Calibration]) -> Input:
    """Input of a ControlInput; ValueError if it is invalid, or its calibration is not in `calibrations` (by id)."""
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


MAX_REQUESTER_LENGTH = 100
"""Largest number of characters kept of a requester."""
_REQUEST = ("name", "modes", "values", "text", "lease_id", "requester", "prior_nm2", "flux_dn")
"""Fields of the same name in requests and messages."""
_BYTES_WITHOUT_ARRAYS = 8_000
_BYTES_WITH_ARRAYS = 16_000_000  # the bus loses a far larger message
_MAX_BYTES = {
    "channel": 4 * 128 * 128 + _BYTES_WITHOUT_ARRAYS,
    "note": 4 * MAX_NOTE_LENGTH + _BYTES_WITHOUT_ARRAYS,
    "play": _BYTES_WITH_ARRAYS,
    "law": _BYTES_WITH_ARRAYS,
    "load": _BYTES_WITH_ARRAYS,
}


def max_bytes(name: str) -> int:
    """Largest size of a request of this name; a larger one is refused before it is decoded."""
    return _MAX_BYTES.get(name, _BYTES_WITHOUT_ARRAYS)


def only_requester(payload: bytes) -> bytes:
    """A request reduced to its requester, from its first 8000 bytes; empty if these cannot be read."""
    try:
        request = wire.Request.FromString(payload[:_BYTES_WITHOUT_ARRAYS])
        return wire.Request(requester=request.requester).SerializeToString()
    except DecodeError:
        return b""


def decode_request(payload: bytes, name: str, time_ns: int) -> Request:
    """Request of this name; ValueError if it is too large, cannot be read, or a part of it is incomplete."""
    if len(payload) > max_bytes(name):
        raise ValueError(f"a request of this name holds at most {max_bytes(name)} bytes, got {len(payload)}")
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
    """Request of a message.

    A logged message has only the identities of calibration, law and table: these are looked up in the mappings.
    ValueError if a part of it is incomplete or missing.
    """
    table, shapes_nm = floats(message.table, -1, message.columns or 1), floats(message.actuators, -1)
    if message.play_id:
        if message.play_id not in plays:
            raise ValueError(f"the table {message.play_id[:12]} of a probe sequence is missing")
        stored_table = plays[message.play_id]
        table, shapes_nm = stored_table.rows, stored_table.basis.reshape(-1)
    calibration = None
    if message.HasField("calibration"):
        stored = calibrations.get(message.calibration.id)
        calibration = decode_calibration(message.calibration) if stored is None else stored
    return Request(
        time_ns,
        name,
        tuple(message.modes),
        tuple(message.values),
        message.text,
        shapes_nm,
        table,
        law_of(message.law, laws) if message.HasField("law") else None,
        calibration,
        lease_id=message.lease_id,
        requester=printable(message.requester[:MAX_REQUESTER_LENGTH]),
        prior_nm2=tuple(message.prior_nm2),
        flux_dn=message.flux_dn,
    )


def encode_request(request: Request, reply: Reply, input_number: int, state: wire.ControllerState | None) -> bytes:
    """Request with its reply; the input number is 0 if the controller did not act on it.

    Calibrations, laws and tables have topics of their own, so only their identities are written; but the law and the
    table of a request that is not `prepared` are written in full. `state` is the answer to `status`.
    """
    played = request.played
    message = wire.Request(
        timestamp=timestamp(request.time_ns),
        accepted=reply.accepted,
        reply=reply.text,
        frame_sequence=reply.frame_sequence,
        state=state,
        input_number=input_number,
        actuators=b"" if played is not None else request.actuators_nm.tobytes(),
        table=b"" if played is not None else request.table.tobytes(),
        columns=request.table.shape[1] if request.table.size else 0,
        law=None if request.law is None else (law_header if request.prepared else wire_law)(request.law),
        play_id="" if played is None else played.id,
        calibration=None if request.calibration is None else wire.Calibration(id=request.calibration.id),
        **fields_of(request, _REQUEST),
    )
    return message.SerializeToString()


def wire_mode(mode: LoopMode) -> wire.LoopMode:
    """A loop mode as on the wire."""
    return mode.value  # type: ignore[return-value]  # same numbers, checked by a test


def wire_reasons(reasons: tuple[Reason, ...]) -> list[wire.Reason]:
    """Reasons as on the wire."""
    return [reason.value for reason in reasons]  # type: ignore[misc]  # same numbers, checked by a test


def latency(durations: Durations) -> wire.Latency:
    """Message of the percentiles of durations."""
    p50, p99, p99_9 = durations.percentiles_ns(0.5, 0.99, 0.999)
    return wire.Latency(count=durations.count, p50_ns=p50, p99_ns=p99, p99_9_ns=p99_9, max_ns=durations.max_ns)
