"""Judgement on the wavefront: how much is left, beside what there was and what the loop could leave."""

import numpy as np

from lowfc.programs.view.verdicts.steady import Attained
from lowfc.programs.view.verdicts.tile import Level, Tile, figure
from lowfc.programs.view.verdicts.watcher import Rms, Watcher

WORSE = 1.1
"""A closed loop that leaves more than was there, by more than the scatter of a second's rms, does harm."""
LATEST_S = 0.3
"""It must still do so at the end of that second: a loop that has just begun, or caught up, is better by then."""
DIVERGING = 3.0
"""So much more than was there is no bad tuning any more: the loop is unstable, or its signs are wrong."""
GOOD_FACTOR = 2.0
"""Starlight leaks with the square of the residual wavefront: this factor leaves a quarter of it, 1.5 leaves 44 %."""
NEAR_BEST = 1.3
"""A loop that leaves this much more than the best gains would has gains that are worth tuning."""
NOISE_FLOOR = 0.2
"""Of the sensor's noise, which is subtracted: what is left is known no better than this share of it."""
UNCORRECTED = ("OPEN", "SAFE", "DEAD")
"""The loop as it is where nothing corrects; where it waits or has ended, that would say something else."""


def wavefront(watcher: Watcher, nm_per_mas: float | None, loop: Tile) -> Tile:
    """What is left of the wavefront, beside what a flat mirror would leave."""
    title, ended = "WAVEFRONT", loop.value == "ENDED"
    found, true = watcher.wavefront(ended=ended)
    if found is None:
        return Tile(title, "?", "not measured now", Level.NEUTRAL)
    value = f"{figure(found.residual_nm)} nm rms"
    flat = f"{figure(found.open_nm)} nm with a flat mirror"
    attained = watcher.attainable.found
    more = f"{_tilt(found, nm_per_mas)}{'true' if true else _measured(found, attained)}"
    if ended:
        return Tile(title, f"last: {figure(found.residual_nm)} nm", f"of {flat}; {more}", Level.NEUTRAL)
    if loop.level is not Level.GOOD:
        compared = f"not corrected; {flat}" if loop.value in UNCORRECTED else f"of {flat}"
        return Tile(title, value, f"{compared}; {more}", Level.NEUTRAL)
    latest, _ = watcher.wavefront(LATEST_S)
    raw = found.open_nm / found.residual_nm if found.residual_nm else 1.0
    if raw < 1 / WORSE and latest is not None and latest.residual_nm > WORSE * latest.open_nm:
        level = Level.BAD if raw < 1 / DIVERGING else Level.WARNING
        advice = f"The loop does harm: {figure(found.residual_nm)} nm rms, {flat}. Lower the gain or open the loop."
        return Tile(title, value, f"worse than {flat}; {more}", level, advice)
    level, why = merit(factor(found, true, attained), attained)
    compared = f"{raw:.1f} x better than" if raw >= 1 else "of"
    left = f"{figure(found.residual_nm)} nm rms of wavefront are left of {flat}"
    return Tile(title, value, f"{compared} {flat}; {more}", level, f"{left}{why}.")


def factor(found: Rms, true: bool, attained: Attained | None) -> float:
    """By how much a loop makes the wavefront better, without the sensor's noise where that is known."""
    noise_nm = attained.noise_nm if attained is not None and not true else 0.0
    least_nm = max(NOISE_FLOOR * noise_nm, 1e-9)
    left_nm, open_nm = (
        max(float(np.sqrt(max(one**2 - noise_nm**2, 0.0))), least_nm) for one in (found.residual_nm, found.open_nm)
    )
    return open_nm / left_nm


def merit(better: float, attained: Attained | None) -> tuple[Level, str]:
    """Level of a closed loop that does no harm, and why it is not green."""
    if attained is not None:
        near_nm = float(np.hypot(NEAR_BEST * attained.best_nm, NOISE_FLOOR * attained.noise_nm))
        if attained.left_nm > near_nm:
            times = attained.left_nm / max(attained.best_nm, 1e-9)
            return Level.NEUTRAL, f", {times:.1f} x what the best gains would leave: `lowfc tune` finds them"
    if better >= GOOD_FACTOR:
        return Level.GOOD, ""
    best = attained is not None and attained.left_nm <= NEAR_BEST * attained.best_nm
    return Level.NEUTRAL, ": little is corrected" + (", and other gains correct no more" if best else "")


def _measured(found: Rms, attained: Attained | None) -> str:
    if attained is None:
        return "measured, with noise"
    left_nm = float(np.sqrt(max(found.residual_nm**2 - attained.noise_nm**2, 0.0)))
    least_nm = NOISE_FLOOR * attained.noise_nm
    without = f"{figure(left_nm)} nm" if left_nm > least_nm else f"below {figure(least_nm)} nm"
    return f"measured; {without} without noise"


def _tilt(found: Rms, nm_per_mas: float | None) -> str:
    if not nm_per_mas or not found.tilt_open_nm:
        return ""
    residual, before = (figure(one / nm_per_mas) for one in (found.tilt_residual_nm, found.tilt_open_nm))
    return f"tilt {residual} of {before} mas per axis; "
