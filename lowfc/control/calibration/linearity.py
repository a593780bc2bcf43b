"""Linear range of a sensor and capture range of a loop, measured with shapes of one mode on the mirror."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Integers

SIGMAS = 3.0
"""Standard errors by which a value must exceed a limit to count as beyond it."""
MAX_RESIDUAL = 0.3
"""Largest residual of a captured shape, in any mode, as a fraction of the amplitude of the shape."""

_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])  # signs of one cycle, over which a linear drift cancels


def levels(amplitudes_nm: npt.ArrayLike, cycles: int) -> Array:
    """Levels (levels,), nm, of a staircase that pushes and pulls `cycles` times at each amplitude (amplitudes,)."""
    return np.concatenate([np.tile(amplitude * _SIGNS, cycles) for amplitude in np.asarray(amplitudes_nm, float)])


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of the sensor for one mode, at each amplitude.

    Attributes:
        amplitude_nm: (amplitudes,) amplitude of the mode.
        gain: (amplitudes, modes) ratio of each mode's measured amplitude to the true amplitude of `mode`.
        error: (amplitudes, modes) standard error of the gain, from the scatter of the cycles.
        mode: index of the mode.
    """

    amplitude_nm: Array
    gain: Array
    error: Array
    mode: int

    @property
    def crosstalk(self) -> Array:
        """The gains (amplitudes, modes) of the other modes; 0 for the mode itself."""
        others = self.gain.copy()
        others[:, self.mode] = 0.0
        return others

    def within(self, gain_error: float, crosstalk: float) -> list[bool | None]:
        """Whether `|gain - 1|` and cross-talk are within these limits at each amplitude; None if too noisy to tell."""
        own = np.arange(self.gain.shape[1]) == self.mode
        limit = np.where(own, gain_error, crosstalk)
        beyond = np.abs(self.gain - own) > limit + SIGMAS * self.error
        sure = self.error <= limit / 2  # false for the NaN of a single cycle
        rows = zip(beyond, sure, strict=True)
        return [False if is_beyond.any() else True if is_sure.all() else None for is_beyond, is_sure in rows]


def gains(error_nm: Array, mode: int, levels_nm: Array, starts: Integers, frames: int) -> Gains:
    """Gain and cross-talk of a mode, from open-loop errors (frames, modes), nm, on a staircase of levels (levels,), nm.

    At each level, the errors are averaged over `frames` frames; `starts` (levels,) has the index of the first of them.
    A standard error needs two cycles or more.
    """
    means = np.stack([error_nm[start : start + frames].mean(axis=0) for start in starts])
    per_cycle = (means * np.sign(levels_nm)[:, None]).reshape(-1, len(_SIGNS), error_nm.shape[1]).mean(axis=1)
    height = np.abs(levels_nm[:: len(_SIGNS)])
    amplitudes = np.unique(height)
    cycles = [per_cycle[height == amplitude] / amplitude for amplitude in amplitudes]
    mean_gain = np.stack([each.mean(axis=0) for each in cycles])
    error = np.stack([each.std(axis=0, ddof=1) / np.sqrt(len(each)) for each in cycles])
    return Gains(amplitudes, mean_gain, error, mode)


def captured(error_nm: Array, command_nm: Array, mode: int, level_nm: float, before: slice, after: slice) -> bool:
    """Whether a closed loop corrected a step of one mode.

    No mode may have an error left, and the command of that mode must have moved against the step: a loop that settled
    at another zero of the sensor has no error either. Commands of other modes may follow a drift. Errors and commands
    are (frames, modes), nm rms; `before` are frames before the step, `after` those in which the loop has settled again.
    """
    moved_nm = command_nm[after, mode].mean() - command_nm[before, mode].mean()
    residual_nm = error_nm[after].mean(axis=0)
    allowed = MAX_RESIDUAL * abs(level_nm)
    return bool(abs(moved_nm + level_nm) <= allowed and (np.abs(residual_nm) <= allowed).all())
