"""Power spectra of modes with missing frames: short gaps are interpolated, long gaps split a series into pieces."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import rfft

from lowfc.arrays import Array, Integers, Sequences
from lowfc.control.loop.inputs import COUNT_BITS

MAX_INTERPOLATED_FRAMES = 3
"""Longest gap, in frames, that is interpolated; a longer gap starts a new piece."""
SHORTEST, LONGEST = 64, 2048
"""Shortest and longest segment of Welch's method, frames; with fewer than the shortest there is no spectrum."""
_MIN_SEGMENTS = 4  # the longest piece is at least this many segments long, unless a segment would be below `SHORTEST`


@dataclass(frozen=True, slots=True)
class TimeSeries:
    """Evenly sampled time series, in pieces without gaps.

    Attributes:
        values: the pieces, each (frames, columns).
        interpolated: number of interpolated frames in all pieces.
    """

    values: tuple[Array, ...]
    interpolated: int

    @property
    def frames(self) -> int:
        """Number of frames in all pieces."""
        return sum(len(piece) for piece in self.values)

    @property
    def longest(self) -> int:
        """Number of frames in the longest piece; 0 without pieces."""
        return max((len(piece) for piece in self.values), default=0)

    def columns(self, selected: slice) -> "TimeSeries":
        """A series of the same frames with only these columns."""
        return TimeSeries(tuple(piece[:, selected] for piece in self.values), self.interpolated)

    def joined(self) -> Array:
        """All frames (frames, columns), one piece after the other."""
        return np.concatenate(self.values)


@dataclass(frozen=True, slots=True)
class Spectrum:
    """One-sided power spectral density.

    Attributes:
        frequency_hz: (frequencies,) from 0 to half of the rate, evenly spaced.
        power_nm2_hz: (frequencies, columns); its sum times the spacing is the variance.
        segments: number of averaged segments, which overlap by half.
    """

    frequency_hz: Array
    power_nm2_hz: Array
    segments: int

    @property
    def spacing_hz(self) -> float:
        """Distance of neighbouring frequencies."""
        return float(self.frequency_hz[1])

    def variance_nm2(self, filtered: Array | float = 1.0) -> Array:
        """Variance (columns,) after a filter whose power transmission is (frequencies,) or (frequencies, columns)."""
        return np.asarray(np.sum(self.power_nm2_hz * filtered, axis=0) * self.spacing_hz)

    def error_nm2(self, filtered: Array | float = 1.0) -> Array:
        """Standard error (columns,) of `variance_nm2` for a noise-like spectrum.

        Hann's window correlates neighbours: three of them count as two. Segments that overlap by half are nearly
        independent.
        """
        squares = np.sum((self.power_nm2_hz * filtered) ** 2, axis=0)
        return np.asarray(np.sqrt(1.5 * squares / self.segments) * self.spacing_hz)


def time_series(sequence: Sequences, values: npt.NDArray[np.floating]) -> TimeSeries:
    """Time series of the rows of a log, split into evenly sampled pieces at long gaps.

    Args:
        sequence: (rows,) sequence of each row's frame; rows that do not increase it are ignored. A change of the
            camera's start counts as an increase: the start may be lower after a clear.
        values: (rows, columns); a row with a NaN is a missing frame.
    """
    measured = np.isfinite(values).all(axis=1)
    sequence, values = sequence[measured], values[measured].astype(np.float64)
    if not sequence.size:
        return TimeSeries((), 0)
    start, count = np.divmod(sequence, np.uint64(1 << COUNT_BITS))
    starts = np.cumsum(np.diff(start, prepend=start[:1]) != 0).astype(np.uint64)
    sequence = (starts << np.uint64(COUNT_BITS)) + count
    newest = np.maximum.accumulate(sequence)
    newer = np.concatenate([[True], sequence[1:] > newest[:-1]])
    sequence, values = sequence[newer], values[newer]
    missing = np.diff(sequence) - np.uint64(1)
    cuts = np.flatnonzero(missing > MAX_INTERPOLATED_FRAMES) + 1
    pieces = [
        interpolated((numbers - numbers[0]).astype(np.int64), rows, int(numbers[-1] - numbers[0]) + 1)
        for numbers, rows in zip(np.split(sequence, cuts), np.split(values, cuts), strict=True)
    ]
    return TimeSeries(tuple(pieces), int(missing[missing <= MAX_INTERPOLATED_FRAMES].sum()))


def spectrum(series: TimeSeries, rate_hz: float, frames: int = 0) -> Spectrum | None:
    """Welch's estimate over all pieces of at least a segment's length; None if there are none.

    Each segment's mean is subtracted, and Hann's window applied. A segment has `frames` frames or, if this is 0, a
    power of two that follows from the longest piece. Of a single piece, the result is that of `scipy.signal.welch`,
    whose import takes half a second.
    """
    if series.longest < SHORTEST:
        return None
    frames = frames or min(LONGEST, max(SHORTEST, 1 << ((series.longest // _MIN_SEGMENTS).bit_length() - 1)))
    window = 0.5 + 0.5 * np.cos(np.linspace(-np.pi, np.pi, frames + 1)[:-1])
    total, segments = np.zeros((series.values[0].shape[1], frames // 2 + 1)), 0
    for piece in series.values:
        if len(piece) >= frames:
            columns = np.ascontiguousarray(piece.T, np.float64)
            parts = np.lib.stride_tricks.sliding_window_view(columns, frames, axis=-1)[:, :: frames // 2]
            total += (np.abs(rfft(window * (parts - parts.mean(axis=-1, keepdims=True)))) ** 2).sum(axis=1)
            segments += parts.shape[1]
    total[:, 1 : (frames + 1) // 2] *= 2  # both signs of the frequency
    frequency_hz = np.asarray(np.fft.rfftfreq(frames, 1 / rate_hz), dtype=np.float64)
    return Spectrum(frequency_hz, total.T / (segments * rate_hz * np.sum(window**2)), segments)


def floor_nm2_hz(measured: Spectrum) -> Array:
    """Level (columns,) of white noise: the median over the upper half of the frequencies, without the median's bias.

    A median of chi-squared values lies below their mean; lines and slopes of the disturbance hardly move it.
    """
    upper = measured.power_nm2_hz[measured.frequency_hz.size // 2 : -1]
    freedom = 2 * measured.segments
    return np.asarray(np.median(upper, axis=0) / (1 - 2 / (9 * freedom)) ** 3)


def means_in_bins(frequency_hz: Array, columns: Sequence[Array]) -> tuple[Array, list[Array]]:
    """Means of the frequencies and of each column in bins, twenty per decade of frequency, without 0 Hz.

    Columns are (frequencies,), and their means (bins,).
    """
    places = np.floor(20 * np.log10(frequency_hz[1:])).astype(int)
    starts = np.flatnonzero(np.diff(places, prepend=places[0] - 1))
    counts = np.diff(starts, append=places.size)
    means = [np.add.reduceat(column[1:], starts) / counts for column in (frequency_hz, *columns)]
    return means[0], means[1:]


def interpolated(position: Integers, rows: Array, frames: int) -> Array:
    """Rows (frames, columns) at all positions: `rows` at `position`, and interpolated rows between these."""
    if frames == position.size:
        return rows
    return np.stack([np.interp(np.arange(frames), position, column) for column in rows.T], axis=1)
