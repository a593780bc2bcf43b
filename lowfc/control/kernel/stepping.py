"""From modal errors to the next command: the reference in numpy, and the fused step where it is the usual frame."""

from typing import NamedTuple

import numpy as np

from lowfc.arrays import Single
from lowfc.control.kernel.tables import Tables
from lowfc.control.laws import linear_law
from lowfc.control.laws.law import integrate
from lowfc.control.loop.guard import Guard
from lowfc.control.loop.inputs import PendingEvent
from lowfc.control.loop.safety import Limit, LoopMode, Reason, limit
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES, ActiveLoop, LawRunner, Settings, State


class Response(NamedTuple):
    """What a frame's modal errors made; (modes,) nm of wavefront rms.

    Attributes:
        drive: after the frame.
        reasons: limits that acted on the command.
        homing: the modal command is still on its way to zero.
    """

    error_nm: Single
    pol_nm: Single
    drive: ActiveLoop
    reasons: tuple[Reason, ...]
    homing: bool


def respond(
    settings: Settings,
    state: State,
    drive: ActiveLoop,
    measured_nm: Single,
    sequence: int,
    events: list[PendingEvent],
    *,
    usual: bool,
) -> Response:
    """What a frame's modal errors (modes,) make; `usual` where they are the fused step's."""
    tables = drive.estimator.tables
    made = _fused(settings, state, drive, tables, measured_nm) if usual and tables is not None else None
    if made is None:
        error_nm, pol_nm, drive = _pseudo_open_loop(state, drive, measured_nm, sequence, events)
        return Response(error_nm, pol_nm, *next_command(settings, state, drive, error_nm, sequence))
    error_nm, pol_nm, command_nm, x, actuators_nm = made
    law = drive.following
    if law is not None:
        followed = LawRunner(law.law, x, law.frames + 1, law.guard)
        target_nm = None if drive.command_channels is None else drive.command_channels.target_nm(sequence)
        to_undo_nm = pol_nm if target_nm is None else pol_nm - target_nm
        drive = _follow(state, drive, followed, error_nm, to_undo_nm, events)
        if drive.following is not None and not drive.following.alone():  # its guard has changed its mind
            return Response(error_nm, pol_nm, *next_command(settings, state, drive, error_nm, sequence))
    return Response(error_nm, pol_nm, drive.pushed(command_nm, actuators_nm), (), False)


def _fused(
    settings: Settings, state: State, drive: ActiveLoop, tables: Tables, measured_nm: Single
) -> tuple[Single, Single, Single, Single, Single] | None:
    """Error, pseudo-open-loop modes, command (modes,), x (states,) and actuators (rows, columns) of the usual frame.

    None where it is not usual: the loop is not closed, something moves beside it, a law has a part of the command, or a
    limit acts.
    """
    added, following = drive.command_channels, drive.following
    if state.mode is not LoopMode.CLOSED or state.returning_to_zero or (added is not None and added.moving):
        return None
    x, law, of_error = tables.no_states, (tables.no_law, tables.no_law), True
    if following is not None:
        if not following.alone(1):
            return None
        x, law = following.x, (following.law.joined, following.law.output)
        of_error = following.law.signal == "error"
    shift_nm = target_nm = tables.no_modes
    channels_nm = tables.no_channels
    if added is not None:
        shift_nm, target_nm, channels_nm = added.seen_nm(drive.weights), added.offset_nm, added.sum_nm
    modes, limits = measured_nm.size, settings.limits
    made = np.empty(3 * modes + x.size, np.float32)
    actuators_nm = np.empty_like(drive.actuators_nm)
    signals = measured_nm, drive.seen_nm(), shift_nm, target_nm, drive.history_nm[0]
    mirror = tables.shapes, channels_nm, drive.actuators_nm
    most_nm = limits.kept_stroke_nm, limits.kept_slew_nm, limits.neighbour_nm - limits.margin_nm / 2
    if not tables.respond(*signals, drive.law.rows, x, *law, of_error, *mirror, *most_nm, made, actuators_nm):
        return None
    error_nm, pol_nm, command_nm = made[:modes], made[modes : 2 * modes], made[2 * modes : 3 * modes]
    return error_nm, pol_nm, command_nm, made[3 * modes :], actuators_nm


def _pseudo_open_loop(
    state: State, drive: ActiveLoop, measured_nm: Single, sequence: int, events: list[PendingEvent]
) -> tuple[Single, Single, ActiveLoop]:
    """Error and pseudo-open-loop modes (modes,) of what the sensor measured, and the drive whose law has seen them.

    Channels are taken out of both, as far as the exposure saw them; what the loop is to aim at is taken out of the
    error.
    """
    added, error_nm = drive.command_channels, measured_nm
    if added is not None:
        error_nm = measured_nm - added.seen_nm(drive.weights)
    pol_nm = to_undo_nm = error_nm - drive.seen_nm()
    if added is not None:
        target_nm = added.target_nm(sequence)
        error_nm, to_undo_nm = error_nm - target_nm, pol_nm - target_nm
    if drive.following is not None:
        followed = drive.following.followed(error_nm, to_undo_nm, drive.history_nm[0])
        drive = _follow(state, drive, followed, error_nm, to_undo_nm, events)
    return error_nm, pol_nm, drive


