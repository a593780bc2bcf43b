"""A calibration with another dark, mask or reference image: everything that hangs on them made anew."""

from dataclasses import replace

import numpy as np

from lowfc.arrays import Array, single
from lowfc.control.calibration.calibration import Calibration, normalise_flux
from lowfc.control.calibration.regularised import reconstruct

MEASURED = frozenset(("poke", "hadamard", "in-loop"))
"""Names in `Calibration.estimator` of ways to measure H."""
_LEAST_LEFT = 1e-3
"""Part of an answer to the modes below which it counts as none."""


def with_dark(calibration: Calibration, dark_dn: Array, good: Array, read_noise_e: float, gain_e: float) -> Calibration:
    """The calibration with another dark (pixels,), DN, and only the pixels (pixels,) that are 1 in `good`.

    Pixels that were bad stay bad. I0 and H pass through the flux normalisation of the pixels that are left, and R is
    made anew from them, for this read noise of a pixel and electrons per DN.

    Raises:
        ValueError: too little is left to tell the modes apart.
    """
    kept = good * calibration.good
    I0, H = calibration.reference.astype(np.float64), calibration.response.astype(np.float64)
    share = float(I0 @ kept)
    I0, H = normalise_flux(I0, H, kept)
    changed = replace(
        calibration,
        reference=single(I0),
        response=single(H),
        good=single(kept),
        dark=single(dark_dn),
        flux_dn=calibration.flux_dn * share,
    )
    if is_measured(calibration):
        return replace(changed, reconstructor=single(_same_answers(calibration, changed)), operator_hash="", id="")
    return _reconstructed(changed, read_noise_e, gain_e)


def with_reference(
    calibration: Calibration, reference: Array, flux_dn: float, read_noise_e: float, gain_e: float
) -> Calibration:
    """The calibration with another zero point (pixels,), in flux fractions, and mean flux; H stays.

    Raises:
        ValueError: there is no light on the good pixels.
    """
    I0, _ = normalise_flux(reference, calibration.response.astype(np.float64), calibration.good.astype(np.float64))
    changed = replace(calibration, reference=single(I0), flux_dn=flux_dn)
    if is_measured(calibration):
        return replace(changed, operator_hash="", id="")
    return _reconstructed(changed, read_noise_e, gain_e)


def is_measured(calibration: Calibration) -> bool:
    """Whether H was measured: it has noise, of which no R is made (see `regularised`)."""
    return not MEASURED.isdisjoint(calibration.estimator.split("+"))


def _same_answers(before: Calibration, changed: Calibration) -> Array:
    """(modes, pixels): on the pixels that are left, R answers to the modes as it did on all.

    Raises:
        ValueError: too little is left to tell the modes apart.
    """
    answers = before.reconstructor.astype(np.float64) @ before.response
    rows = before.reconstructor.astype(np.float64) * changed.good
    left = rows @ changed.response
    if np.linalg.matrix_rank(left, _LEAST_LEFT) < np.linalg.matrix_rank(answers, _LEAST_LEFT):
        raise ValueError("the good pixels that are left do not tell the modes apart")
    return np.asarray(answers @ np.linalg.pinv(left, _LEAST_LEFT) @ rows)


def _reconstructed(calibration: Calibration, read_noise_e: float, gain_e: float) -> Calibration:
    """R anew from I0 and H, by the weights that its name says."""
    estimator = calibration.estimator.partition("+")[0]
    made = reconstruct(
        calibration.reference.astype(np.float64),
        calibration.response.astype(np.float64),
        None,
        calibration.good.astype(np.float64),
        calibration.flux_dn * gain_e,
        read_noise_e,
        estimator,
    )
    return replace(calibration, reconstructor=single(made.matrix), operator_hash="", id="")
