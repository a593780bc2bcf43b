"""Pixel errors of the simulated detector, drawn from the seed: gain variation, hot pixels and nonlinearity."""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Pixels, Single
from lowfc.optics.detector.detector import Detector, saturation_dn


@dataclass(frozen=True, eq=False)
class PixelErrors:
    """Errors of the pixels; `gain` and `hot_e` are (rows, columns).

    Attributes:
        gain: response to light, 1 on average.
        hot_e: dark-current electrons of hot pixels in an exposure, 0 in other pixels.
        response_dn: (65536,) output, DN, for each output of a linear detector.
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
        detector: the detector without errors.
        shape: rows and columns.
        seed: seed of gains and hot pixels.
        nonuniformity: rms of the gain errors.
        nonlinearity: fraction by which the response to faint light exceeds that at full well.
        hot_pixels: fraction of pixels that are hot.
        hot_pixel_e: mean dark-current electrons of a hot pixel in an exposure.
    """
    if not (hot_pixels or nonlinearity or nonuniformity):
        return None
    rng = np.random.default_rng([seed, 6])  # stream 6: pixel errors
    gain = np.maximum(1 + nonuniformity * rng.standard_normal(shape), 0)
    hot_e = (rng.random(shape) < hot_pixels) * rng.exponential(hot_pixel_e, shape)
    return PixelErrors(gain.astype(np.float32), hot_e.astype(np.float32), response(detector, nonlinearity))


def response(detector: Detector, nonlinearity: float) -> Pixels:
    """Output (65536,), DN, for each linear one: the signal s above bias becomes s (1 + nonlinearity (1 - s / full))."""
    linear = np.arange(1 << 16)
    full = saturation_dn(detector) - detector.bias_dn
    signal = linear - detector.bias_dn
    nonlinear = signal * (1 + nonlinearity * (1 - signal / full))
    return np.where(signal > 0, np.rint(detector.bias_dn + nonlinear), linear).astype(np.uint16)
