"""What noise leaves of an estimate: the covariance of a linear one, and the least that any unbiased one can have."""

import numpy as np

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import SINGULAR, condition_number


def variance_e(reference_e: Array, read_noise_e: float) -> Array:
    """Variance (pixels,) of the noise of the flat wavefront's image, photon and read noise (Sects. 3 and 3.3).

    Rounding to whole electrons is left out: its 1/12 e-^2 changes no scatter of Table 4 by more than 1 %.

    Args:
        reference_e: I0 (pixels,) in electrons.
        read_noise_e: Of each pixel.
    """
    return np.asarray(np.maximum(reference_e, 0.0) + read_noise_e**2)


def covariance(R: Array, variance: Array) -> Array:
    """Covariance (modes, modes) of the estimate R (I - I0), in nm^2.

    Args:
        R: (modes, pixels) nm per electron.
        variance: (pixels,) of the image, in electrons squared.
    """
    return np.asarray((R * variance) @ R.T)


def cramer_rao(H: Array, variance: Array) -> Array:
    """Inverse Fisher information (modes, modes), nm^2: no unbiased linear estimate has a smaller covariance.

    The information is that of the image's mean; the little that the photon noise's own variance adds is not counted.

    Args:
        H: (pixels, modes) electrons per nm.
        variance: (pixels,) of the image, in electrons squared; a pixel without any carries no information.

    Raises:
        ValueError: The modes cannot be told apart.
    """
    weights = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0)
    weighted = np.sqrt(weights)[:, None] * H
    if not condition_number(weighted) < SINGULAR:
        raise ValueError("the sensor cannot tell the modes apart: its Fisher information is singular; use fewer modes")
    inverse = np.linalg.pinv(weighted)
    return np.asarray(inverse @ inverse.T)