def _follow(
    state: State,
    drive: ActiveLoop,
    followed: LawRunner,
    error_nm: Single,
    to_undo_nm: Single,
    events: list[PendingEvent],
) -> ActiveLoop:
    """The drive whose law has followed a frame, and its guard after it; both (modes,) without the loop's target."""
    if followed.guard is not None:
        guard, more = _guarded(state, drive, followed, followed.guard, error_nm, to_undo_nm)
        followed = followed._replace(guard=guard)
        events += more
    return drive._replace(following=followed)


def _guarded(
    state: State, drive: ActiveLoop, law: LawRunner, guard: Guard, error_nm: Single, to_undo_nm: Single
) -> tuple[Guard, list[PendingEvent]]:
    """The guard of a law after a frame, and its events; both (modes,) without the loop's target."""
    closed, added = state.mode is LoopMode.CLOSED, drive.command_channels
    probed = state.returning_to_zero or (added is not None and added.play is not None)
    if probed or not (closed or state.mode is LoopMode.OPEN):
        return guard.at_rest(), []
    if law.frames <= SETTLING_FRAMES or not closed:
        return guard.observed(to_undo_nm, law.frames), []
    if law.frames < SETTLING_FRAMES + FADING_FRAMES:
        return guard.at_rest(), []
    limited = any(reason is not Limit.MODAL_LIMIT for reason in state.limits_hit)  # virtual commands have that one, too
    loop = drive.law, drive.weights, drive.history_nm
    return guard.judged(law.law, law.x, *loop, error_nm, to_undo_nm, limited=limited)


def next_command(
    settings: Settings, state: State, drive: ActiveLoop, error_nm: Single, sequence: int
) -> tuple[ActiveLoop, tuple[Reason, ...], bool]:
    """The command after an error (modes,), the limits that acted, and whether it is still on its way to zero."""
    if state.mode is LoopMode.SAFE:
        return step_to_flat(settings, drive), (), False
    added, homing = drive.command_channels, state.returning_to_zero
    closed = state.mode is LoopMode.CLOSED
    # A limit that acted on the last command has kept the mirror from where it was to go.
    if not closed and not homing and (added is None or not (added.moving or state.limits_hit)):
        return drive.stayed(1), (), False
    command_nm, cut = drive.history_nm[0], False
    if homing:
        command_nm = np.zeros_like(command_nm)
    elif closed:
        command_nm, cut = _law_output(drive, error_nm)
    wanted_nm = drive.to_actuators.dot(command_nm).reshape(drive.calibration.grid)
    extra_nm: Single | None = None
    if added is not None:
        added = added.moved(sequence, settings.limits.kept_slew_nm / 2, drive.to_modes)
        drive = drive._replace(command_channels=added)
        played_nm = added.played_nm(sequence)
        extra_nm = added.sum_nm if played_nm is None else added.sum_nm + played_nm
        wanted_nm += extra_nm
    limited = limit(settings.limits, drive.actuators_nm, wanted_nm)
    if limited.reasons and (closed or homing):  # the modal command becomes what was kept, against wind-up
        kept_nm = limited.actuators_nm
        if extra_nm is not None:
            kept_nm = np.subtract(kept_nm, extra_nm)
        command_nm = drive.inverse @ kept_nm.reshape(-1)
    reasons = (Limit.MODAL_LIMIT, *limited.reasons) if cut else limited.reasons
    homing = homing and bool(limited.reasons) and not np.array_equal(limited.actuators_nm, drive.actuators_nm)
    return drive.pushed(command_nm, limited.actuators_nm), reasons, homing


def _law_output(drive: ActiveLoop, error_nm: Single) -> tuple[Single, bool]:
    """The law's modal command (modes,) in its limits, and whether one was cut."""
    following, held_nm = drive.following, drive.history_nm[0]
    alone = following is not None and following.alone()
    if following is None or not alone:
        integrated_nm, cut = integrate(drive.law, held_nm, error_nm)
        if following is None or following.frames <= SETTLING_FRAMES:
            return integrated_nm, cut
    wanted_nm = linear_law.respond(following.law, following.x)
    if not alone:
        weight = following.weight
        wanted_nm = wanted_nm * weight + integrated_nm * (1 - weight)
    kept_nm = np.clip(wanted_nm, -drive.law.limit_nm, drive.law.limit_nm)
    return kept_nm, not np.array_equal(kept_nm, wanted_nm)


def step_to_flat(settings: Settings, drive: ActiveLoop) -> ActiveLoop:
    """One frame towards flat, within the slew limit."""
    flat = limit(settings.limits, drive.actuators_nm, np.zeros_like(drive.actuators_nm)).actuators_nm
    if drive.command_channels is not None:
        drive = drive._replace(command_channels=drive.command_channels.lowered(drive.to_modes))
    return drive.pushed(drive.inverse @ flat.reshape(-1), flat)
