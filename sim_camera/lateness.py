"""Detection of habitually late commands: those applied after the next exposure has begun."""

from collections import deque

WINDOW = 500
"""Number of newest commands in the statistics."""
_ON = 0.25  # fraction of late commands in the window above which `habitual` becomes true
_OFF = 0.125  # fraction at and below which it becomes false


class Lateness:
    """Counts late commands.

    Attributes:
        total: number of late commands since the start.
        habitual: becomes true when late commands exceed a quarter of `WINDOW`, false when they are an eighth or less.
    """

    def __init__(self) -> None:
        self.total = self._late = 0
        self.habitual = False
        self._last: deque[bool] = deque(maxlen=WINDOW)

    @property
    def percent(self) -> float:
        """Percentage of late commands among the last `WINDOW` commands."""
        return 100 * self._late / len(self._last) if self._last else 0.0

    def add(self, late: bool) -> bool:
        """Count a command; return whether `habitual` has changed."""
        if len(self._last) == WINDOW:
            self._late -= self._last[0]
        self._last.append(late)
        self._late += late
        self.total += late
        before = self.habitual
        self.habitual = self._late > WINDOW * (_OFF if before else _ON)
        return self.habitual != before
