"""Highest gains of the integrator: up to oscillation of its loop, and up to the least allowed margins.

The loop of `lowfc.control.laws.integrator`: command[k] = (1 - leak) command[k-1] - gain error[k], and
error[k] = disturbance[k] + sum_j w_j command[k-1-j] + noise[k], with w from the delay in frames.
"""

from functools import lru_cache

import numpy as np

from lowfc.arrays import Array, Complex, Single

MIN_GAIN_MARGIN = 1.8  # factor by which the gain may grow
MIN_PHASE_MARGIN_DEG = 45.0
LOWEST_GAIN = 0.01
"""Least gain that `lowfc tune` chooses, so that even a mode whose drift is hidden by a log's noise is corrected."""
SETTLING_TIME_CONSTANTS = 5.0
"""Time constants of the slowest mode after which a loop counts as settled."""

_LONGEST_DELAY = 1000  # frames; a longer delay, from a damaged file or message, could exceed the memory
_BISECTIONS = 50
"""Halvings of a 4096th of pi, down to double precision; scipy.optimize is not used, as its import takes 0.3 s."""


def settling_frames(gain: Array | Single, leak: Array | Single, least: float = 0.0) -> int:
    """Frames from closing until the slowest mode has settled, at least `least`; gain, leak (modes,) without unit."""
    slowest = float((gain + leak)[gain + leak > 0].min(initial=1.0))
    return int(np.ceil(max(SETTLING_TIME_CONSTANTS / slowest, least)))


def delay_weights(delay_frames: float) -> Array:
    """Return w: the fraction of command[k-1-j], j = 0, 1, ..., seen in exposure k; sums to 1.

    A delay of d frames (d >= 1) is counted from the frame that a command is computed from to the first frame exposed
    wholly under it. If d has a fraction f, an exposure sees the older command for this fraction of its time, and the
    newer command for the rest.

    Raises:
        ValueError: the delay is below 1 or above 1000 frames, or not a number.
    """
    if not 1 <= delay_frames <= _LONGEST_DELAY:
        raise ValueError(f"a delay is at least 1 frame and at most {_LONGEST_DELAY}, got {delay_frames}")
    whole = int(np.floor(delay_frames))
    fraction = delay_frames - whole
    weights = np.zeros(whole + (fraction > 0))
    weights[whole - 1] = 1 - fraction
    if fraction > 0:
        weights[whole] = fraction
    return weights


def open_loop(omega: Array | float, gain: float, leak: float, delay_frames: float) -> Complex:
    """Loop transfer function L at angular frequencies omega (frequencies,), rad per frame."""
    z = np.exp(1j * np.asarray(omega, dtype=float))
    weights = delay_weights(delay_frames)
    seen = np.polynomial.polynomial.polyval(1 / z, weights)
    return np.asarray(gain * seen / (z - (1 - leak)))


@lru_cache(maxsize=256)
def limiting_gain(delay_frames: float, leak: float = 0.0) -> float:
    """Gain at which the loop starts to oscillate; 2 sin(pi / (2 (2d - 1))) for a whole delay d without leak."""

    def per_gain(omega: Array) -> Complex:
        return open_loop(omega, 1.0, leak, delay_frames)

    grid = np.linspace(1e-6, np.pi, 4096)
    values = per_gain(grid).imag
    rising = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))
    low, high = grid[rising], grid[rising + 1]
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        below = per_gain(middle).imag < 0
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    real = per_gain(np.append(high, np.pi)).real
    return float(np.min(-1 / real[real < 0]))


@lru_cache(maxsize=64)
def highest_gain(delay_frames: float, leak: float = 0.0) -> float:
    """Highest integrator gain that keeps both margins, in gain and in phase."""
    omega = np.linspace(1e-4, np.pi, 1 << 14)
    loop = open_loop(omega, 1.0, leak, delay_frames)
    late = np.unwrap(np.angle(loop)) < -np.radians(180 - MIN_PHASE_MARGIN_DEG)
    by_phase = 1 / np.abs(loop[np.argmax(late)]) if late.any() else np.inf
    return float(min(limiting_gain(delay_frames, leak) / MIN_GAIN_MARGIN, by_phase))
