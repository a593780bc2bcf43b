"""The dark, and a map of bad pixels, from frames without light."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Mask

_SIGMAS = 8.0
"""Robust standard deviations above the median beyond which a pixel is bad; none of 6400 good pixels is that far."""
_ROUNDING_DN = 0.6
"""Largest noise that rounding to whole DN may add to a pixel, or remove from it, if there are many frames."""
_MAX_LIGHT = 0.02
"""Largest allowed fraction of the star's light in dark frames."""
_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of a normal distribution to its median absolute deviation."""


class Dark(NamedTuple):
    """Statistics of a camera's pixels without light.

    Attributes:
        dark_dn: (pixels,) mean, DN.
        noise_dn: (pixels,) standard deviation from frame to frame, DN.
        hot: (pixels,) whether a pixel is much brighter than most others.
        noisy: (pixels,) whether a pixel is much noisier than most others.
        dead: (pixels,) whether a pixel is stuck: it has no noise, unlike most others.
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
        """(pixels,) 1 for a used pixel, else 0."""
        return np.where(self.hot | self.noisy | self.dead, 0.0, 1.0)


def measure_dark(frames: npt.NDArray[np.number]) -> Dark:
    """The dark, and bad pixels, from frames (frames, pixels) without light, DN.

    Raises:
        ValueError: there are too few frames, values are not finite, or the frames are not dark.
    """
    count = len(frames)
    if count < 16:
        raise ValueError(f"a dark needs at least 16 frames, got {count}")
    values = frames.astype(np.float64)
    if bad := int(np.count_nonzero(~np.isfinite(values).all(axis=0))):
        which = "1 pixel of the dark frames has" if bad == 1 else f"{bad} pixels of the dark frames have"
        raise ValueError(f"{which} values that are not finite: replace them by numbers")
    mean, noise = values.mean(axis=0), values.std(axis=0, ddof=1)
    level, typical_noise = float(np.median(mean)), float(np.median(noise))
    mean_spread = max(_robust_std(mean), typical_noise / np.sqrt(count), 1e-3)
    noise_spread = max(_robust_std(noise), typical_noise / np.sqrt(2 * count), 1e-3)
    rounding_dn = _ROUNDING_DN * (1 + 4 / np.sqrt(count))  # rounding may hide a good pixel's noise in few frames
    hot = mean > level + max(_SIGMAS * mean_spread, _SIGMAS * typical_noise / 4, rounding_dn)
    if hot.mean() > 0.05:
        raise ValueError(
            f"{hot.mean():.0%} of the pixels are much brighter than the median of {level:.1f} DN: these frames are not "
            "dark; block the star, or switch it off"
        )
    noisy = noise > max(typical_noise + _SIGMAS * noise_spread, float(np.hypot(typical_noise, rounding_dn)))
    return Dark(mean, noise, hot, noisy, (noise < 0.05 * typical_noise) & (typical_noise > rounding_dn / 2))


def check_dark(dark_dn: Array, reference: Array, flux_dn: float) -> None:
    """Refuse a dark (pixels,), DN, that contains light of the star; the reference (pixels,) is in flux fractions.

    Raises:
        ValueError: the dark contains too much light.
    """
    light = starlight_dn(dark_dn, reference)
    if light > _MAX_LIGHT * flux_dn:
        raise ValueError(
            f"the dark frames are not dark: {light / flux_dn:.1%} of the star's light is in them; block the star"
        )


def starlight_dn(dark_dn: Array, reference: Array) -> float:
    """The star's flux, DN, in a dark (pixels,), DN; the star's reference image (pixels,) is in flux fractions.

    Each pixel yields a flux. The result is their median, weighted by the reference, since some pixels may be hot.
    """
    dark_above, reference_above = dark_dn - np.median(dark_dn), reference - np.median(reference)
    weighted = reference_above != 0
    fluxes_dn, weights = dark_above[weighted] / reference_above[weighted], np.abs(reference_above[weighted])
    order = np.argsort(fluxes_dn)
    cumulative = np.cumsum(weights[order])
    return float(fluxes_dn[order[np.searchsorted(cumulative, cumulative[-1] / 2)]])


def _robust_std(values: Array) -> float:
    return float(_TO_SIGMA * np.median(np.abs(values - np.median(values))))
