"""The scale of a picture's colours: it follows what is shown, but slowly, so that colours can be compared."""

from math import floor, isfinite, log10

import numpy as np
import numpy.typing as npt

_STEPS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0)
_SHRINK_NS = 2_000_000_000


class Scale:
    """The largest magnitude shown, a round number.

    It grows at once, and shrinks after two seconds.
    """

    def __init__(self, least: float) -> None:
        self.least = least
        self.limit = 0.0
        self._needed_ns = 0

    def fit(self, values: npt.NDArray[np.floating], time_ns: int) -> bool:
        """Take values into account; True where the limit is another one now."""
        largest = max(float(values.max(initial=0.0)), -float(values.min(initial=0.0)))
        if not isfinite(largest):
            return self.fit(np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0), time_ns)
        wanted = round_up(max(largest, self.least))
        if wanted >= self.limit:
            self._needed_ns = time_ns
        if wanted > self.limit or (wanted < self.limit and time_ns - self._needed_ns > _SHRINK_NS):
            self.limit, self._needed_ns = wanted, time_ns
            return True
        return False


def round_up(value: float) -> float:
    """The next round number at or above a positive value."""
    decade = 10.0 ** floor(log10(value))
    return next(step * decade for step in _STEPS if value <= step * decade * (1 + 1e-9))
