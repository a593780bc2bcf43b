"""Probe signals to measure a loop: multisines, each line (frequency) of which belongs to one mode, and staircases.

All lines of a multisine are odd multiples of the inverse of its period, so that products of a second-order
nonlinearity fall between them. No two lines are neighbours, so that Hann's window separates them.
"""

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Integers, Single

MIN_CYCLES_OF_LINE = 3
"""Least number of cycles of a line in a period; with fewer, the line cannot be told from a drift of the mean."""
_MIN_DISTANCE = 3  # least distance between two lines of a mode, in odd bins: the noise is measured between them
_PHASES = 32  # number of random sets of phases; the set with the lowest peak is used


def lines(period_frames: int, modes: int, lines_per_mode: int, lowest: float, highest: float) -> list[Integers]:
    """Choose the lines of each mode, evenly in the logarithm of frequency as far as possible.

    Args:
        period_frames: Frames in a period.
        modes: Number of modes that are excited at once.
        lines_per_mode: Number of lines of each mode.
        lowest: Frequency of the first line, cycles per frame.
        highest: Highest frequency of a line, cycles per frame; if it is 0.5, all lines are below it.

    Returns:
        For each mode (lines,), cycles per period: odd, ascending, and used by no other mode.

    Raises:
        ValueError: the frequencies do not ascend within 0 to 0.5; or the period is too short for the lowest frequency,
            or for so many lines.
    """
    if not 0 < lowest < highest <= 0.5:
        raise ValueError(f"frequencies must ascend from above 0 to at most half of the rate, got {lowest}, {highest}")
    if lowest * period_frames < MIN_CYCLES_OF_LINE:
        raise ValueError(
            f"a period of {period_frames} frames holds {lowest * period_frames:.2g} cycles of the lowest frequency, it "
            f"must be {MIN_CYCLES_OF_LINE} or more"
        )
    first = int(np.ceil(lowest * period_frames)) | 1
    last = min(highest * period_frames, period_frames // 2 - 1)  # below half of the rate, where a sine has no phase
    count = modes * lines_per_mode
    step = 2 * -(-_MIN_DISTANCE // modes)
    places = (np.geomspace(first, last, count).astype(np.intp) - 1) | 1
    places[0] = first
    ahead = np.arange(count) * step
    places = np.maximum.accumulate(places - ahead) + ahead  # each at least a step above the place before it
    if places[-1] > last:
        room = int((last - first) // step) + 1
        raise ValueError(
            f"a period of {period_frames} frames has room for {room} lines, {count} are requested: use a longer one "
            "or fewer lines or modes"
        )
    return [places[mode::modes] for mode in range(modes)]


def multisine(period_frames: int, bins: list[Integers], rms_nm: float, seed: int) -> Single:
    """One period (period_frames, modes) of sines of equal amplitude, whose random phases give a low crest factor.

    Args:
        period_frames: Frames in the period.
        bins: Lines of each mode, as returned by `lines`.
        rms_nm: Rms of each mode.
        seed: Seed of the phases.
    """
    rng = np.random.default_rng([seed, 7])

    def drawn(places: Integers) -> Array:
        spectrum = np.zeros(period_frames // 2 + 1, complex)
        height = rms_nm * np.sqrt(2 / len(places)) * period_frames / 2
        spectrum[places] = height * np.exp(2j * np.pi * rng.random(len(places)))
        return np.fft.irfft(spectrum, period_frames)

    columns = [min((drawn(places) for _ in range(_PHASES)), key=lambda column: np.abs(column).max()) for places in bins]
    return np.stack(columns, axis=1).astype(np.float32)


def with_lead_in(period: Single, lead_frames: int) -> Single:
    """A period (frames, modes) after its last `lead_frames` frames, repeated if need be, in which the loop settles."""
    return np.concatenate([period[np.arange(-lead_frames, 0) % len(period)], period])


def build_staircase(levels_nm: npt.ArrayLike, hold_frames: int, largest_step_nm: float) -> tuple[Array, Integers]:
    """A staircase from zero over all levels and back to zero, in as few steps as the largest step allows.

    Args:
        levels_nm: (levels,) levels, in the order in which they are reached.
        hold_frames: Frames at each level.
        largest_step_nm: Largest change from one frame to the next.

    Returns:
        The staircase (frames,), nm, and the index of the first frame at each level (levels,).
    """
    parts, starts, at_nm, frames = [], [], 0.0, 0
    for level_nm in [*np.asarray(levels_nm, float).tolist(), 0.0]:
        steps = max(1, int(np.ceil(abs(level_nm - at_nm) / largest_step_nm)))
        ramp = np.linspace(at_nm, level_nm, steps + 1)[1:]
        starts.append(frames + steps - 1)
        parts += [ramp, np.full(hold_frames - 1, level_nm)]
        frames += steps + hold_frames - 1
        at_nm = level_nm
    return np.concatenate(parts), np.array(starts[:-1], np.intp)
