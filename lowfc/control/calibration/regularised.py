"""Reconstructor of a measured or computed response matrix H, with optional truncation or damping.

A measured H contains the noise of thousands of pixels. Its own (H'WH)^-1 H'W contains that noise twice: it measures
every mode too small, and adds noise to every frame. R = (R_a H)^-1 R_a, with any R_a of full rank that does not depend
on that noise, is unbiased and has the noise of R_a.
"""

from typing import NamedTuple

import numpy as np

from lowfc.arrays import Array, Single
from lowfc.control.calibration.calibration import ESTIMATORS
from lowfc.control.calibration.response_fit import WORST_CONDITION

_NOT_TOLD_APART = (
    "the response does not tell the modes apart: use more cycles, a larger amplitude or a brighter star; or drop "
    "combinations of modes with --truncate"
)


class Reconstruction(NamedTuple):
    """R and the singular values of its response matrix.

    Attributes:
        matrix: (modes, pixels) R, nm per flux fraction; zero at bad pixels.
        singular_values: (modes,) singular values of the weighted H, descending. For the weighted estimator, 1 / value
            is the noise in nm with which one frame measures that combination of modes.
        kept: (modes,) fraction of each combination that is kept: 0 if truncated, 1 if unchanged.
        condition_number: largest over smallest singular value.
        combinations: (modes, modes) combination of modes of each singular value, in columns.
    """

    matrix: Array
    singular_values: Array
    kept: Array
    condition_number: float
    combinations: Array


def reconstruct(
    reference: Array,
    response: Array,
    initial: Array | None,
    good: Array,
    flux_e: float,
    read_noise_e: float,
    estimator: str = "weighted",
    truncate: float = 0.0,
    tikhonov: float = 0.0,
) -> Reconstruction:
    """R from a computed H, (H'WH)^-1 H'W, or from a measured one, (R_a H)^-1 R_a.

    Args:
        reference: (pixels,) I0, normalised.
        response: (pixels, modes) H, normalised.
        initial: (modes, pixels) R_a for a measured H; R ignores what R_a ignores in an image. None for a computed H.
        good: (pixels,) 1 for a used pixel, else 0.
        flux_e: Electrons on the good pixels.
        read_noise_e: Read noise of a pixel.
        estimator: For a computed H: weighted or pinv, as for `calibration.reconstructor`.
        truncate: Combinations of modes with a singular value below this fraction of the largest are dropped.
        tikhonov: A combination with singular value s is multiplied by s^2 / (s^2 + (tikhonov s_largest)^2).

    Raises:
        ValueError: an argument is out of range, or H does not tell the modes apart.
    """
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
    if not (0 <= truncate < 1 and 0 <= tikhonov < 1):
        raise ValueError(f"truncation and damping must be at least 0 and below 1, got {truncate} and {tikhonov}")
    variance = pixel_variance(reference, flux_e, read_noise_e)
    if initial is None:
        weights = good / variance if estimator == "weighted" else good / variance.mean()
        signal = (response * weights[:, None]).T
        power = signal @ response
    else:
        rows = initial * good
        product = rows @ response
        if not np.linalg.cond(product) < WORST_CONDITION:
            raise ValueError(_NOT_TOLD_APART)
        unbiased = np.linalg.solve(product, rows)
        power = np.linalg.inv((unbiased * variance) @ unbiased.T)  # H'WH for the weighted estimator
        signal = power @ unbiased
    squares, combinations = np.linalg.eigh(power)
    squares, combinations = squares[::-1], combinations[:, ::-1]
    smallest = max(1e-16, truncate**2) * squares[0]
    if not squares[0] > 0 or (truncate == 0 and not squares[-1] > smallest):
        raise ValueError(_NOT_TOLD_APART)
    kept = np.where(squares > smallest, squares / (squares + tikhonov**2 * squares[0]), 0.0)
    inverse = (combinations * (kept / np.where(squares > smallest, squares, 1.0))) @ combinations.T
    matrix = inverse @ signal
    singular = np.sqrt(np.maximum(squares, 0))
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")
    return Reconstruction(np.asarray(matrix), singular, kept, condition, combinations)


def pixel_variance(reference: Array, flux_e: float, read_noise_e: float) -> Array:
    """Variance (pixels,) of a frame's flux fractions, from the photon noise of I0 (pixels,) and read noise."""
    variance = (np.maximum(reference, 0) * flux_e + read_noise_e**2) / flux_e**2
    return np.asarray(np.maximum(variance, 1e-12 * variance.max()))


def advice(reconstruction: Reconstruction, noll: tuple[int, ...], limit_nm: Single) -> str:
    """Advice on poorly measured combinations of modes, in one sentence.

    Args:
        reconstruction: R and its singular values, by the weighted estimator.
        noll: Noll index of each mode.
        limit_nm: (modes,) largest command; the loop cannot follow a combination with more noise in a frame than the
            limit of the mode with the largest part in the combination.
    """
    noise_nm, kept = 1 / np.maximum(reconstruction.singular_values, 1e-300), reconstruction.kept
    suppressed, least = int(np.count_nonzero(kept < 0.5)), float(kept.min())
    if suppressed:
        return (
            f"{suppressed} of {len(noll)} combinations of modes are suppressed: they are not controlled, and their "
            "disturbance remains; the modes in them are measured too small"
        )
    if least <= 0.999:
        return f"the worst-measured combination of modes is damped to {least:.1%}: its modes are measured too small"
    limits_nm = limit_nm[np.abs(reconstruction.combinations).argmax(axis=0)]
    bad = np.flatnonzero(noise_nm > limits_nm)
    if bad.size == 0:
        return (
            "no regularisation needed: the worst-measured combination of modes has "
            f"{noise_nm[-1]:.2g} nm of noise in a frame"
        )
    worst = np.argsort(-np.abs(reconstruction.combinations[:, bad[-1]]))[:2]
    names = " and ".join(f"Z{noll[mode]}" for mode in worst)
    cut = reconstruction.singular_values[bad[0]] / reconstruction.singular_values[0]
    drop = f", or drop them with --truncate {1.01 * cut:.3g}" if bad[0] else ""  # if all are bad, none would be left
    return (
        f"{bad.size} of {len(noll)} combinations of modes (mostly {names}) are measured with more noise than "
        f"their limit of {limits_nm[bad].min():g} nm: use fewer modes, lower their gains{drop}"
    )
