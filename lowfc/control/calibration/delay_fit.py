"""Detect pokes in the images, and measure the delay from poke to image in frames.

The response to a pseudo-random poke is one image, which appears at each lag with its own weight. The image is estimated
from one half of the frames and detected in the other half, whose noise does not correlate with it. The weights
follow the loop's model of a delay, in which two neighbouring lags share the whole response.
"""

from typing import NamedTuple

import numpy as np

from lowfc.arrays import Array

LAGS = 6
"""Number of frames in which a poke is searched for, from the frame of the poke on."""
MIN_FRAMES = 40 * LAGS  # fewest consecutive frames from which a delay is measured
MIN_SNR = 10.0
"""Least signal-to-noise ratio of a detected poke; noise alone exceeds it with a probability below 1e-13."""


class Delay(NamedTuple):
    """Measured delay, and the image of the response to a poke.

    Attributes:
        delay_frames: a command computed from frame n first acts on the whole exposure of frame n + delay_frames.
        error_frames: standard error of the delay.
        response: (pixels,) image of the response to one unit of the poke, flux fractions.
    """

    delay_frames: float
    error_frames: float
    response: Array


class NotSeenError(ValueError):
    """A poke was not detected in the frames."""


def measure_delay(fractions: Array, reference: Array, poke: Array, command: Array | None = None) -> Delay:
    """Measure the delay from frames with a pseudo-random poke.

    Args:
        fractions: (frames, pixels) consecutive frames in flux fractions.
        reference: (pixels,) approximate image without a poke, for the weights of the pixels.
        poke: (frames,) amplitude of the poke in the command computed from each frame.
        command: (frames,) the loop's own command of the same mode; None if the loop is open.

    Raises:
        ValueError: there are too few frames, or the response is spread over several frames or later than all lags.
        NotSeenError: the poke is not detected.
    """
    if len(fractions) < MIN_FRAMES:
        raise ValueError(f"the delay needs at least {MIN_FRAMES} frames without a gap, got {len(fractions)}")
    # Photon noise of each pixel, in any unit: the square root of its light, with a floor for dark pixels.
    noise = np.sqrt(np.maximum(reference, 0) + 1e-3 * reference.max())
    first = LAGS - 1
    instruments = _lagged(poke)
    moved = instruments if command is None else _lagged(poke + command)
    rows = fractions[first:] / noise
    halves = np.array_split(np.arange(len(rows)), 2)
    factors, variances = np.zeros(LAGS), np.zeros(LAGS)
    response = np.zeros(len(reference))
    squared_snr = 0.0
    for estimating, detecting in (halves, halves[::-1]):
        responses, _ = _regressed(rows[estimating], moved[estimating], instruments[estimating])
        left, values, right = np.linalg.svd(responses, full_matrices=False)
        direction = right[0] * np.sign(left[:, 0].sum())
        detected = (rows[detecting] @ direction)[:, None]
        half_factors, errors = _regressed(detected, moved[detecting], instruments[detecting])
        factors += half_factors[:, 0] / 2
        variances += errors[:, 0] ** 2 / 4
        response += direction * noise * abs(left[:, 0].sum()) * values[0] / 2
        squared_snr += float(((half_factors[:, 0] / errors[:, 0]) ** 2).sum())
    snr = float(np.sqrt(squared_snr))
    if snr < MIN_SNR:
        raise NotSeenError(
            "the pokes are not seen in the frames: is there light on the sensor, does the mirror follow the commands, "
            "is the amplitude too small for the disturbance?"
        )
    pairs = factors[:-1] + factors[1:]
    whole = int(pairs.argmax())
    if pairs[whole] < 0.5 * np.abs(factors).sum() or factors[-1] > 0.5 * factors.sum():
        raise ValueError(
            f"the response to a poke is spread over several frames, or later than {LAGS - 1.5:g} frames: the delay "
            "cannot be measured; are frames lost, or commands late?"
        )
    fraction = float(np.clip(factors[whole + 1] / pairs[whole], 0, 1))
    error = np.hypot(fraction * np.sqrt(variances[whole]), (1 - fraction) * np.sqrt(variances[whole + 1]))
    return Delay(whole + fraction, float(error / pairs[whole]), response)


def _lagged(row: Array) -> Array:
    """The value of each frame and of the frames before it (frames, lags), from the first frame that has all lags on."""
    first = LAGS - 1
    return np.stack([row[first - lag : len(row) - lag] for lag in range(LAGS)], axis=1)


def _regressed(rows: Array, moved: Array, instruments: Array) -> tuple[Array, Array]:
    """Factors (lags, columns) of the motion `moved` (frames, lags) in rows (frames, columns), with standard errors.

    With instrumental variables other than `moved`, motion that follows the noise of the rows does not bias the factors.
    """
    rows, moved, z = (each - each.mean(axis=0) for each in (rows, moved, instruments))
    inverse = np.linalg.inv(z.T @ moved)
    factors = inverse @ (z.T @ rows)
    variance = ((rows - moved @ factors) ** 2).sum(axis=0) / (len(rows) - moved.shape[1])
    return factors, np.sqrt(np.outer(np.diag(inverse @ (z.T @ z) @ inverse.T), variance))
