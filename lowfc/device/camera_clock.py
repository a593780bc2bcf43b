"""A camera's own clock: its times by the host's."""

WINDOW_NS = 10_000_000_000
"""In which the offset is looked for: a quartz of 20 parts in a million goes 0.2 ms astray meanwhile."""


class CameraClock:
    """Times of a camera whose clock has an epoch and a rate of its own, by CLOCK_MONOTONIC.

    No frame arrives before it was stamped, and some arrive almost at once. So the least difference between reception
    and stamp of the last 10 s is the offset, but for the shortest transfer, by which times are late.

    Example:
        self.clock = CameraClock()                                    # in __init__
        end_ns = self.clock.monotonic_ns(stamp_ns, time.monotonic_ns())  # in expose, just after the frame has come
    """

    def __init__(self) -> None:
        """Without any frame yet."""
        self._least_ns: list[int] = []
        self._begun_ns = 0

    def monotonic_ns(self, stamp_ns: int, received_ns: int) -> int:
        """Time of a stamp (ns of the camera's clock, of the end of the exposure) of a frame received at that time."""
        offset_ns = received_ns - stamp_ns
        if not self._least_ns or received_ns - self._begun_ns > WINDOW_NS // 2:
            self._least_ns = [*self._least_ns[-1:], offset_ns]
            self._begun_ns = received_ns
        self._least_ns[-1] = min(self._least_ns[-1], offset_ns)
        return stamp_ns + min(self._least_ns)
