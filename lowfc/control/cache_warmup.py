"""Cache warm-up: the last step is repeated shortly before the next, so that its code and data are cached."""

LEAD_NS = 300_000
"""Time from the warm-up to the next frame: short enough to keep the caches warm, with a margin for late wake-ups."""
MIN_LEAD_NS = 80_000
"""Least time from a warm-up to the next frame: a later warm-up would delay that frame."""
MIN_PERIOD_NS = 500_000
"""Up to this frame period there are no warm-ups: there is no time, and no need, since the caches stay warm."""
LATENESS_DIVISOR = 50
"""A frame that is late by at most `LEAD_NS` moves the schedule by its lateness divided by this number."""


class CacheWarmup:
    """Predicts the next frame and schedules one warm-up before it.

    A frame that is early, or late by more than `LEAD_NS`, resets the schedule. A less late frame moves the schedule
    only a little, because the host is sometimes late and the camera is not.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns = 0
        self._pending = False

    def frame_received(self, now_ns: int) -> None:
        """Update the schedule with a frame; the next warm-up is before the next frame."""
        late_ns = now_ns - self._due_ns
        if not 0 <= late_ns <= LEAD_NS:
            self._due_ns = now_ns
        else:
            self._due_ns += late_ns // LATENESS_DIVISOR
        self._due_ns += self._period_ns
        self._pending = self._period_ns > MIN_PERIOD_NS

    def wait_ns(self, now_ns: int) -> int | None:
        """Time until the next warm-up; None if none is pending."""
        return max(self._due_ns - LEAD_NS - now_ns, 0) if self._pending else None

    def due(self, now_ns: int) -> bool:
        """Whether to warm up now; true at most once per frame, and false if a warm-up would be too late."""
        if not self._pending or now_ns < self._due_ns - LEAD_NS:
            return False
        self._pending = False
        return now_ns <= self._due_ns - MIN_LEAD_NS
