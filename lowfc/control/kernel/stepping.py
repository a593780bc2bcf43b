"""From measured modes to the next command: by numpy (the reference), or for normal frames by the fused step."""

import numpy as np

from lowfc.arrays import Single
from lowfc.control.kernel.tables import Tables
from lowfc.control.laws import linear_law
from lowfc.control.laws.integrator import integrate
from lowfc.control.loop.command_channels import seen_nm
from lowfc.control.loop.inputs import PendingEvent
from lowfc.control.loop.safety import Limit, LoopMode, Reason, limit
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES, ActiveLoop, LawRunner, Settings, State


def respond(
    settings: Settings,
    state: State,
    loop: ActiveLoop,
    measured_nm: Single,
    sequence: int,
    events: list[PendingEvent],
    tables: Tables | None,
) -> tuple[Single, Single, ActiveLoop, tuple[Reason, ...], bool]:
    """Respond to the modes R (I - I0) (modes,) of a frame; `tables` is None unless the fused step measured them.

    Returns:
        Error and pseudo-open-loop modes (modes,), nm of wavefront rms; the loop after the frame; the limits that acted
        on the command; and whether the modal command is still returning to zero.
    """
    results = None if tables is None else _fused(settings, state, loop, tables, measured_nm)
    if results is None:
        error_nm, pol_nm, loop = _pseudo_open_loop(state, loop, measured_nm, sequence, events)
        return error_nm, pol_nm, *next_command(settings, state, loop, error_nm, sequence)
    error_nm, pol_nm, command_nm, x, actuators_nm = results
    law = loop.law_runner
    if law is not None:
        advanced = LawRunner(law.law, x, law.frames + 1, law.guard)
        target_nm = None if loop.command_channels is None else loop.command_channels.target_nm(sequence)
        pol_from_target_nm = pol_nm if target_nm is None else pol_nm - target_nm
        loop = _update_guard(state, loop, advanced, error_nm, pol_from_target_nm, events)
        if loop.law_runner is not None and not loop.law_runner.alone():  # its guard switched controllers in this frame
            return error_nm, pol_nm, *next_command(settings, state, loop, error_nm, sequence)
    return error_nm, pol_nm, loop.with_command(command_nm, actuators_nm), (), False


def _fused(
    settings: Settings, state: State, loop: ActiveLoop, tables: Tables, measured_nm: Single
) -> tuple[Single, Single, Single, Single, Single] | None:
    """Error, pseudo-open-loop modes, command (modes,), x (states,) and actuators (rows, columns) of a normal frame.

    None if the frame is not normal: the loop is not closed, its command returns to zero, a channel moves or a probe
    sequence is played, a law is in use but does not drive the loop alone, or a limit acts.
    """
    channels, law_runner = loop.command_channels, loop.law_runner
    if state.mode is not LoopMode.CLOSED or state.returning_to_zero or (channels is not None and channels.moving):
        return None
    x, matrices, from_error = tables.no_states, (tables.no_law, tables.no_law), True
    if law_runner is not None:
        if not law_runner.alone(later=1):
            return None
        law, x = law_runner.law, law_runner.x
        matrices, from_error = (law.joined, law.output), law.signal == "error"
    shift_nm = target_nm = tables.zeros_nm
    channels_nm = tables.no_channels
    if channels is not None:
        shift_nm = seen_nm(loop.delay_weights, channels.shifts_nm)
        target_nm, channels_nm = channels.offset_nm, channels.sum_nm
    modes, limits = measured_nm.size, settings.limits
    results = np.empty(3 * modes + x.size, np.float32)
    actuators_nm = np.empty_like(loop.actuators_nm)
    signals = measured_nm, seen_nm(loop.delay_weights, loop.history_nm), shift_nm, target_nm, loop.history_nm[0]
    integrator = loop.integrator.rows
    mirror = tables.shapes, channels_nm, loop.actuators_nm
    # The limits minus the margin; for the neighbour limit, half of the margin.
    limits_nm = limits.kept_stroke_nm, limits.kept_slew_nm, limits.neighbour_nm - limits.margin_nm / 2
    if not tables.respond(*signals, integrator, x, *matrices, from_error, *mirror, *limits_nm, results, actuators_nm):
        return None
    error_nm, pol_nm, command_nm = results[:modes], results[modes : 2 * modes], results[2 * modes : 3 * modes]
    return error_nm, pol_nm, command_nm, results[3 * modes :], actuators_nm


def _pseudo_open_loop(
    state: State, loop: ActiveLoop, measured_nm: Single, sequence: int, events: list[PendingEvent]
) -> tuple[Single, Single, ActiveLoop]:
    """Error and pseudo-open-loop modes (modes,) from the measured modes, and the loop with its law advanced.

    The channels seen in the exposure are subtracted from both, the loop's target only from the error.
    """
    channels, error_nm = loop.command_channels, measured_nm
    if channels is not None:
        error_nm = measured_nm - seen_nm(loop.delay_weights, channels.shifts_nm)
    pol_nm = pol_from_target_nm = error_nm - seen_nm(loop.delay_weights, loop.history_nm)
    if channels is not None:
        target_nm = channels.target_nm(sequence)
        error_nm, pol_from_target_nm = error_nm - target_nm, pol_nm - target_nm
    if loop.law_runner is not None:
        advanced = loop.law_runner.advanced(error_nm, pol_from_target_nm, loop.history_nm[0])
        loop = _update_guard(state, loop, advanced, error_nm, pol_from_target_nm, events)
    return error_nm, pol_nm, loop


