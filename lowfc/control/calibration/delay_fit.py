"""From poke to image: after how many frames, and whether at all.

The answer to a pseudo-random poke is one picture, seen after each lag with a weight of its own. The picture is taken
from one half of the frames and looked for in the other, so that noise does not find itself; the weights follow the
loop's model of a delay, in which two neighbouring lags share the whole answer.
"""

from typing import NamedTuple

import numpy as np

from lowfc.arrays import Array

LAGS = 6
"""Frames after its own in which a poke is looked for, its own included."""
LEAST_FRAMES = 40 * LAGS
LEAST_SNR = 10.0
"""Below which no poke was seen; noise alone exceeds it less than once in 1e13 times."""


class Delay(NamedTuple):
    """What a poke's answer shows.

    Attributes:
        delay_frames: from the frame a command was made from to the first exposure that sees it wholly.
        error_frames: its standard error.
        weights: (lags,) part of the answer that comes so many frames after the poke's own.
        picture: (pixels,) the answer to one unit of the poke, flux fractions.
        snr: of the answer.
    """

    delay_frames: float
    error_frames: float
    weights: Array
    picture: Array
    snr: float


class NotSeenError(ValueError):
    """A poke has no answer in the frames."""


def measure_delay(fractions: Array, reference: Array, poke: Array, command: Array | None = None) -> Delay:
    """The delay from frames under a pseudo-random poke.

    Args:
        fractions: (frames, pixels) consecutive frames in flux fractions.
        reference: (pixels,) about the same without a poke: for the weights of the pixels.
        poke: (frames,) amplitude in the command that was made from each frame.
        command: (frames,) the loop's own command of that mode beside it; None where the loop is open.

    Raises:
        ValueError: there are too few frames, or the answer comes later than is looked for.
        NotSeenError: no poke is seen.
    """
    if len(fractions) < LEAST_FRAMES:
        raise ValueError(f"the delay needs at least {LEAST_FRAMES} frames without a gap, got {len(fractions)}")
    light = np.sqrt(np.maximum(reference, 0) + 1e-3 * reference.max())  # photon noise goes as the root of the light
    first = LAGS - 1
    instruments = _lagged(poke)
    moved = instruments if command is None else _lagged(poke + command)
    rows = fractions[first:] / light
    halves = np.array_split(np.arange(len(rows)), 2)
    factors, variances = np.zeros(LAGS), np.zeros(LAGS)
    picture = np.zeros(len(reference))
    power = 0.0
    for one, other in (halves, halves[::-1]):
        pictures, _ = _regressed(rows[one], moved[one], instruments[one])
        left, values, right = np.linalg.svd(pictures, full_matrices=False)
        direction = right[0] * np.sign(left[:, 0].sum())
        found, noise = _regressed((rows[other] @ direction)[:, None], moved[other], instruments[other])
        factors += found[:, 0] / 2
        variances += noise[:, 0] ** 2 / 4
        picture += direction * light * abs(left[:, 0].sum()) * values[0] / 2
        power += float(((found[:, 0] / noise[:, 0]) ** 2).sum())
    snr = float(np.sqrt(power))
    total = factors.sum()
    if snr < LEAST_SNR:
        raise NotSeenError(
            "the pokes are not seen in the frames: is the light on the sensor, does the mirror follow the commands, is "
            "the amplitude too small for what shakes the wavefront?"
        )
    pairs = factors[:-1] + factors[1:]
    whole = int(pairs.argmax())
    if pairs[whole] < 0.5 * np.abs(factors).sum() or factors[-1] > 0.5 * total:
        raise ValueError(
            f"the answer to a poke is not over after {LAGS - 1} frames, or does not come at once: the delay cannot be "
            "told; are frames lost, or commands late?"
        )
    fraction = float(np.clip(factors[whole + 1] / pairs[whole], 0, 1))
    error = np.hypot(fraction * np.sqrt(variances[whole]), (1 - fraction) * np.sqrt(variances[whole + 1]))
    return Delay(whole + fraction, float(error / pairs[whole]), factors / total, picture, snr)


def _lagged(row: Array) -> Array:
    """(frames, lags): each frame's value and those before it, from the first frame that has all."""
    first = LAGS - 1
    return np.stack([row[first - lag : len(row) - lag] for lag in range(LAGS)], axis=1)


def _regressed(rows: Array, moved: Array, instruments: Array) -> tuple[Array, Array]:
    """Factors (lags, columns) of each lag in rows (frames, columns), and their standard errors.

    With instruments of their own, what moved because of the rows' noise does not count (see `response_fit`).
    """
    rows, moved, z = (each - each.mean(axis=0) for each in (rows, moved, instruments))
    inverse = np.linalg.inv(z.T @ moved)
    factors = inverse @ (z.T @ rows)
    variance = ((rows - moved @ factors) ** 2).sum(axis=0) / (len(rows) - moved.shape[1])
    return factors, np.sqrt(np.outer(np.diag(inverse @ (z.T @ z) @ inverse.T), variance))
