"""Fourier transforms between pupils and focal planes, as products of matrices (conventions: `grid`)."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lowfc.arrays import Complex
from lowfc.optics.chain.grid import image_axis, pupil_axis


@lru_cache(maxsize=32)
def kernel(image_samples: int, samples_per: int, pupil_samples: int, scale: float) -> Complex:
    """Kernel exp(-2 pi i x u scale) (image_samples, pupil_samples), read-only; scale is lambda0 / lambda."""
    x = image_axis(image_samples, samples_per)
    u = pupil_axis(pupil_samples)
    matrix: Complex = np.exp(-2j * np.pi * scale * np.outer(x, u))
    matrix.flags.writeable = False
    return matrix


def to_image(pupil: NDArray[np.inexact], image_samples: int, samples_per: int, scale: float) -> Complex:
    """Complex amplitude (image_samples, image_samples) in the focal plane of a square pupil field; conserves energy."""
    matrix = kernel(image_samples, samples_per, pupil.shape[0], scale)
    return (scale / pupil.size) * (matrix @ pupil @ matrix.T)


def to_pupil(image: Complex, pupil_samples: int, samples_per: int, scale: float) -> Complex:
    """Complex amplitude (pupil_samples, pupil_samples) in the pupil that follows a square focal-plane field.

    The inverse of `to_image`, except for the light that falls outside the focal-plane field.
    """
    matrix = kernel(image.shape[0], samples_per, pupil_samples, scale).conj()
    return (scale / samples_per**2) * (matrix.T @ image @ matrix)
