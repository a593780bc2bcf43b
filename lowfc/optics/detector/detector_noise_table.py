"""Fast draws of a faint pixel's digital number (photon noise, read noise, rounding) from a precomputed table.

The distribution of the digital number for a mean of m electrons is known: Poisson, plus Gaussian, rounded. The table
has a row for each m of a grid, with 1024 equally likely entries (Marsaglia, Tsang and Wang 2004). Each probability is
rounded down to a multiple of 1/1024. The remainder is drawn from a second distribution, `remainder`: entries equal to
`_REMAINDER` select it. A mean between two grid values is rounded at random to one of them, so that the mean is kept.
"""

import math
from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Pixels, Single

FAINT_E = 24.0
"""Pixels with a mean below this, electrons, are drawn from the table."""
STEP_E = 1 / 64
"""Spacing of the tabulated means, electrons; random rounding to a neighbour adds a variance of at most STEP_E^2 / 4."""

_ENTRIES_BITS = 10
_ENTRIES = 1 << _ENTRIES_BITS
_FRACTION_BITS = 16  # resolution of the probability of rounding up
_MAX_TABULATED_E = 64  # electrons, exclusive; a pixel with a mean of 24 e- reaches 64 once in 1e11 frames
_TAIL = 8.0  # tabulated range of the read noise, standard deviations
_WIDEST = 256  # largest number of tabulated digital numbers
_MIN_NOISE_DN = 0.05  # the table divides by the read noise, which may be 0
_REMAINDER = 65535  # never a tabulated digital number, since those are below saturation


@dataclass(frozen=True, eq=False)
class NoiseTable:
    """Distributions of the digital number, one for each of the means 0, STEP_E, ... FAINT_E.

    Attributes:
        entries: (means, entries) digital numbers, all equally likely; `_REMAINDER` where `remainder` decides.
        remainder: (means, numbers) cumulative distribution of the parts of the probabilities, each below 1/1024, that
            the entries do not represent.
        first_dn: Digital number of the first column of `remainder`.
    """

    entries: Pixels
    remainder: Single
    first_dn: int


def noise_table(gain_e_per_dn: float, read_noise_e: float, bias_dn: float, saturation_dn: int) -> NoiseTable | None:
    """Table for a detector without electron multiplication.

    Returns:
        The table, or None if it does not apply: read noise below 0.05 DN; digital numbers below 0, or not
        below the saturation level; or more than 256 of them.
    """
    noise_dn = read_noise_e / gain_e_per_dn
    first = int(np.floor(bias_dn - _TAIL * noise_dn))
    last = int(np.ceil(bias_dn + _MAX_TABULATED_E / gain_e_per_dn + _TAIL * noise_dn))
    if noise_dn < _MIN_NOISE_DN or first < 0 or last >= saturation_dn or last - first >= _WIDEST:
        return None
    mean = STEP_E * np.arange(round(FAINT_E / STEP_E) + 1)[:, None]
    electrons = np.arange(_MAX_TABULATED_E)
    poisson = np.cumprod(np.hstack([np.exp(-mean), mean / electrons[1:]]), axis=1)  # P(k) = P(k - 1) mean / k
    edges = np.arange(first, last + 2) - 0.5 - bias_dn
    deviations = (edges - electrons[:, None] / gain_e_per_dn) / (noise_dn * math.sqrt(2))
    gaussian = np.vectorize(math.erfc, [float])(-deviations) / 2  # scipy.special takes a quarter of a second to import
    probability = poisson @ np.diff(gaussian, axis=1)
    probability *= _ENTRIES / probability.sum(axis=1, keepdims=True)  # in units of one entry
    whole = np.floor(probability).astype(np.intp)
    numbers = np.arange(first, last + 1, dtype=np.uint16)
    entries = np.full((len(probability), _ENTRIES), _REMAINDER, np.uint16)
    for row, counts in zip(entries, whole, strict=True):
        row[: counts.sum()] = np.repeat(numbers, counts)
    remainder = np.cumsum(probability - whole, axis=1)
    remainder /= np.maximum(remainder[:, -1:], np.finfo(float).tiny)  # 0 if a digital number has all 1024 entries
    return NoiseTable(entries, remainder.astype(np.float32), first)


def draw(table: NoiseTable, mean_e: Single, rng: np.random.Generator) -> Pixels:
    """Digital numbers (pixels,) of pixels with these mean electrons.

    Args:
        table: The detector's table.
        mean_e: (pixels,) mean electrons, clipped to 0 ... FAINT_E.
        rng: Generator of all random numbers; its bit generator must produce 64-bit words, as all of numpy's but
            MT19937 do.
    """
    words = rng.bit_generator.random_raw((mean_e.size + 1) // 2).view(np.uint32)[: mean_e.size]
    level = mean_e * np.float32((1 << _FRACTION_BITS) / STEP_E)
    np.maximum(level, np.float32(0), out=level)
    np.minimum(level, np.float32((1 << _FRACTION_BITS) * FAINT_E / STEP_E), out=level)
    index = level.astype(np.int32)
    index += words.view(np.int32) & ((1 << _FRACTION_BITS) - 1)
    index >>= _FRACTION_BITS - _ENTRIES_BITS
    words >>= 32 - _ENTRIES_BITS
    index ^= words.view(np.int32)  # the low bits depend on how the mean was rounded: XOR with unused bits
    drawn = table.entries.ravel().take(index)
    undecided = np.flatnonzero(drawn == _REMAINDER)
    cumulative = table.remainder.take(index.take(undecided) >> _ENTRIES_BITS, axis=0)
    drawn[undecided] = table.first_dn + (cumulative > rng.random((undecided.size, 1), np.float32)).argmax(axis=1)
    return drawn
