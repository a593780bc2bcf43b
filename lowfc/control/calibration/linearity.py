"""How far a sensor is linear, and from how far a loop closes, as measured with shapes of one mode on the mirror."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Whole

SURE = 3.0
"""Standard errors beyond the limit at which a value counts as beyond it."""
MISSED = 0.3
"""Part of a shape that may be left over, in its mode or another, when a loop has taken it away."""

_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])  # so that what drifts evenly has no part in the difference


def levels(amplitudes_nm: npt.ArrayLike, cycles: int) -> Array:
    """The levels of a staircase that pushes and pulls `cycles` times at each amplitude (amplitudes,) in turn."""
    return np.concatenate([np.tile(amplitude * _SIGNS, cycles) for amplitude in np.asarray(amplitudes_nm, float)])


@dataclass(frozen=True, slots=True)
class Gains:
    """What the sensor makes of one mode, at each amplitude.

    Attributes:
        amplitude_nm: (amplitudes,).
        gain: (amplitudes, modes) measured of each mode, beside the one that was there.
        error: (amplitudes, modes) its standard error, from cycle to cycle.
        mode: the place of the one that was there.
    """

    amplitude_nm: Array
    gain: Array
    error: Array
    mode: int

    @property
    def crosstalk(self) -> Array:
        """The same (amplitudes, modes) with nothing at the mode itself."""
        others = self.gain.copy()
        others[:, self.mode] = 0.0
        return others

    def within(self, gain_error: float, crosstalk: float) -> list[bool | None]:
        """Whether gain and cross-talk at each amplitude are within these; None where the noise is too high to say."""
        limit = np.full(self.gain.shape[1], crosstalk)
        limit[self.mode] = gain_error
        departure = self.crosstalk
        departure[:, self.mode] = self.gain[:, self.mode] - 1
        beyond = np.abs(departure) > limit + SURE * self.error
        unsure = self.error > limit / 2
        return [
            False if far.any() else None if vague.any() else True for far, vague in zip(beyond, unsure, strict=True)
        ]


def gains(error_nm: Array, mode: int, levels_nm: Array, starts: Whole, frames: int) -> Gains:
    """Gain and cross-talk of a mode that went through the levels (levels,) of `levels`, from open-loop errors.

    Errors are (frames, modes); `starts` (levels,) are the first of the `frames` frames that saw each level.
    """
    means = np.stack([error_nm[start : start + frames].mean(axis=0) for start in starts])
    per_cycle = (means * np.sign(levels_nm)[:, None]).reshape(-1, len(_SIGNS), error_nm.shape[1]).mean(axis=1)
    height = np.abs(levels_nm[:: len(_SIGNS)])
    amplitudes = np.unique(height)
    cycles = [per_cycle[height == amplitude] / amplitude for amplitude in amplitudes]
    found = np.stack([of.mean(axis=0) for of in cycles])
    uncertain = np.stack([of.std(axis=0, ddof=1) / np.sqrt(len(of)) for of in cycles])
    return Gains(amplitudes, found, uncertain, mode)


def captured(error_nm: Array, command_nm: Array, mode: int, level_nm: float, before: slice, after: slice) -> bool:
    """Whether a closed loop took a shape of one mode away that came at once.

    The command of that mode must have moved against the shape, and no error be left in any: a loop that settled
    elsewhere measures none either. Commands of other modes follow what drifts meanwhile. Errors and commands are
    (frames, modes); `before` are frames before the shape came, `after` those in which the loop must have settled again.
    """
    moved_nm = command_nm[after, mode].mean() - command_nm[before, mode].mean()
    left = error_nm[after].mean(axis=0)
    allowed = MISSED * abs(level_nm)
    return bool(abs(moved_nm + level_nm) <= allowed and (np.abs(left) <= allowed).all())
