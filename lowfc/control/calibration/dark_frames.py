"""Dark and bad pixels from frames without light."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Mask

_SIGMAS = 8.0
"""Robust standard deviations from the median beyond which a pixel is bad: of 6400 good ones none is."""
_MOST_LIGHT = 0.02
"""Part of the star's light that may be in dark frames."""
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
    hot: Mask
    noisy: Mask
    dead: Mask

    def __str__(self) -> str:
        hot, noisy, dead = (int(np.count_nonzero(mask)) for mask in (self.hot, self.noisy, self.dead))
        return (
            f"dark {np.median(self.dark_dn):.2f} DN, noise {np.median(self.noise_dn):.2f} DN; bad pixels: {hot} hot, "
            f"{noisy} noisy, {dead} dead"
        )

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


def check_dark(dark_dn: Array, reference: Array, flux_dn: float) -> None:
    """Refuse a dark (pixels,) with a part of the star's light, whose image (pixels,) is in flux fractions.

    Raises:
        ValueError: the star is in it.
    """
    light = light_in(dark_dn, reference)
    if light > _MOST_LIGHT * flux_dn:
        raise ValueError(
            f"the dark frames are not dark: {light / flux_dn:.1%} of the star's light is in them; block the star"
        )


def light_in(dark_dn: Array, reference: Array) -> float:
    """Flux in DN of a reference image (pixels,), in flux fractions, that is in frames said to be dark.

    Of all pixels: those that light falls on pass for hot and noisy.
    """
    shape = reference - reference.mean()
    return float(shape @ dark_dn / (shape @ shape))


def _spread(values: Array) -> float:
    return float(_TO_SIGMA * np.median(np.abs(values - np.median(values))))
