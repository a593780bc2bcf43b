"""Verdict on the wavefront: the residual, compared with a flat mirror and with the best gains."""

from functools import partial
from math import hypot, sqrt

from lowfc.contract.messages import wire
from lowfc.programs.cli.contrast import ESTIMATED, QUADRATIC
from lowfc.programs.cli.correction import Correction, correction
from lowfc.programs.cli.status import holds_shape
from lowfc.programs.view.verdicts.run_state import RunState
from lowfc.programs.view.verdicts.steady import ResidualComparison
from lowfc.programs.view.verdicts.tile import Level, Tile, rounded, short

DIVERGING = 3.0
"""Ratio of the residual to the wavefront with a flat mirror above which the loop is unstable or has wrong signs."""
NEAR_BEST = 1.3
"""Ratio of the residual to the residual with the best gains, above which the gains are worth tuning."""
NOISE_FLOOR = 0.2
"""Uncertainty of a residual whose noise was subtracted, as a fraction of the sensor's noise."""
UNCORRECTED = ("OPEN", "SAFE", "IDLE", "WAITING", "DEAD", "NO CONTROLLER")
"""Values of the tile LOOP that mean that the wavefront is not corrected."""


def wavefront(state: RunState, nm_per_mas: float | None, loop: Tile) -> Tile:
    """Tile WAVEFRONT: the residual, compared with a flat mirror."""
    tile, rms, comparison = partial(Tile, "WAVEFRONT"), state.wavefront, state.comparison
    if rms is None:
        return tile("?", "not measured now")
    residual = rounded(rms.residual_nm)
    value, flat, remarks = f"{residual} nm rms", f"{rounded(rms.open_nm)} nm with a flat mirror", "true"
    if not state.true:
        remarks = f"measured, {_without_noise(rms.residual_nm, comparison)}" if comparison else "measured, with noise"
    if nm_per_mas and rms.tilt_open_nm:
        tilt, before = (rounded(one / nm_per_mas) for one in (rms.tilt_residual_nm, rms.tilt_open_nm))
        remarks = f"tilt {tilt} of {before} mas per axis; {remarks}"
    if loop.value == "ENDED":
        return tile(f"last: {residual} nm", f"of {flat}; {remarks}")
    if loop.level is not Level.GOOD:
        return tile(value, f"{'not corrected;' if loop.value in UNCORRECTED else 'of'} {flat}; {remarks}")
    if state.true and holds_shape(state.snapshot.controller):
        why = f"The wavefront is {value}, including the shapes of offset and channels; {flat}."
        return tile(value, f"with offset and channels; {flat}; {remarks}", advice=why)
    reduction, latest = rms.open_nm / rms.residual_nm if rms.residual_nm else 1.0, state.latest
    if latest is not None and {correction(one.residual_nm, one.open_nm) for one in (rms, latest)} == {Correction.HARM}:
        level = Level.BAD if reduction < 1 / DIVERGING else Level.WARNING
        controller = state.snapshot.controller
        law = controller is not None and controller.HasField("law")  # a law has no gain to lower
        remedy = "Return to the integrator, `lowfc ctl law integrator`," if law else "Lower the gain"
        advice = f"The loop does harm: {residual} nm rms, {flat}. {remedy} or open the loop."
        return tile(value, f"worse than {flat}; {remarks}", level, advice)
    noise_nm = comparison.noise_nm if comparison is not None and not state.true else 0.0
    level, why = level_and_reason(reduction_of(rms.residual_nm, rms.open_nm, noise_nm), comparison)
    compared = f"{reduction:.1f} x better than" if reduction >= 1 else "of"
    advice = f"The residual of the last second is {value}, compared with {flat}{why}."
    return tile(value, f"{compared} {flat}; {remarks}", level, advice)


def contrast(figures: wire.WavefrontFigures, *, now: bool, estimated: bool) -> Tile:
    """Tile CONTRAST: what the wavefront adds to the contrast of the dark zone; the tile has no threshold.

    `estimated`: whether it is computed from the controller's measurements, not from the true wavefront.
    """
    if not now:
        return Tile("CONTRAST", "?", "not measured now")
    share = f"most from {short(figures.costliest_modes)} ({100 * figures.costliest_share:.0f} %)"
    flat = f"added to the dark zone; {figures.added_contrast_flat:.1e} with a flat mirror"
    source = ESTIMATED if estimated else ""
    return Tile("CONTRAST", f"{figures.added_contrast:+.1e}", f"{flat}; {share}{source}{QUADRATIC}")


def reduction_of(residual_nm: float, open_nm: float, noise_nm: float) -> float:
    """Rms with a flat mirror divided by the rms of the residual, both without the sensor's noise."""
    least_nm = max(NOISE_FLOOR * noise_nm, 1e-9)
    residual_nm, open_nm = (max(sqrt(max(one**2 - noise_nm**2, 0.0)), least_nm) for one in (residual_nm, open_nm))
    return open_nm / residual_nm


def level_and_reason(reduction: float, comparison: ResidualComparison | None) -> tuple[Level, str]:
    """Level of a closed loop that does no harm, and the reason if it is not good."""
    good = correction(1.0, reduction) is Correction.GOOD
    if comparison is None:
        return (Level.GOOD, "") if good else (Level.NEUTRAL, ": little is corrected")
    if comparison.residual_nm > hypot(NEAR_BEST * comparison.best_nm, NOISE_FLOOR * comparison.noise_nm):
        ratio = comparison.residual_nm / max(comparison.best_nm, 1e-9)
        return Level.NEUTRAL, f", {ratio:.1f} x the residual of the best gains: run `lowfc tune --live 20`"
    if good:
        return Level.GOOD, ""
    best = comparison.residual_nm <= NEAR_BEST * comparison.best_nm
    return Level.NEUTRAL, ": little is corrected" + (", and other gains would not correct more" if best else "")


def _without_noise(residual_nm: float, comparison: ResidualComparison) -> str:
    residual_nm, least_nm = sqrt(max(residual_nm**2 - comparison.noise_nm**2, 0.0)), NOISE_FLOOR * comparison.noise_nm
    return f"{rounded(residual_nm) if residual_nm > least_nm else f'below {rounded(least_nm)}'} nm without noise"
