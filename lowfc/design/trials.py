"""Random wavefronts and noisy images (Subedi et al. 2015, Sect. 3.1), and statistics of the residuals of estimates."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from lowfc.arrays import Array
from lowfc.optics.chain.zernike import noll_to_orders

PAPER_BOUNDS_WAVES = (0.04, 0.016)
"""Bounds of coefficients in the paper's Sect. 3.1, waves rms, for radial degrees 1 and 2, and for higher degrees: a
coefficient lies between minus and plus its bound."""

_BLOCK = 100  # wavefronts in memory at once


def bounds_waves(nolls: Sequence[int], to_degree_2: float, above: float) -> Array:
    """Bound (modes,) of each coefficient in waves rms: `to_degree_2` for radial degrees 1 and 2, `above` for others."""
    return np.array([to_degree_2 if noll_to_orders(noll)[0] <= 2 else above for noll in nolls])


def random_wavefronts(
    rng: np.random.Generator, count: int, nolls: Sequence[int], to_degree_2: float, above: float
) -> Array:
    """Coefficients (count, modes) in waves rms, uniform between minus and plus `bounds_waves` (Sect. 3.1).

    They are stratified: each coefficient has one value in each of `count` equal parts of its range, in random order.
    The input's mean square, on which second-order errors depend, therefore hardly differs between seeds.
    """
    strata = rng.permuted(np.tile(np.arange(count), (len(nolls), 1)), axis=1).T
    unit = 2.0 * (strata + rng.uniform(size=strata.shape)) / count - 1.0
    return np.asarray(unit * bounds_waves(nolls, to_degree_2, above))


def noisy_e(rng: np.random.Generator, mean_e: ArrayLike, read_noise_e: float) -> Array:
    """An exposure (any shape) in electrons, with photon noise, read noise and rounding to whole electrons."""
    mean_e = np.maximum(mean_e, 0.0)  # a twin's rounding errors make some dark pixels negative
    return np.asarray(np.rint(rng.poisson(mean_e) + read_noise_e * rng.standard_normal(mean_e.shape)))


def gram(basis: Array) -> Array:
    """Covariance (modes, modes) of modes (modes, samples), in any unit, over the open pupil."""
    centred = basis - basis.mean(axis=1, keepdims=True)
    return np.asarray(centred @ centred.T / basis.shape[1])


def input_rms(gram: Array, bounds: Array) -> float:
    """Rms over the open pupil of wavefronts whose coefficients are uniform within +- bounds (modes,), in their unit."""
    return float(np.sqrt(np.sum(np.diag(gram) * bounds**2) / 3.0))


def expected_rms(gram: Array, covariance: Array) -> float:
    """Expected rms over the open pupil of residuals with this covariance (modes, modes), in their unit."""
    return float(np.sqrt(np.sum(gram * covariance)))


def residual_rms(gram: Array, residuals: Array) -> Array:
    """Rms (n,) over the open pupil of residual coefficients (n, modes), in their unit."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("nj,jk,nk->n", residuals, gram, residuals), 0.0)))


def residual_pv(basis: Array, residuals: Array) -> Array:
    """Peak to valley (n,) over the open pupil of residual coefficients (n, modes), in their unit.

    Args:
        basis: Modes (modes, samples) at the open samples.
        residuals: (n, modes) truth minus estimate.
    """
    blocks = (residuals[i : i + _BLOCK] @ basis for i in range(0, len(residuals), _BLOCK))
    return np.concatenate([np.ptp(block, axis=1) for block in blocks])


def expected_r_squared(variances: Array, bounds: Array) -> Array:
    """Limit of `r_squared` (modes,), without unit, for many estimates, if errors do not depend on the truth.

    Args:
        variances: (modes,) variances of the errors.
        bounds: (modes,) bounds of the coefficients, which are uniform between minus and plus these.
    """
    return np.asarray(1.0 - variances / (bounds**2 / 3.0 + variances))


def r_squared(estimates: Array, truth: Array) -> Array:
    """Coefficient of determination (modes,), without unit, of estimates (n, modes), as below the paper's eq. (15)."""
    residual = np.sum((estimates - truth) ** 2, axis=0)
    total = np.sum((estimates - estimates.mean(axis=0)) ** 2, axis=0)
    return np.asarray(1.0 - residual / total)
