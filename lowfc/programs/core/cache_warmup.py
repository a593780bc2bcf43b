"""Cache warm-up: the control step repeated shortly before the next frame, so that it finds the caches warm."""

LEAD_NS = 300_000
"""Before the frame; what happens in between pushes little out of the caches, and a host may be late by some of it."""
LATEST_NS = 80_000
"""Before the frame, after which it would have to wait."""
SHORTEST_PERIOD_NS = 500_000
"""Frames that come faster leave no time for a warm-up, and the caches no time to cool."""
DRIFT = 50
"""Part of a frame's lateness, one in so many, by which the schedule follows it."""


class CacheWarmup:
    """The schedule of the frames, as far as it is known, and the one time before each frame for the warm-up.

    A frame that is early, or far from the schedule, sets it; one that is late moves it a little, for a host is late now
    and then and a camera is not.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns = 0
        self._waits = False

    def came(self, now_ns: int) -> None:
        """Note a frame; the next warm-up is before the next one."""
        late_ns = now_ns - self._due_ns
        if not 0 <= late_ns <= LEAD_NS:
            self._due_ns = now_ns
        else:
            self._due_ns += late_ns // DRIFT
        self._due_ns += self._period_ns
        self._waits = self._period_ns > SHORTEST_PERIOD_NS

    def rest_ns(self, now_ns: int) -> int | None:
        """Time until the next warm-up; None without one."""
        return max(self._due_ns - LEAD_NS - now_ns, 0) if self._waits else None

    def begins(self, now_ns: int) -> bool:
        """Whether to warm up now; true once for a frame, and not where it is too late."""
        if not self._waits or now_ns < self._due_ns - LEAD_NS:
            return False
        self._waits = False
        return now_ns <= self._due_ns - LATEST_NS
