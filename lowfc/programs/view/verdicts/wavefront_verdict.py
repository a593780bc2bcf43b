"""Judgement on the wavefront: how much is left, beside what there was and what the loop could leave."""

from functools import partial
from math import hypot, sqrt

from lowfc.contract.messages import wire
from lowfc.control.loop.command_channels import FLAT
from lowfc.programs.view.verdicts.run_state import RunState
from lowfc.programs.view.verdicts.steady import Attained
from lowfc.programs.view.verdicts.tile import Level, Tile, figure

WORSE = 1.1
"""A closed loop that leaves more than was there, by more than the scatter of a second's rms, does harm."""
DIVERGING = 3.0
"""So much more than was there is no bad tuning any more: the loop is unstable, or its signs are wrong."""
GOOD_FACTOR = 2.0
"""Starlight leaks with the square of the residual wavefront: this factor leaves a quarter of it, 1.5 leaves 44 %."""
NEAR_BEST = 1.3
"""A loop that leaves this much more than the best gains would has gains that are worth tuning."""
NOISE_FLOOR = 0.2
"""Of the sensor's noise, which is subtracted: what is left is known no better than this share of it."""
UNCORRECTED = ("OPEN", "SAFE", "DEAD")
"""Values of the tile LOOP under which nothing is corrected."""


def wavefront(state: RunState, nm_per_mas: float | None, loop: Tile) -> Tile:
    """What is left of the wavefront, beside what a flat mirror would leave."""
    tile, found, attained = partial(Tile, "WAVEFRONT"), state.wavefront, state.attained
    if found is None:
        return tile("?", "not measured now")
    left = figure(found.residual_nm)
    value, flat, more = f"{left} nm rms", f"{figure(found.open_nm)} nm with a flat mirror", "true"
    if not state.true:
        more = f"measured, {_without_noise(found.residual_nm, attained)}" if attained else "measured, with noise"
    if nm_per_mas and found.tilt_open_nm:
        tilt, before = (figure(one / nm_per_mas) for one in (found.tilt_residual_nm, found.tilt_open_nm))
        more = f"tilt {tilt} of {before} mas per axis; {more}"
    if loop.value == "ENDED":
        return tile(f"last: {left} nm", f"of {flat}; {more}")
    if loop.level is not Level.GOOD:
        return tile(value, f"{'not corrected;' if loop.value in UNCORRECTED else 'of'} {flat}; {more}")
    if state.true and _shaped(state.snapshot.controller):
        why = f"{value} of wavefront, the shapes of offset and channels in it; {flat}."
        return tile(value, f"with offset and channels; {flat}; {more}", advice=why)
    raw, latest = found.open_nm / found.residual_nm if found.residual_nm else 1.0, state.latest
    if raw < 1 / WORSE and latest is not None and latest.residual_nm > WORSE * latest.open_nm:
        level = Level.BAD if raw < 1 / DIVERGING else Level.WARNING
        advice = f"The loop does harm: {left} nm rms, {flat}. Lower the gain or open the loop."
        return tile(value, f"worse than {flat}; {more}", level, advice)
    noise_nm = attained.noise_nm if attained is not None and not state.true else 0.0
    level, why = merit(factor(found.residual_nm, found.open_nm, noise_nm), attained)
    compared = f"{raw:.1f} x better than" if raw >= 1 else "of"
    return tile(value, f"{compared} {flat}; {more}", level, f"{value} of wavefront are left of {flat}{why}.")


def contrast(known: wire.WavefrontFigures, *, now: bool) -> Tile:
    """What the wavefront adds to the contrast of the dark zone; a figure without a threshold, for nobody set one."""
    if not now:
        return Tile("CONTRAST", "?", "not measured now")
    share = f"{known.costliest_modes} contributes most ({100 * known.costliest_share:.0f} %)"
    flat = f"added to the dark zone; {known.added_contrast_flat:.1e} with a flat mirror"
    return Tile("CONTRAST", f"{known.added_contrast:+.1e}", f"{flat}; {share}")


def factor(left_nm: float, open_nm: float, noise_nm: float) -> float:
    """By how much a loop makes the wavefront better, without the sensor's noise."""
    least_nm = max(NOISE_FLOOR * noise_nm, 1e-9)
    left_nm, open_nm = (max(sqrt(max(one**2 - noise_nm**2, 0.0)), least_nm) for one in (left_nm, open_nm))
    return open_nm / left_nm


def merit(better: float, attained: Attained | None) -> tuple[Level, str]:
    """Level of a closed loop that does no harm, and why it is not green."""
    if attained is None:
        return (Level.GOOD, "") if better >= GOOD_FACTOR else (Level.NEUTRAL, ": little is corrected")
    if attained.left_nm > hypot(NEAR_BEST * attained.best_nm, NOISE_FLOOR * attained.noise_nm):
        times = attained.left_nm / max(attained.best_nm, 1e-9)
        return Level.NEUTRAL, f", {times:.1f} x what the best gains would leave: `lowfc tune` finds them"
    if better >= GOOD_FACTOR:
        return Level.GOOD, ""
    best = attained.left_nm <= NEAR_BEST * attained.best_nm
    return Level.NEUTRAL, ": little is corrected" + (", and other gains correct no more" if best else "")


def _shaped(state: wire.ControllerState | None) -> bool:
    """Whether the loop holds another wavefront than the flattest one: the truth is not what is left then."""
    return state is not None and (any(state.offset_nm) or any(one.name != FLAT for one in state.channels))


def _without_noise(residual_nm: float, attained: Attained) -> str:
    left_nm, least_nm = sqrt(max(residual_nm**2 - attained.noise_nm**2, 0.0)), NOISE_FLOOR * attained.noise_nm
    return f"{figure(left_nm) if left_nm > least_nm else f'below {figure(least_nm)}'} nm without noise"
