"""Simulation of another controller on the disturbance in a log.

Pseudo-open-loop modes are the measurement minus the commands seen in it. With the other controller, a sensor in its
linear range would have measured these modes plus the commands of that controller.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Integers, Long, Mask, Sequences, Single
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.linear_law import LinearLaw, at_rest, integrator, predict_and_update, respond
from lowfc.control.laws.stability import delay_weights
from lowfc.control.loop.inputs import COUNT_BITS
from lowfc.control.loop.safety import NOT_NEW

Controller = Callable[[Any, Single, Single], tuple[Any, Single]]
"""(state, error_nm, pol_nm) to (state, command_nm); the state is None at first, the arrays are (modes,) float32."""

MAX_DELAY_FRAMES = 5
"""Longest plausible delay of a working loop, frames."""
_STILL_NM = 0.01  # rms difference of successive commands below which they hardly move
_MIN_STEPS = 20  # least number of steps or commands from which a delay is determined
_NOT_NEW = sum(1 << reason for reason in NOT_NEW)


def controller_of(law: LinearLaw, limit_nm: Single | None = None) -> Controller:
    """A linear law as a controller that starts at rest with a flat mirror; `limit_nm` (modes,) clips its commands."""

    def step(before: tuple[Single, Single] | None, error_nm: Single, pol_nm: Single) -> tuple[Any, Single]:
        x, held_nm = before or (at_rest(law), np.zeros_like(error_nm))
        x = predict_and_update(law, x, pol_nm if law.signal == "pol" else error_nm, held_nm)
        command_nm = respond(law, x)
        if limit_nm is not None:
            command_nm = np.clip(command_nm, -limit_nm, limit_nm)
        return (x, command_nm), command_nm

    return step


def limited_integrator(law: Integrator) -> Controller:
    """The live loop's integrator, with its limits, as a controller."""
    noll = tuple(range(2, 2 + law.gain.size))  # Noll indices, delay and rate are not used
    return controller_of(integrator(law.gain, law.leak, noll, 1.0, 1.0), law.limit_nm)


def has_new_exposure(reasons: Long) -> Mask:
    """Mask (steps,): whether a step has a new exposure; `reasons` (steps,) has the bit `1 << reason` of each reason."""
    return np.asarray((reasons & _NOT_NEW) == 0)


def missing_before(sequence: Sequences) -> Integers:
    """Number (steps,) of exposures without a step before each step; `sequence` (steps,) ascends but after `clear`."""
    same_start = sequence[1:] >> np.uint64(COUNT_BITS) == sequence[:-1] >> np.uint64(COUNT_BITS)
    follows = same_start & (sequence[1:] > sequence[:-1])
    between = np.where(follows, sequence[1:] - sequence[:-1] - np.uint64(1), np.uint64(0))
    return np.concatenate([np.zeros(min(1, len(sequence)), np.int64), between.astype(np.int64)])


def seen_nm(weights: Single, command_nm: Single, missing: Integers, first_nm: Single) -> Single:
    """Command (steps, modes) that each exposure saw; during exposures without a step the command is held.

    Args:
        weights: from `lowfc.control.laws.stability.delay_weights`.
        command_nm: (steps, modes) after each step.
        missing: (steps,) from `missing_before`.
        first_nm: (modes,) command before the first step.
    """
    held = np.minimum(missing, len(weights))  # holding longer than that changes nothing
    rows = np.arange(len(command_nm))
    place = rows + np.cumsum(held)  # index of each step on an axis of all exposures
    source = np.repeat(rows - 1, held + 1)  # the last step before each exposure
    commands_nm = np.concatenate([first_nm[None], command_nm])
    seen = np.zeros_like(command_nm)
    for lag, weight in enumerate(weights):
        if weight:
            seen += weight * commands_nm[source[np.maximum(place - lag, 0)] + 1]
    return seen


