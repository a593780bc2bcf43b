"""Pixel errors of the simulated detector beyond photon and read noise: gain, hot, nonlinear; from the seed."""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Pixels, Single
from lowfc.optics.detector.detector import Detector, saturation_dn


@dataclass(frozen=True, eq=False)
class PixelErrors:
    """Errors of the pixels (rows, columns).

    Attributes:
        gain: response to light, 1 on average.
        hot_e: electrons of the hot ones' dark current in an exposure.
        response_dn: (65536,) digital number in place of each that a linear detector gives.
    """

    gain: Single
    hot_e: Single
    response_dn: Pixels


def pixel_errors(
    detector: Detector,
    shape: tuple[int, int],
    seed: int,
    nonuniformity: float,
    nonlinearity: float,
    hot_pixels: float,
    hot_pixel_e: float,
) -> PixelErrors | None:
    """Errors drawn from the seed; None if there are none.

    Args:
        detector: without errors.
        shape: rows and columns.
        seed: of gains and hot pixels.
        nonuniformity: rms of the gains.
        nonlinearity: by which the gain of a faint pixel exceeds that of one at full well.
        hot_pixels: fraction of the pixels.
        hot_pixel_e: mean electrons of a hot one's dark current in an exposure.
    """
    if not (hot_pixels or nonlinearity or nonuniformity):
        return None
    rng = np.random.default_rng([seed, 6])
    gain = np.maximum(1 + nonuniformity * rng.standard_normal(shape), 0)
    hot_e = (rng.random(shape) < hot_pixels) * rng.exponential(hot_pixel_e, shape)
    return PixelErrors(gain.astype(np.float32), hot_e.astype(np.float32), response(detector, nonlinearity))


def response(detector: Detector, nonlinearity: float) -> Pixels:
    """Digital number (65536,) in place of each linear one: the signal s becomes s (1 + nonlinearity (1 - s / full))."""
    linear = np.arange(1 << 16)
    full = saturation_dn(detector) - detector.bias_dn
    signal = linear - detector.bias_dn
    bent = signal * (1 + nonlinearity * (1 - signal / full))
    return np.where(signal > 0, np.rint(detector.bias_dn + bent), linear).astype(np.uint16)
