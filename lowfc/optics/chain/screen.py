"""Phase screens with the power spectrum of Kolmogorov turbulence (Subedi et al. 2015, Sect. 3.2)."""

import numpy as np
import scipy.fft

from lowfc.arrays import Array

_SPECTRUM = 0.0229  # phase spectrum at one cycle per D for r0 = D, rad^2 per (cycle per D)^2


def kolmogorov(rng: np.random.Generator, samples: int, width: int = 4) -> Array:
    """Screen (samples, samples) with spectrum f^-11/3, at the samples of a pupil, in radians for r0 = D.

    It is cut from a periodic screen. Waves longer than the periodic screen are missing, so tilt is too small. Over a
    circle, an infinite screen has a variance of 1.03 rad^2, of which tilt has 0.90 (Noll 1976); here tilt has about 0.3
    rad^2 at width 4 and 0.04 at width 1. At width 4 the orders above tilt are nearly complete.

    Args:
        rng: Generator of all random numbers.
        samples: Points across the pupil.
        width: Width of the periodic screen, in pupil diameters.

    Raises:
        ValueError: The periodic screen would be narrower than the pupil.
    """
    if width < 1:
        raise ValueError(f"the periodic screen must be at least as wide as the pupil, got {width} pupil diameters")
    count = width * samples
    fx, fy = scipy.fft.rfftfreq(count, 1.0 / samples), scipy.fft.fftfreq(count, 1.0 / samples)
    f2 = fy[:, None] ** 2 + fx**2
    f2[0, 0] = np.inf  # no piston
    amplitude = np.sqrt(_SPECTRUM) * f2 ** (-11.0 / 12.0)
    spectrum = scipy.fft.rfft2(rng.standard_normal((count, count))) * amplitude
    # Each frequency of the white noise has the power count^2; irfft2 divides amplitudes by count^2.
    periodic = (count / width) * scipy.fft.irfft2(spectrum, (count, count))
    return np.ascontiguousarray(periodic[:samples, :samples])
