"""Dark and bad pixels from frames without light."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_SIGMAS = 8.0
"""Robust standard deviations from the median beyond which a pixel is bad: of 6400 good ones none is."""
_TO_SIGMA = 1.4826
"""From a median absolute deviation to the standard deviation of a normal law."""


class Dark(NamedTuple):
    """What a camera says without light.

    Attributes:
        dark_dn: (pixels,) mean.
        noise_dn: (pixels,) standard deviation of one frame.
        hot: (pixels,) brighter than the others.
        noisy: (pixels,) noisier than the others.
        dead: (pixels,) stuck: they do not change at all where the others do.
    """

    dark_dn: Array
    noise_dn: Array
    hot: npt.NDArray[np.bool_]
    noisy: npt.NDArray[np.bool_]
    dead: npt.NDArray[np.bool_]

    @property
    def good(self) -> Array:
        """(pixels,) 1 where a pixel is used, else 0."""
        return np.where(self.hot | self.noisy | self.dead, 0.0, 1.0)


def dark_of(frames: npt.NDArray[np.number]) -> Dark:
    """Dark and bad pixels of frames (frames, pixels) taken without light, DN.

    Raises:
        ValueError: there are too few, or they are not dark.
    """
    count = len(frames)
    if count < 16:
        raise ValueError(f"a dark takes at least 16 frames, got {count}")
    values = frames.astype(np.float64)
    mean, noise = values.mean(axis=0), values.std(axis=0, ddof=1)
    level, usual = float(np.median(mean)), float(np.median(noise))
    of_mean = max(_spread(mean), usual / np.sqrt(count), 1e-3)
    of_noise = max(_spread(noise), usual / np.sqrt(2 * count), 1e-3)
    hot = mean > level + _SIGMAS * max(of_mean, usual / 4)
    if hot.mean() > 0.05:
        raise ValueError(
            f"{hot.mean():.0%} of the pixels are much brighter than the median of {level:.1f} DN: these frames are not "
            "dark; block the star, or switch it off"
        )
    dead = noise < 0.05 * usual
    return Dark(mean, noise, hot, noise > usual + _SIGMAS * of_noise, dead)


def light_in(dark_dn: Array, reference: Array) -> float:
    """Flux in DN of a reference image (pixels,), in flux fractions, that is in frames said to be dark.

    Of all pixels: those that light falls on pass for hot and noisy.
    """
    shape = reference - reference.mean()
    return float(shape @ dark_dn / (shape @ shape))


def _spread(values: Array) -> float:
    return float(_TO_SIGMA * np.median(np.abs(values - np.median(values))))
