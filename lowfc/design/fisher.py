"""Covariance of the noise of a linear estimate, and lower bounds on it.

The Cramer-Rao bound holds for a given sensor, the quantum limit for any measurement of the light.
"""

import numpy as np

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import SINGULAR_CONDITION, condition_number
from lowfc.optics.chain.grid import OPEN_AREA


def variance_e2(reference_e: Array, read_noise_e: float) -> Array:
    """Variance (pixels,), e-^2, of photon and read noise in the flat wavefront's image (the paper's Sects. 3, 3.3).

    Rounding to whole electrons is neglected: its 1/12 e-^2 changes no scatter of Table 4 by more than 1 %.

    Args:
        reference_e: I0 (pixels,) in electrons.
        read_noise_e: Read noise of each pixel.
    """
    return np.asarray(np.maximum(reference_e, 0.0) + read_noise_e**2)


def covariance(R: Array, variance: Array) -> Array:
    """Covariance (modes, modes) of the estimate R (I - I0), in nm^2.

    Args:
        R: (modes, pixels) nm per electron.
        variance: (pixels,) variance of the image, in electrons squared.
    """
    return np.asarray((R * variance) @ R.T)


def cramer_rao(H: Array, variance: Array) -> Array:
    """Inverse Fisher information (modes, modes), nm^2: no unbiased linear estimate has a smaller covariance.

    It includes the information in the mean image, but not the little information in the variance of the photon noise.

    Args:
        H: (pixels, modes) electrons per nm.
        variance: (pixels,) variance of the image, in electrons squared; pixels with zero variance are ignored.

    Raises:
        ValueError: The sensor cannot distinguish the modes.
    """
    weights = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0)
    weighted = np.sqrt(weights)[:, None] * H
    if not condition_number(weighted) < SINGULAR_CONDITION:
        raise ValueError("the sensor cannot tell the modes apart: its Fisher information is singular; use fewer modes")
    inverse = np.linalg.pinv(weighted)
    return np.asarray(inverse @ inverse.T)


def quantum_information(pupil: Array, modes: Array, wavelength_nm: float, light_e: float = 1.0) -> Array:
    """Quantum Fisher information (modes, modes), per nm^2: the upper limit for any measurement of the light.

    It is 4 N Cov, with N photons after the pupil mask and Cov the intensity-weighted covariance of the modes' phases.

    Args:
        pupil: (n, n) amplitude transmission.
        modes: (modes, n, n) modes with unit rms over the circle.
        wavelength_nm: The wavelength.
        light_e: Electrons of the open circle's light.
    """
    energy = pupil**2
    weights = (energy / energy.sum()).ravel()
    shapes = modes.reshape(len(modes), -1)
    mean = shapes @ weights
    covariance = (shapes * weights) @ shapes.T - np.outer(mean, mean)
    photons = light_e * float(energy.mean()) / OPEN_AREA
    return np.asarray(4.0 * photons * (2.0 * np.pi / wavelength_nm) ** 2 * covariance)
