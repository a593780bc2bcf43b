"""Conversion of a camera's own clock to the host's."""

WINDOW_NS = 10_000_000_000
"""Longest window of the offset estimate; a clock that is off by 20 ppm drifts 0.2 ms in it."""


class CameraClock:
    """Converts times of a camera whose clock has its own epoch and rate to CLOCK_MONOTONIC.

    The offset is the smallest difference between reception and time stamp in the last 5 to 10 s. Converted times are
    therefore late by the shortest transfer time. A stamp before the previous one is a restart of the camera's clock.

    Example:
        self.clock = CameraClock()                                    # in __init__
        end_ns = self.clock.monotonic_ns(stamp_ns, time.monotonic_ns())  # in expose, on reception
    """

    def __init__(self) -> None:
        """Start without any frame."""
        self._minima_ns: list[int] = []  # smallest offset in the previous and the present half window
        self._begun_ns = self._last_ns = 0

    def monotonic_ns(self, stamp_ns: int, received_ns: int) -> int:
        """Convert the stamp of a received frame (end of the exposure, ns of the camera's clock)."""
        offset_ns = received_ns - stamp_ns
        age_ns = received_ns - self._begun_ns
        if stamp_ns < self._last_ns:
            self._minima_ns = []
        self._last_ns = stamp_ns
        if not self._minima_ns or age_ns > WINDOW_NS // 2:
            self._minima_ns = [*self._minima_ns[-1:], offset_ns] if age_ns < WINDOW_NS else [offset_ns]
            self._begun_ns = received_ns
        self._minima_ns[-1] = min(self._minima_ns[-1], offset_ns)
        return stamp_ns + min(self._minima_ns)
