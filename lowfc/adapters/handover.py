"""A message handed on where it arrives, on the bus's own thread: nobody has to be woken for it."""

from collections.abc import Callable

from lowfc.adapters.arrivals import Arrivals
from lowfc.adapters.bus import Sample

MOST_IN_A_ROW = 16
"""Messages that may wait behind each other before some are skipped."""
REST_NS = 50_000
"""Without a message for so long, there is none that waits."""


class Handover(Arrivals):
    """Hands each message to a handler in the order in which they come, and falls behind by a few at most.

    What comes in a burst is handled message by message, so that nothing is lost to a short stall. When a handler does
    not keep up, messages wait ahead of the bus's thread, where nobody sees them; that they come one upon the other is
    the sign of it. After `MOST_IN_A_ROW` of them, all that wait are skipped.
    """

    def __init__(self, key: str, handler: Callable[[Sample], None], now_ns: Callable[[], int]) -> None:
        """Hand messages of this key to `handler`; `now_ns` is the clock of their `receive_time_ns`."""
        super().__init__(key)
        self._skipped = 0
        self._handler = handler
        self._now_ns = now_ns
        self._in_a_row = 0
        self._done_ns = 0

    @property
    def skipped(self) -> int:
        """Messages that waited behind too many others."""
        return self._skipped

    def put(self, sample: Sample) -> None:
        """Hand a message on, or skip it; called on the bus's thread."""
        self.count(sample)
        if sample.receive_time_ns - self._done_ns > REST_NS:
            self._in_a_row = 0
        self._in_a_row += 1
        if self._in_a_row > MOST_IN_A_ROW:
            self._skipped += 1
        else:
            self._handler(sample)
        self._done_ns = self._now_ns()
