"""What a faint pixel says, as a table: digital numbers drawn with a few passes over the image, photon and read noise.

For a pixel that expects m electrons, the law of its digital number is known: Poisson, then Gaussian, then rounded. The
table has this law for a grid of m, each as a row of equally likely numbers (Marsaglia, Tsang and Wang 2004); what of a
probability is left over beyond whole places is drawn apart, from a place that says so. A pixel between two levels takes
one of them by chance, so that its mean is right.
"""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Pixels, Single

FAINT_E = 24.0
"""Only pixels that expect less are drawn from the table."""
STEP_E = 1 / 64
"""Between levels. By chance between two, the variance is too large by at most STEP_E^2 / 4 = 6e-5 e-^2."""

_PLACES_BITS = 10
_PLACES = 1 << _PLACES_BITS
_CHANCE_BITS = 16  # of taking the upper level
_MOST_E = 64  # below 24 e-, more come once in 1e11 frames of a pixel
_TAIL = 8.0  # standard deviations of read noise
_WIDEST = 256
_LEAST_NOISE_DN = 0.05
_APART = 65535  # not a digital number of a law: those below saturation only


@dataclass(frozen=True, eq=False)
class PixelLaws:
    """Laws of the digital number at the means 0, STEP_E, ... FAINT_E.

    Attributes:
        places: (levels, places) digital numbers, all equally likely; `_APART` where `rest` decides.
        rest: (levels, numbers) cumulative probability of what is left over.
        first_dn: The number that the first column of `rest` stands for.
    """

    places: Pixels
    rest: Single
    first_dn: int


def pixel_laws(gain_e_per_dn: float, read_noise_e: float, bias_dn: float, saturation_dn: int) -> PixelLaws | None:
    """Laws for a detector without multiplication; None where rounding or saturation calls for more than a table."""
    from scipy.special import ndtr  # takes a quarter of a second; of the processes only the camera needs it

    noise_dn = read_noise_e / gain_e_per_dn
    first = int(np.floor(bias_dn - _TAIL * noise_dn))
    last = int(np.ceil(bias_dn + _MOST_E / gain_e_per_dn + _TAIL * noise_dn))
    if noise_dn < _LEAST_NOISE_DN or first < 0 or last >= saturation_dn or last - first >= _WIDEST:
        return None
    mean = STEP_E * np.arange(round(FAINT_E / STEP_E) + 1)[:, None]
    electrons = np.arange(_MOST_E)
    poisson = np.cumprod(np.hstack([np.exp(-mean), mean / electrons[1:]]), axis=1)  # P(k) = P(k - 1) mean / k
    edges = np.arange(first, last + 2) - 0.5 - bias_dn
    law = poisson @ np.diff(ndtr((edges - electrons[:, None] / gain_e_per_dn) / noise_dn), axis=1)
    law *= _PLACES / law.sum(axis=1, keepdims=True)
    whole = np.floor(law).astype(np.intp)
    numbers = np.arange(first, last + 1, dtype=np.uint16)
    places = np.full((len(law), _PLACES), _APART, np.uint16)
    for row, counts in zip(places, whole, strict=True):
        row[: counts.sum()] = np.repeat(numbers, counts)
    left = np.cumsum(law - whole, axis=1)
    return PixelLaws(places, (left / left[:, -1:]).astype(np.float32), first)


def draw(laws: PixelLaws, mean_e: Single, rng: np.random.Generator) -> Pixels:
    """Digital numbers (pixels,) of pixels that expect so many electrons each; of one above FAINT_E, as if of FAINT_E.

    Args:
        laws: Of the detector.
        mean_e: (pixels,); below zero counts as none.
        rng: Source of all randomness, with words of 64 random bits, as all of numpy's but MT19937 have.
    """
    words = rng.bit_generator.random_raw((mean_e.size + 1) // 2).view(np.uint32)[: mean_e.size]
    level = mean_e * np.float32((1 << _CHANCE_BITS) / STEP_E)
    np.maximum(level, np.float32(0), out=level)
    np.minimum(level, np.float32((1 << _CHANCE_BITS) * FAINT_E / STEP_E), out=level)
    place = level.astype(np.int32)
    place += words.view(np.int32) & ((1 << _CHANCE_BITS) - 1)
    place >>= _CHANCE_BITS - _PLACES_BITS
    words >>= 32 - _PLACES_BITS
    place ^= words.view(np.int32)  # what is left of the chance is made independent of it
    drawn = laws.places.ravel().take(place)
    apart = np.flatnonzero(drawn == _APART)
    rest = laws.rest.take(place.take(apart) >> _PLACES_BITS, axis=0)
    drawn[apart] = laws.first_dn + (rest > rng.random((apart.size, 1), np.float32)).argmax(axis=1)
    return drawn
