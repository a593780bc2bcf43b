"""The rate at which a process works, as in its Health."""

from collections import deque

WINDOW_NS = 500_000_000
UNITS = 4
"""Least number of units of work, such as frames, from which a rate is measured."""


class WorkRate:
    """Rate of work over the last half second or, if the work is slow, over its last four units or a few more.

    The rate is 0 at the first update with work, which starts the measurement, and after half a second or more without
    work in which four units were expected.
    """

    def __init__(self) -> None:
        self._updates: deque[tuple[int, int]] = deque(maxlen=16)  # time (ns) and count at each update with new work
        self._last_update = 0, 0
        self._rate_hz = 0.0

    def update(self, now_ns: int, work: int) -> float:
        """Rate, Hz, when the number of units is now `work`; call it repeatedly."""
        if not self._updates:
            if work:
                self._updates.append((now_ns, work))
        elif work != self._last_update[1]:
            past = (*self._updates, self._last_update)
            usable = [(at_ns, count) for at_ns, count in past if work - count >= UNITS and now_ns - at_ns >= WINDOW_NS]
            since_ns, done = usable[-1] if usable else self._updates[0]
            if not self._rate_hz:  # at first and after a silence: measure from now on
                self._updates.clear()
            self._rate_hz = (work - done) * 1e9 / max(now_ns - since_ns, 1)
            self._updates.append((now_ns, work))
        elif (silent_ns := now_ns - self._updates[-1][0]) >= WINDOW_NS and silent_ns * 1e-9 * self._rate_hz >= UNITS:
            self._rate_hz = 0.0
            self._updates = deque([self._updates[-1]], maxlen=16)
        self._last_update = now_ns, work
        return self._rate_hz
