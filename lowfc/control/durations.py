"""Percentiles of durations, gathered one by one without keeping them."""

import numpy as np


class Durations:
    """Counts durations in bins of 1 us up to 0.1 s; the largest is kept exactly."""

    BIN_NS = 1_000
    BINS = 100_000

    def __init__(self) -> None:
        self._counts = [0] * (self.BINS + 1)
        self.count = 0
        self.max_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        self._counts[min(max(duration_ns, 0) // self.BIN_NS, self.BINS)] += 1
        self.count += 1
        self.max_ns = max(self.max_ns, duration_ns)

    def percentiles_ns(self, *fractions: float) -> list[int]:
        """Durations that these fractions do not exceed, to the upper edge of a bin; 0 where nothing was counted."""
        cumulated = np.cumsum(self._counts)
        found = np.searchsorted(cumulated, np.ceil(np.array(fractions) * self.count))
        return [min(int(index + 1) * self.BIN_NS, self.max_ns) for index in found]