def _update_guard(
    state: State,
    loop: ActiveLoop,
    advanced: LawRunner,
    error_nm: Single,
    pol_from_target_nm: Single,
    events: list[PendingEvent],
) -> ActiveLoop:
    """The loop with its advanced law and guard; error and POL (modes,) are relative to the loop's target."""
    guard, channels, closed = advanced.guard, loop.command_channels, state.mode is LoopMode.CLOSED
    if guard is not None:
        not_by_law = state.returning_to_zero or (channels is not None and channels.play is not None)
        fading = closed and SETTLING_FRAMES < advanced.frames < SETTLING_FRAMES + FADING_FRAMES
        if not_by_law or fading or not (closed or state.mode is LoopMode.OPEN):
            guard = guard.at_rest()
        elif advanced.frames <= SETTLING_FRAMES or not closed:
            guard = guard.observed(pol_from_target_nm, advanced.frames)
        else:  # a modal limit does not void the comparison, as the guard's commands are limited in the same way
            limited = any(reason is not Limit.MODAL_LIMIT for reason in state.limits_hit)
            commands = advanced.law, advanced.x, loop.integrator, loop.delay_weights, loop.history_nm
            guard, guard_events = guard.judged(*commands, error_nm, pol_from_target_nm, limited=limited)
            events += guard_events
        advanced = advanced._replace(guard=guard)
    return loop._replace(law_runner=advanced)


def next_command(
    settings: Settings, state: State, loop: ActiveLoop, error_nm: Single, sequence: int
) -> tuple[ActiveLoop, tuple[Reason, ...], bool]:
    """The loop with the command for an error (modes,), the limits that acted, and the next `returning_to_zero`."""
    if state.mode is LoopMode.SAFE:
        return step_to_flat(settings, loop), (), False
    channels, returning_to_zero = loop.command_channels, state.returning_to_zero
    closed = state.mode is LoopMode.CLOSED
    # If a limit changed the last command, the mirror lacks a part of the channels, even if all are recorded as reached.
    channels_move = channels is not None and bool(channels.moving or state.limits_hit)
    if not (state.may_command and (closed or returning_to_zero or channels_move)):
        return loop.holding_command(1), (), returning_to_zero
    command_nm, clipped = loop.history_nm[0], False
    if returning_to_zero:
        command_nm = np.zeros_like(command_nm)
    elif closed:
        command_nm, clipped = _law_output(loop, error_nm)
    requested_nm = loop.to_actuators.dot(command_nm).reshape(loop.calibration.grid)
    extra_nm: Single | None = None
    if channels is not None:
        channels = channels.moved(sequence, settings.limits.kept_slew_nm / 2, loop.to_modes)
        loop = loop._replace(command_channels=channels)
        played_nm = channels.played_nm(sequence)
        extra_nm = channels.sum_nm if played_nm is None else channels.sum_nm + played_nm
        requested_nm += extra_nm
    limited = limit(settings.limits, loop.actuators_nm, requested_nm)
    if limited.reasons and (closed or returning_to_zero):  # against wind-up, the modal command becomes the limited one
        limited_nm = limited.actuators_nm
        if extra_nm is not None:
            limited_nm = np.subtract(limited_nm, extra_nm)
        command_nm = loop.inverse @ limited_nm.reshape(-1)
    reasons = (Limit.MODAL_LIMIT, *limited.reasons) if clipped else limited.reasons
    returning_to_zero = (
        returning_to_zero and bool(limited.reasons) and not np.array_equal(limited.actuators_nm, loop.actuators_nm)
    )
    return loop.with_command(command_nm, limited.actuators_nm), reasons, returning_to_zero


def _law_output(loop: ActiveLoop, error_nm: Single) -> tuple[Single, bool]:
    """Modal command (modes,) of law and integrator, clipped to the modal limits, and whether it was clipped."""
    law_runner, held_nm = loop.law_runner, loop.history_nm[0]
    alone = law_runner is not None and law_runner.alone()
    if law_runner is None or not alone:
        integrated_nm, clipped = integrate(loop.integrator, held_nm, error_nm)
        if law_runner is None or law_runner.frames <= SETTLING_FRAMES:
            return integrated_nm, clipped
    requested_nm = linear_law.respond(law_runner.law, law_runner.x)
    if not alone:
        weight = law_runner.weight
        requested_nm = requested_nm * weight + integrated_nm * (1 - weight)
    limited_nm = np.clip(requested_nm, -loop.integrator.limit_nm, loop.integrator.limit_nm)
    return limited_nm, not np.array_equal(limited_nm, requested_nm)


def step_to_flat(settings: Settings, loop: ActiveLoop) -> ActiveLoop:
    """The loop after one step of the mirror towards flat, within the slew limit."""
    flat = limit(settings.limits, loop.actuators_nm, np.zeros_like(loop.actuators_nm)).actuators_nm
    if loop.command_channels is not None:
        loop = loop._replace(command_channels=loop.command_channels.restarted_from_flat(loop.to_modes))
    return loop.with_command(loop.inverse @ flat.reshape(-1), flat)
