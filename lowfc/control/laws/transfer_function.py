"""Rejection and noise transfer functions of a loop measured with a multisine, and their departure from theory.

With u, a multisine whose frequencies are called lines, added to the loop's input (u = -offset), the measured error is
S (disturbance + noise + u). So S = error / u at the lines, and T = 1 - S. Everything else appears as S (disturbance +
noise), so that the relative error of a line does not depend on the rejection at its frequency.
"""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Complex, Integers, Mask

_FAINTEST = 1e-3  # amplitude of a line, relative to the mode's highest; fainter lines are rounding errors
_ADJACENT = np.array([*range(-16, -1), *range(2, 17)])  # bins, relative to a line's, from which its noise is measured
_BIN_TO_FLANK = 12 / 7  # power of white noise in a bin over that in `flanks`, under Hann's window
_DB = 20 / np.log(10)

SIGMAS = 3.5
"""A line is judged if this number of standard errors is within the tolerance."""


@dataclass(frozen=True, slots=True)
class Lines:
    """The lines of all modes, ascending within each mode.

    Attributes:
        mode: (lines,) index of the mode of each line.
        frequency: (lines,) cycles per frame.
        rejection: (lines,) S, complex.
        error: (lines,) standard error of the real part of S, and of its imaginary part.
    """

    mode: Integers
    frequency: Array
    rejection: Complex
    error: Array

    @property
    def noise_transfer(self) -> Complex:
        """T (lines,), complex; its standard error is that of S."""
        return 1 - self.rejection


@dataclass(frozen=True, slots=True)
class Departure:
    """Departure of measured lines from theory.

    Attributes:
        db: (lines,) ratio of the measured size to theory, dB.
        error_db: (lines,) standard error of `db`.
        judged: (lines,) whether the standard error is small enough for the tolerance.
        within: (lines,) whether the line was judged and its departure is within the tolerance.
    """

    db: Array
    error_db: Array
    judged: Mask
    within: Mask


def measure_lines(error_nm: Array, added_nm: Array) -> Lines:
    """S at the lines of the signal added to the loop's input.

    Hann's window keeps high frequencies, which the loop does not reject, out of low frequencies, where the error is
    small. It does not mix lines, as they are at least two bins apart. The noise of a line is measured in the adjacent
    bins and includes cross-talk from other modes' lines.

    Args:
        error_nm: (frames, modes) errors in one period.
        added_nm: (frames, modes) signal added in the same frames.

    Raises:
        ValueError: the shapes differ, or nothing was added.
    """
    if error_nm.shape != added_nm.shape:
        raise ValueError(f"errors {error_nm.shape} and added signal {added_nm.shape} must have the same shape")
    frames = len(error_nm)
    response, added = _hann(error_nm), _hann(added_nm)
    by_mode: list[tuple[Integers, Integers, Complex, Array]] = []
    for mode in range(error_nm.shape[1]):
        amplitude = np.abs(np.fft.rfft(added_nm[:, mode])) / frames
        bins = np.flatnonzero(amplitude[1:-1] > _FAINTEST * amplitude[1:-1].max(initial=0.0)) + 1
        if not bins.size:
            continue
        excluded = np.zeros(len(amplitude), bool)
        excluded[:2] = excluded[-2:] = True
        for near in (-1, 0, 1):
            excluded[np.clip(bins + near, 0, len(amplitude) - 1)] = True
        adjacent = np.clip(bins[:, None] + _ADJACENT, 0, len(amplitude) - 1)
        adjacent_power = np.where(excluded[adjacent], np.nan, np.abs(response[adjacent, mode]) ** 2)
        # A vibration on the line itself shows only in the adjacent bins, after subtraction of the line.
        flanks = response[bins[:, None] + np.array([-1, 1]), mode] + response[bins, mode][:, None] / 2
        flank_power = _BIN_TO_FLANK * np.mean(np.abs(flanks) ** 2, axis=1)
        noise = np.sqrt(np.maximum(np.nanmean(adjacent_power, axis=1), flank_power) / 2)
        S = response[bins, mode] / added[bins, mode]
        by_mode.append((np.full(bins.size, mode), bins, S, noise / np.abs(added[bins, mode])))
    if not by_mode:
        raise ValueError("nothing was added to the loop's input: there is nothing to measure")
    modes, bins, S, error = (np.concatenate(parts) for parts in zip(*by_mode, strict=True))
    return Lines(modes, bins / frames, S, error)


def modes_seen(played_nm: Array, weights: Array) -> Array:
    """Modes that each exposure sees while `played_nm` is repeated on the mirror, both (frames, modes)."""
    seen = np.zeros_like(played_nm)
    for lag, weight in enumerate(weights):
        seen += weight * np.roll(played_nm, 1 + lag, axis=0)
    return seen


def departure(value: Complex, theory: Array, error: Array, tolerance_db: float) -> Departure:
    """Compare the sizes of lines (lines,), in any unit, with theory (lines,), given their standard error (lines,)."""
    size = np.maximum(np.abs(value), 1e-30)
    db = _DB * np.log(size / np.maximum(theory, 1e-30))
    error_db = _DB * error / size
    judged = error_db * SIGMAS <= tolerance_db
    return Departure(db, error_db, judged, judged & (np.abs(db) <= tolerance_db))


def _hann(values: Array) -> Complex:
    """Spectrum (frequencies, columns) under Hann's window, scaled so that a line has its amplitude."""
    spectrum = np.fft.rfft(values, axis=0) * (2 / len(values))
    after = spectrum.copy()
    after[1:-1] -= (spectrum[:-2] + spectrum[2:]) / 2
    return np.asarray(after)