def counterfactual(controller: Controller, weights: Single, pol_nm: Single, missing: Integers) -> tuple[Single, Single]:
    """Run a controller on a disturbance, from a flat mirror; return its errors and commands (steps, modes).

    Args:
        controller: the controller; it is not called for refused frames, which hold the command.
        weights: from `lowfc.control.laws.stability.delay_weights`.
        pol_nm: (steps, modes) disturbance and measurement noise; NaN for refused frames, whose error is then NaN too.
        missing: (steps,) from `missing_before`.
    """
    usable = np.isfinite(pol_nm.sum(axis=1)).tolist()
    gaps = np.minimum(missing, len(weights)).tolist()
    terms = [(lag, weight) for lag, weight in enumerate(weights.astype(np.float32)) if weight]
    history = [np.zeros(pol_nm.shape[1], np.float32)] * len(weights)
    error_nm, command_nm = np.full_like(pol_nm, np.nan), np.zeros_like(pol_nm)
    state = None
    for row, pol in enumerate(pol_nm):
        if gaps[row]:
            history = (history[:1] * gaps[row] + history)[: len(history)]
        held = history[0]
        if usable[row]:
            seen = sum(weight * history[lag] for lag, weight in terms)
            error_nm[row] = pol + seen
            state, held = controller(state, error_nm[row], pol)
        command_nm[row] = held
        history = [held, *history[:-1]]
    return error_nm, command_nm


def delay_from_truth(true_nm: Single, command_nm: Single, missing: Integers) -> float | None:
    """Delay in frames at which the commands (steps, modes) best match the mirror's true motion (steps, modes).

    It follows from a least-squares fit of `delay_weights`; `true_nm` may have rows of NaN. None if the commands hardly
    move, or if fewer than 20 rows are finite.
    """
    rows = np.isfinite(true_nm).all(axis=1)
    if rows.sum() < _MIN_STEPS:
        return None
    first_nm, best = command_nm[0], (np.inf, 1.0)
    for lag in range(1, MAX_DELAY_FRAMES):
        newer, older = (
            seen_nm(delay_weights(delay).astype(np.float32), command_nm, missing, first_nm)[rows].astype(np.float64)
            for delay in (lag, lag + 1)
        )
        move, difference = older - newer, true_nm[rows] - newer
        if np.sqrt(np.mean(move**2)) < _STILL_NM:
            return None
        fraction = float(np.clip(np.sum(difference * move) / np.sum(move**2), 0, 1))
        best = min(best, (float(np.sum((difference - fraction * move) ** 2)), lag + fraction))
    return best[1]


def delay_from_times(
    sequence: Sequences, exposure_start_ns: Integers, applied_sequence: Sequences, applied_ns: Integers
) -> float | None:
    """Mean delay in frames: from a command's frame to the first whose exposure began after the command was applied.

    Args:
        sequence: (steps,) sequence of each frame, ascending.
        exposure_start_ns: (steps,) on the clock of `applied_ns`.
        applied_sequence: (reports,) sequence of the frame of the command that the mirror reports as applied.
        applied_ns: (reports,) time of the report.

    Returns:
        The delay; None if fewer than 20 commands have a delay from 1 to 10 frames.
    """
    commanding, first = np.unique(applied_sequence, return_index=True)  # a command may be applied repeatedly
    after = np.searchsorted(exposure_start_ns, applied_ns[first], side="right")
    inside = (after > 0) & (after < len(sequence))
    commanding, after = commanding[inside], after[inside]
    neighbours = sequence[after] - sequence[after - 1] == 1  # otherwise an earlier frame may be missing from the log
    delay = (sequence[after] - commanding).astype(np.int64)[neighbours]
    delay = delay[(delay >= 1) & (delay <= 2 * MAX_DELAY_FRAMES)]
    return float(delay.mean()) if len(delay) >= _MIN_STEPS else None


def frames_since(begins: Mask, running: Mask, missing: Integers) -> Integers:
    """Number of frames (steps,) since the loop started to run, or since a step where `begins`; -1 while not running."""
    place = np.arange(len(running)) + np.cumsum(missing)
    started = running & (begins | ~np.concatenate([[False], running[:-1]]))
    return np.where(running, place - np.maximum.accumulate(np.where(started, place, 0)), -1)


def rms(values: npt.NDArray[np.floating], rows: Mask) -> Array:
    """Root mean square (modes,), about zero, of the values (steps, modes) in these rows (steps,), in their unit."""
    return np.asarray(np.sqrt(np.mean(values[rows].astype(np.float64) ** 2, axis=0)))
