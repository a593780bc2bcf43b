"""The controller's state and settings as a message, both ways: whoever reads it goes on with the same next command."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from lowfc.contract.calibration_codec import camera_settings, wire_camera
from lowfc.contract.codec import wire_mode, wire_reasons
from lowfc.contract.law_codec import additions_of, law_header, law_of, put_additions
from lowfc.contract.messages import floats, from_timestamp, timestamp, wire
from lowfc.control import linear_law
from lowfc.control.additions import PlayTable
from lowfc.control.calibration import Calibration
from lowfc.control.estimator import Estimate
from lowfc.control.law import Law
from lowfc.control.lease import Lease
from lowfc.control.linear_law import LinearLaw
from lowfc.control.safety import Limits, LoopMode, Reason
from lowfc.control.state import Conditions, Drive, Following, Settings, State


def controller_state(state: State, settings: Settings, time_ns: int) -> wire.ControllerState:
    """Everything the next command depends on, besides the calibration."""
    message = wire.ControllerState(
        timestamp=timestamp(time_ns),
        frame_sequence=state.frame_sequence,
        frame_timestamp=timestamp(state.frame_time_ns),
        mode=wire_mode(state.mode),
        delay_frames=settings.delay_frames,
        counts=reason_counts(state),
        frames_used=state.frames_used,
        refused=wire_reasons((state.refused,))[0] if state.refused is not None else wire.REASON_UNSPECIFIED,
        refused_count=state.refused_count,
        limits_hit=wire_reasons(state.limits_hit),
        silent=state.silent,
        commanded=state.commanded,
        taken=state.taken,
        settings=_encode_settings(settings),
        steps_left=state.steps_left,
        homing=state.homing,
        alike=state.alike,
    )
    conditions = state.conditions
    message.camera_awaited = conditions.camera_awaited
    message.clear_id = conditions.clear_id
    message.mode_cause = conditions.mode_cause
    if conditions.mode_since_ns:
        message.mode_timestamp.CopyFrom(timestamp(conditions.mode_since_ns))
    if conditions.camera is not None:
        message.camera.CopyFrom(wire_camera(conditions.camera))
    lease = conditions.lease
    if lease is not None:
        message.lease.CopyFrom(
            wire.Lease(
                id=lease.id,
                holder=lease.holder,
                until=timestamp(lease.until_ns),
                last_sequence=lease.last_sequence,
                ended=lease.ended,
            )
        )
    if state.estimate is not None:
        message.measured_nm.extend(state.estimate.error_nm.tolist())
        message.flux_dn = state.estimate.flux_dn
    if state.drive is not None:
        if state.drive.additions is not None:
            put_additions(message, state.drive.additions)
        if state.drive.camera is not None:
            message.camera_expected.CopyFrom(wire_camera(state.drive.camera))
        following = state.drive.following
        if following is not None:
            message.law.CopyFrom(law_header(following.law))
            message.law_state.extend(following.x.tolist())
            message.law_frames = following.frames
        message.calibration_id = state.drive.calibration.id
        if not message.calibration_id:
            message.mirror_rows, message.mirror_columns = state.drive.calibration.grid
        message.gain.extend(state.drive.law.gain.tolist())
        message.leak.extend(state.drive.law.leak.tolist())
        message.limit_nm.extend(state.drive.law.limit_nm.tolist())
        message.command_history_nm.extend(np.concatenate(state.drive.history_nm).tolist())
        message.actuators = state.drive.actuators_nm.tobytes()
    return message


def decode_state(
    message: wire.ControllerState,
    calibration: Calibration | None,
    laws: Mapping[str, LinearLaw] = MappingProxyType({}),
    plays: Mapping[str, PlayTable] = MappingProxyType({}),
) -> tuple[Settings, State]:
    """Settings and state of a message; `calibration` is the one that it names, as are one of `laws` and of `plays`.

    Raises:
        ValueError: the message is not whole, the calibration is another one, or its law or table is not there.
    """
    settings = _decode_settings(message.settings)
    drive = None
    if message.mirror_rows:
        calibration = Calibration.none((message.mirror_rows, message.mirror_columns))
    if message.calibration_id or message.mirror_rows:
        if calibration is None or calibration.id != message.calibration_id:
            raise ValueError(f"calibration {message.calibration_id[:12]} of the controller's state is not there")
        drive = Drive.at_rest(settings, calibration)
        law = Law(*(np.array(values, np.float32) for values in (message.gain, message.leak, message.limit_nm)))
        history = np.array(message.command_history_nm, np.float32).reshape(len(drive.history_nm), -1)
        actuators = floats(message.actuators, *calibration.grid)
        if law.gain.shape != drive.law.gain.shape or history.shape[1] != len(calibration.noll):
            raise ValueError(f"the controller's state is not of {len(calibration.noll)} modes")
        following = None
        if message.HasField("law"):
            x = np.array(message.law_state, np.float32)
            following = Following(law_of(message.law, laws), x, message.law_frames)
            if x.shape != linear_law.at_rest(following.law).shape or following.law.noll != calibration.noll:
                raise ValueError("the law of the controller's state does not fit")
        drive = drive._replace(
            law=law,
            camera=camera_settings(message.camera_expected) if message.HasField("camera_expected") else drive.camera,
            following=following,
            additions=additions_of(message, drive.added(), drive.to_modes, plays),
            history_nm=tuple(history),
            actuators_nm=actuators,
        )
    state = State(
        mode=LoopMode(message.mode),
        drive=drive,
        frame_sequence=message.frame_sequence,
        frame_time_ns=from_timestamp(message.frame_timestamp),
        frames_used=message.frames_used,
        refused=Reason(message.refused) if message.refused else None,
        refused_count=message.refused_count,
        limits_hit=tuple(Reason(reason) for reason in message.limits_hit),
        silent=message.silent,
        commanded=message.commanded,
        counts={Reason(line.reason): line.count for line in message.counts},
        steps_left=message.steps_left,
        homing=message.homing,
        taken=message.taken,
        estimate=Estimate(np.array(message.measured_nm, np.float32), message.flux_dn) if message.measured_nm else None,
        alike=message.alike,
        conditions=Conditions(
            camera_settings(message.camera) if message.HasField("camera") else None,
            message.camera_awaited,
            message.clear_id,
            from_timestamp(message.mode_timestamp),
            message.mode_cause,
            _lease(message.lease) if message.HasField("lease") else None,
        ),
    )
    return settings, state


def _lease(message: wire.Lease) -> Lease:
    until_ns = from_timestamp(message.until)
    return Lease(message.id, message.holder, until_ns, message.last_sequence, message.ended)


def reason_counts(state: State) -> list[wire.ReasonCount]:
    """How often each reason was given."""
    pairs = zip(wire_reasons(tuple(state.counts)), state.counts.values(), strict=True)
    return [wire.ReasonCount(reason=reason, count=count) for reason, count in pairs]


def _encode_settings(settings: Settings) -> wire.ControllerSettings:
    return wire.ControllerSettings(
        stroke_nm=settings.limits.stroke_nm,
        slew_nm=settings.limits.slew_nm,
        neighbour_nm=settings.limits.neighbour_nm,
        delay_frames=settings.delay_frames,
        start_mode=wire_mode(settings.start_mode),
        late_ns=settings.late_ns,
        hold_ns=settings.hold_ns,
        silence=settings.silence,
        least_flux=settings.least_flux,
        most_saturated=settings.most_saturated,
        gain=settings.gain,
        leak=settings.leak,
        limit_nm=settings.limit_nm,
        most_alike=settings.most_alike,
        rate_hz=settings.rate_hz,
    )


def _decode_settings(message: wire.ControllerSettings) -> Settings:
    return Settings(
        limits=Limits(message.stroke_nm, message.slew_nm, message.neighbour_nm),
        delay_frames=message.delay_frames,
        start_mode=LoopMode(message.start_mode),
        late_ns=message.late_ns,
        hold_ns=message.hold_ns,
        silence=message.silence,
        least_flux=message.least_flux,
        most_saturated=message.most_saturated,
        gain=_pair(message.gain),
        leak=_pair(message.leak),
        limit_nm=_pair(message.limit_nm),
        most_alike=message.most_alike,
        rate_hz=message.rate_hz,
    )


def _pair(values: Sequence[float]) -> tuple[float, float]:
    tilt, others = values
    return tilt, others
