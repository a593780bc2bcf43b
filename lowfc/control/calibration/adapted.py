"""Change the dark, the pixels or the reference image of a calibration, and adapt all but `actuators_to_modes`."""

from dataclasses import replace

import numpy as np

from lowfc.arrays import Array, single
from lowfc.control.calibration.calibration import ESTIMATORS, Calibration, normalise_flux
from lowfc.control.calibration.regularised import reconstruct

_MIN_RESPONSE = 1e-3
"""Singular value of R H, relative to the largest, below which a combination of modes counts as not measured."""


def with_dark(
    calibration: Calibration, dark_dn: Array, good: Array, read_noise_e: float, gain_e_per_dn: float
) -> Calibration:
    """The calibration with another dark (pixels,), DN, and only those pixels for which `good` (pixels,) is 1.

    R is that of `on_pixels`; a plain R (see `_is_plain`) is recomputed instead, with a read noise of `read_noise_e`
    electrons per pixel and a gain of `gain_e_per_dn`.

    Raises:
        ValueError: the remaining pixels have no light, or do not tell the modes apart.
    """
    changed = replace(on_pixels(calibration, good), dark=single(dark_dn))
    return _reconstructed(changed, read_noise_e, gain_e_per_dn) if _is_plain(calibration) else changed


def on_pixels(calibration: Calibration, good: Array) -> Calibration:
    """The calibration on fewer pixels (`good` (pixels,) is 1 where a pixel stays), with an R that leaves R H unchanged.

    Pixels that were bad stay bad. I0 and H are normalised to the flux on the remaining pixels. `operator_hash` and `id`
    of the result are empty.

    Raises:
        ValueError: the remaining pixels have no light, or do not tell the modes apart.
    """
    kept = good * calibration.good
    I0, H = calibration.reference.astype(np.float64), calibration.response.astype(np.float64)
    share = float(I0 @ kept)
    I0, H = normalise_flux(I0, H, kept)
    changed = replace(
        calibration, reference=single(I0), response=single(H), good=single(kept), flux_dn=calibration.flux_dn * share
    )
    return replace(changed, reconstructor=single(_same_response(calibration, changed)), operator_hash="", id="")


def with_reference(
    calibration: Calibration, reference: Array, flux_dn: float, read_noise_e: float, gain_e_per_dn: float
) -> Calibration:
    """The calibration with another reference image (pixels,), in flux fractions, and mean flux, DN.

    H stays. A plain R (see `_is_plain`) is recomputed, with a read noise of `read_noise_e` electrons per pixel and a
    gain of `gain_e_per_dn`; any other R stays. `operator_hash` and `id` of the result are empty.

    Raises:
        ValueError: there is no light on the good pixels.
    """
    I0, _ = normalise_flux(reference, calibration.response.astype(np.float64), calibration.good.astype(np.float64))
    changed = replace(calibration, reference=single(I0), flux_dn=flux_dn)
    if _is_plain(calibration):
        return _reconstructed(changed, read_noise_e, gain_e_per_dn)
    return replace(changed, operator_hash="", id="")


def _is_plain(calibration: Calibration) -> bool:
    """Whether R is plain: computed from I0 and H, without nuisance parameters and regularisation.

    The R of a measured H is not plain, since the noise of H must not enter it (see `regularised`).
    """
    estimator, *parts = calibration.estimator.split("+")
    return estimator in ESTIMATORS and all(part in ("aligned", "first") or part.startswith("at ") for part in parts)


def _same_response(before: Calibration, changed: Calibration) -> Array:
    """R (modes, pixels) on the remaining pixels, with the same response R H to the modes as on all pixels.

    Raises:
        ValueError: the remaining pixels do not tell the modes apart.
    """
    response = before.reconstructor.astype(np.float64) @ before.response
    rows = before.reconstructor.astype(np.float64) * changed.good
    remaining = rows @ changed.response
    if _rank(remaining) < _rank(response):
        raise ValueError("the remaining good pixels do not tell the modes apart")
    return np.asarray(response @ np.linalg.pinv(remaining, _MIN_RESPONSE) @ rows)


def _rank(matrix: Array) -> int:
    return int(np.linalg.matrix_rank(matrix, rtol=_MIN_RESPONSE))


def _reconstructed(calibration: Calibration, read_noise_e: float, gain_e_per_dn: float) -> Calibration:
    """Recompute R from I0 and H, with the weights of its estimator."""
    reconstruction = reconstruct(
        calibration.reference.astype(np.float64),
        calibration.response.astype(np.float64),
        None,
        calibration.good.astype(np.float64),
        calibration.flux_dn * gain_e_per_dn,
        read_noise_e,
        calibration.estimator.partition("+")[0],
    )
    return replace(calibration, reconstructor=single(reconstruction.matrix), operator_hash="", id="")
