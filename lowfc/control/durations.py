"""Percentiles of durations, which are counted in bins and not stored."""

from array import array
from math import log

import numpy as np

_MIN_NS = 1_000
BIN_RATIO = 1.01  # ratio of the upper to the lower edge of a bin
_BINS_PER_LOG = 1 / log(BIN_RATIO)  # bins for each factor of e
_BINS = 2_000


class Durations:
    """Histogram of durations with bins of 1 %, from 1 us to 430 s; the largest duration is exact."""

    def __init__(self) -> None:
        self._counts = array("q", [0] * _BINS)  # its elements are incremented faster than those of a numpy array
        self.count = 0
        self.max_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        index = int(log(duration_ns / _MIN_NS) * _BINS_PER_LOG) + 1 if duration_ns > _MIN_NS else 0
        self._counts[min(index, _BINS - 1)] += 1
        self.count += 1
        self.max_ns = max(self.max_ns, duration_ns)

    def percentiles_ns(self, *fractions: float) -> list[int]:
        """Percentiles for these fractions (0 to 1), rounded up to the edge of a bin; 0 if nothing was counted."""
        indices = np.searchsorted(np.cumsum(self._counts), np.ceil(np.array(fractions) * self.count))
        edges_ns = [round(_MIN_NS * BIN_RATIO ** int(index)) if index < _BINS - 1 else self.max_ns for index in indices]
        return [min(edge_ns, self.max_ns) for edge_ns in edges_ns]
