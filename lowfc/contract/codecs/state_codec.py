"""Encode and decode the controller's state and settings; a controller restored from them continues identically."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from lowfc.contract.codecs.bench_codec import interlock_of, wire_interlock
from lowfc.contract.codecs.calibration_codec import camera_settings, wire_camera
from lowfc.contract.codecs.codec import wire_mode, wire_reasons
from lowfc.contract.codecs.law_codec import command_channels_of, integrator_of, law_header, law_of, put_command_channels
from lowfc.contract.messages import fields_of, floats, from_timestamp, timestamp, wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.calibration.map_reconstructor import map_rows
from lowfc.control.kernel.tables import NUMPY, Estimate, Kernel
from lowfc.control.laws import linear_law
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.command_channels import PlayTable
from lowfc.control.loop.guard import Group, LawGuard
from lowfc.control.loop.interlocks import Acting, Action
from lowfc.control.loop.lease import Lease
from lowfc.control.loop.safety import Limits, LoopMode, Rejection, reason_of
from lowfc.control.loop.state import ActiveLoop, Conditions, LawRunner, Settings, State, Weighting

# Fields of the same name in values and messages.
_LIMITS = ("stroke_nm", "slew_nm", "neighbour_nm")
_PAIRS = ("gain", "leak", "limit_nm")  # settings have a value for tip and tilt, and one for the other modes
_SETTINGS = (
    *("delay_frames", "max_frame_age_ns", "frame_timeout_ns", "on_frame_timeout", "rate_hz", "guard"),
    *("min_flux_fraction", "max_saturated_pixels", "max_identical_frames"),
)
_STATE = (
    *("frame_sequence", "frames_used", "refused_count", "frame_timeout", "commanded"),
    *("input_number", "steps_left", "returning_to_zero", "identical_frames"),
)
_CONDITIONS = ("camera_awaited", "clear_id", "mode_cause", "mirror_fault")
_LEASE = ("id", "holder", "last_sequence", "ended", "holds")


def controller_state(state: State, settings: Settings, time_ns: int) -> wire.ControllerState:
    """Message of all that the next command depends on; it has only the identities of calibration, law and table."""
    conditions, loop, estimate, lease = state.conditions, state.loop, state.estimate, state.conditions.lease
    message = wire.ControllerState(
        timestamp=timestamp(time_ns),
        frame_timestamp=timestamp(state.frame_time_ns),
        mode=wire_mode(state.mode),
        delay_frames=settings.delay_frames,
        counts=reason_counts(state),
        refused=wire_reasons((state.refused,))[0] if state.refused is not None else wire.REASON_UNSPECIFIED,
        limits_hit=wire_reasons(state.limits_hit),
        settings=_encode_settings(settings),
        mode_timestamp=timestamp(conditions.mode_since_ns) if conditions.mode_since_ns else None,
        camera=None if conditions.camera is None else wire_camera(conditions.camera),
        lease=None if lease is None else wire.Lease(until=timestamp(lease.until_ns), **fields_of(lease, _LEASE)),
        measured_nm=() if estimate is None else estimate.error_nm.tolist(),
        flux_dn=0.0 if estimate is None else estimate.flux_dn,
        interlocks_acting=[wire.ActingInterlock(**acting._asdict()) for acting in conditions.acting],
        **fields_of(state, _STATE),
        **fields_of(conditions, _CONDITIONS),
    )
    if loop is not None:
        if loop.command_channels is not None:
            put_command_channels(message, loop.command_channels)
        if loop.camera is not None:
            message.camera_expected.CopyFrom(wire_camera(loop.camera))
        law_runner = loop.law_runner
        if law_runner is not None:
            message.law.CopyFrom(law_header(law_runner.law))
            message.law_state.extend(law_runner.x.tolist())
            message.law_frames = law_runner.frames
            if law_runner.guard is not None:
                _put_guard(message.guard, law_runner.guard)
        message.calibration_id = loop.calibration.id
        message.calibration_provisional = loop.calibration.provisional
        if not message.calibration_id:
            message.mirror_rows, message.mirror_columns = loop.calibration.grid
        if loop.automatic.any():
            message.automatic.extend(loop.automatic.tolist())
        if loop.weighting is not None:
            message.prior_nm2.extend(loop.weighting.prior_nm2.tolist())
            message.weighting_flux_dn = loop.weighting.flux_dn
        for name in _PAIRS:
            getattr(message, name).extend(getattr(loop.integrator, name).tolist())
        message.command_history_nm.extend(np.concatenate(loop.history_nm).tolist())
        message.actuators = loop.actuators_nm.tobytes()
    return message


def calibration_in_use(message: wire.ControllerState, calibration: Calibration) -> Calibration:
    """The calibration with the reconstructor in use; automatic gains may have added a prior for uncorrected modes."""
    prior_nm2 = np.array(message.prior_nm2, np.float32)
    if message.calibration_id != calibration.id or prior_nm2.size != len(calibration.noll):
        return calibration
    camera = camera_settings(message.camera_expected) if message.HasField("camera_expected") else calibration.camera
    (rows,) = map_rows(calibration, prior_nm2, message.weighting_flux_dn, camera, calibration.reconstructor)
    return replace(calibration, reconstructor=rows)


def decode_state(
    message: wire.ControllerState,
    calibration: Calibration | None,
    laws: Mapping[str, LinearLaw] = MappingProxyType({}),
    plays: Mapping[str, PlayTable] = MappingProxyType({}),
    kernel: Callable[[str], Kernel] = Kernel,
) -> tuple[Settings, State]:
    """Settings and state of a message, which refers to its calibration, law and table by identity.

    `kernel` returns the kernel of a name; without it, the reference implementation is used.

    Raises:
        ValueError: the message is incomplete, the calibration is another one, or the law or a table is missing.
    """
    settings = _decode_settings(message.settings, kernel)
    loop = None
    if message.mirror_rows:
        calibration = Calibration.none((message.mirror_rows, message.mirror_columns))
    if message.calibration_id or message.mirror_rows:
        if calibration is None or calibration.id != message.calibration_id:
            raise ValueError(f"calibration {message.calibration_id[:12]} of the controller's state is missing")
        loop = ActiveLoop.at_rest(settings, calibration)
        integrator = integrator_of(message)
        history = np.array(message.command_history_nm, np.float32).reshape(len(loop.history_nm), -1)
        actuators = floats(message.actuators, *calibration.grid)
        modes, prior_nm2 = len(calibration.noll), np.array(message.prior_nm2, np.float32)
        sizes = {integrator.gain.size, history.shape[1], prior_nm2.size or modes, len(message.automatic) or modes}
        if sizes != {modes}:
            raise ValueError(f"the controller's state does not have {modes} modes")
        law_runner = None
        if message.HasField("law"):
            x = np.array(message.law_state, np.float32)
            law = law_of(message.law, laws)
            guard = _decode_guard(message.guard, law, len(history)) if message.HasField("guard") else None
            law_runner = LawRunner(law, x, message.law_frames, guard)
            if x.shape != linear_law.at_rest(law_runner.law).shape or law_runner.law.noll != calibration.noll:
                raise ValueError("the law of the controller's state does not fit")
        if message.HasField("camera_expected"):
            loop = loop._replace(camera=camera_settings(message.camera_expected))
        if prior_nm2.size:  # before the channels are set: `with_weighting` would change their past shifts
            loop = loop.with_weighting(Weighting(prior_nm2, message.weighting_flux_dn))
        loop = loop._replace(
            law_runner=law_runner,
            command_channels=command_channels_of(message, loop.channels_or_empty(), loop.to_modes, plays),
            history_nm=tuple(history),
            actuators_nm=actuators,
            automatic=np.array(message.automatic or [False] * modes, bool),
        ).with_gains(integrator)
    state = State(
        mode=LoopMode(message.mode),
        loop=loop,
        frame_time_ns=from_timestamp(message.frame_timestamp),
        refused=Rejection(message.refused) if message.refused else None,
        limits_hit=tuple(reason_of(reason) for reason in message.limits_hit),
        counts={reason_of(counted.reason): counted.count for counted in message.counts},
        estimate=Estimate(np.array(message.measured_nm, np.float32), message.flux_dn) if message.measured_nm else None,
        conditions=Conditions(
            camera=camera_settings(message.camera) if message.HasField("camera") else None,
            mode_since_ns=from_timestamp(message.mode_timestamp),
            lease=Lease(until_ns=from_timestamp(message.lease.until), **fields_of(message.lease, _LEASE))
            if message.HasField("lease")
            else None,
            acting=tuple(Acting(lock.number, Action(lock.action), lock.why) for lock in message.interlocks_acting),
            **fields_of(message, _CONDITIONS),
        ),
        **fields_of(message, _STATE),
    )
    return settings, state


def _put_guard(message: wire.Guard, guard: LawGuard) -> None:
    message.frames, message.void = guard.frames, guard.void
    message.groups.extend(wire.GuardedGroup(**group._asdict()) for group in guard.groups)
    message.sums_nm2.extend(guard.sums_nm2.ravel().tolist())
    message.virtual_nm.extend(value for command_nm in guard.virtual_nm for value in command_nm.tolist())
    if guard.x is not None:
        message.law_state.extend(guard.x.tolist())


def _decode_guard(message: wire.Guard, law: LinearLaw, commands: int) -> LawGuard:
    at_rest = LawGuard.of(law, [Group(**fields_of(group, Group._fields)) for group in message.groups])
    guard = at_rest._replace(
        **fields_of(message, ("frames", "void")),
        sums_nm2=np.array(message.sums_nm2).reshape(at_rest.sums_nm2.shape),
        virtual_nm=tuple(np.array(message.virtual_nm, np.float32).reshape(-1, len(law.noll))),
        x=np.array(message.law_state, np.float32) if message.law_state else None,
    )
    if (
        len(guard.groups) != at_rest.sums_nm2.shape[1]
        or any(group.overruled and not group.takeovers for group in guard.groups)
        or (guard.virtual_nm and len(guard.virtual_nm) != commands)
        or (guard.x is not None and guard.x.shape != linear_law.at_rest(law).shape)
    ):
        raise ValueError("the guard of the controller's state does not fit its law")
    return guard


def reason_counts(state: State) -> list[wire.ReasonCount]:
    """Counts of the reasons as messages."""
    pairs = zip(wire_reasons(tuple(state.counts)), state.counts.values(), strict=True)
    return [wire.ReasonCount(reason=reason, count=count) for reason, count in pairs]


def _encode_settings(settings: Settings) -> wire.ControllerSettings:
    return wire.ControllerSettings(
        start_mode=wire_mode(settings.start_mode),
        auto_gain=settings.auto_gain if any(settings.auto_gain) else (),
        interlocks=map(wire_interlock, settings.interlocks),
        kernel="" if settings.kernel.name == NUMPY.name else settings.kernel.name,
        **fields_of(settings.limits, _LIMITS),
        **fields_of(settings, (*_SETTINGS, *_PAIRS)),
    )


def _decode_settings(message: wire.ControllerSettings, kernel: Callable[[str], Kernel]) -> Settings:
    pairs: dict[str, Any] = {name: tuple(getattr(message, name)) for name in _PAIRS}
    pairs["auto_gain"] = tuple(message.auto_gain) or (False, False)
    if any(len(pair) != 2 for pair in pairs.values()):
        raise ValueError("the settings of a controller have two gains, each automatic or not, two leaks and two limits")
    return Settings(
        limits=Limits(*(getattr(message, name) for name in _LIMITS)),
        start_mode=LoopMode(message.start_mode),
        interlocks=tuple(map(interlock_of, message.interlocks)),
        kernel=kernel(message.kernel or NUMPY.name),
        **fields_of(message, _SETTINGS),
        **pairs,
    )
