"""Dispatch of messages on the thread that receives them, without waking another thread."""

import threading
from collections.abc import Callable

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.sequence_gaps import Arrivals

MAX_IN_A_ROW = 16
"""Number of messages dispatched back to back before waiting ones are skipped."""
QUEUED_WITHIN_NS = 50_000
"""A message counts as queued if it is received within this time after the dispatch of the previous message ended."""
OLD_NS = 5_000_000
"""Age, ns, from which any message counts as superseded; three periods of the messages if that is longer."""


class Dispatch(Arrivals):
    """Passes messages to a handler in their order of arrival and identifies superseded ones.

    Messages queue while the process stands still. A queued message is superseded if it is at least a period old when
    received. Any other message is superseded at an age of 5 ms or three periods, whichever is longer. After
    `MAX_IN_A_ROW` messages back to back, the messages that still wait are skipped, so that a slow handler does not fall
    ever further behind.
    """

    def __init__(
        self,
        key: str,
        handler: Callable[[Sample], None],
        now_ns: Callable[[], int],
        period_ns: int | None = None,
        superseded: Callable[[Sample], None] | None = None,
    ) -> None:
        """Set the handlers.

        Args:
            key: key of the messages.
            handler: called with each message.
            now_ns: clock of the messages' `receive_time_ns`.
            period_ns: period of the messages; None (lockstep): no message is ever superseded.
            superseded: called with superseded messages instead of `handler`; None skips them.
        """
        super().__init__(key)
        self._handler = handler
        self._now_ns = now_ns
        self._period_ns = period_ns
        self._old_ns = max(OLD_NS, 3 * (period_ns or 0))
        self._superseded = superseded
        self._lock = threading.Lock()
        self._skipped = 0
        self._in_a_row = 0
        self._done_ns = 0

    @property
    def skipped(self) -> int:
        """Number of skipped messages: superseded without a handler for these, or queued behind too many others."""
        return self._skipped

    def put(self, sample: Sample) -> None:
        """Dispatch or skip a message, one at a time; callable from any receive thread."""
        with self._lock:
            handler: Callable[[Sample], None] | None = self._handler
            if self._period_ns is not None:
                queued = sample.receive_time_ns - self._done_ns <= QUEUED_WITHIN_NS
                self._in_a_row = self._in_a_row + 1 if queued else 1
                age_ns = sample.receive_time_ns - sample.publish_time_ns
                if self._in_a_row > MAX_IN_A_ROW:
                    handler = None
                elif age_ns >= (self._period_ns if queued else self._old_ns):
                    handler = self._superseded
            if handler is None:
                self._skipped += 1
            else:
                handler(sample)
            self.count(sample.sequence)
            self._done_ns = self._now_ns()
