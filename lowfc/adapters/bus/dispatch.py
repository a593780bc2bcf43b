"""A message handed on where it arrives, on the thread that receives: nobody has to be woken for it."""

import threading
from collections.abc import Callable

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.sequence_gaps import Arrivals

MOST_IN_A_ROW = 16
"""Messages that are handed on one upon the other before some are skipped."""
REST_NS = 50_000
"""Without a message for so long, there is none that waits."""
LONG_AGO_NS = 5_000_000
"""Age at which a message is old, whatever came before it, and at three periods where these are longer."""


class Handover(Arrivals):
    """Hands each message to a handler in the order in which they come, and says which were superseded.

    What comes while its reader stands still waits. One that is a period old when it is handed on, right behind another,
    has been superseded by a newer one; so has one that is older than `LONG_AGO_NS`. A handler that does not keep up
    would fall behind for good: after `MOST_IN_A_ROW` messages one upon the other, all that still wait are skipped.
    """

    def __init__(
        self,
        key: str,
        handler: Callable[[Sample], None],
        now_ns: Callable[[], int],
        period_ns: int | None = None,
        superseded: Callable[[Sample], None] | None = None,
    ) -> None:
        """Hand messages on.

        Args:
            key: of the messages.
            handler: gets them.
            now_ns: the clock of their `receive_time_ns`.
            period_ns: of the messages; None where each waits for the answer to the last one: none is ever superseded.
            superseded: gets those that were superseded, instead of `handler`; they are skipped when None.
        """
        super().__init__(key)
        self._handler = handler
        self._now_ns = now_ns
        self._period_ns = period_ns
        self._old_ns = max(LONG_AGO_NS, 3 * (period_ns or 0))
        self._superseded = superseded
        self._turn = threading.Lock()
        self._skipped = 0
        self._in_a_row = 0
        self._done_ns = 0

    @property
    def skipped(self) -> int:
        """Messages that were superseded, or waited behind too many others."""
        return self._skipped

    def put(self, sample: Sample) -> None:
        """Hand a message on, or skip it; called on the threads that receive, which take turns."""
        with self._turn:
            self._put(sample)

    def _put(self, sample: Sample) -> None:
        handler: Callable[[Sample], None] | None = self._handler
        if self._period_ns is not None:
            crowded = sample.receive_time_ns - self._done_ns <= REST_NS
            self._in_a_row = self._in_a_row + 1 if crowded else 1
            age_ns = sample.receive_time_ns - sample.publish_time_ns
            if self._in_a_row > MOST_IN_A_ROW:
                handler = None
            elif age_ns >= (self._period_ns if crowded else self._old_ns):
                handler = self._superseded
        if handler is None:
            self._skipped += 1
        else:
            handler(sample)
        self.count(sample)
        self._done_ns = self._now_ns()
