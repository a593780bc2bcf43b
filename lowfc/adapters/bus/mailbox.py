"""A one-slot mailbox between the bus's thread and the loop: the loop gets the newest message, or a timeout."""

import threading
import time
from collections import deque

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.sequence_gaps import Arrivals

LONGEST_WAIT_S = 0.5
"""A signal that strikes after Python has looked for one and before it waits is handled only when the wait is over."""


class Mailbox(Arrivals):
    """Holds the newest message of one publisher; a newer one replaces it.

    One thread puts and one takes. A bare lock is the signal: releasing it is the cheapest way for CPython to wake a
    thread that waits with a timeout.
    """

    def __init__(self, key: str = "") -> None:
        super().__init__(key)
        self._taken = 0
        self._woken = False
        self._slot: deque[Sample] = deque(maxlen=1)
        self._signal = threading.Lock()
        self._signal.acquire()

    @property
    def skipped(self) -> int:
        """Messages that arrived and were replaced by a newer one before they were taken."""
        return self.received - self._taken - len(self._slot)

    @property
    def waiting(self) -> bool:
        """Whether there is a message to take."""
        return bool(self._slot)

    def put(self, sample: Sample) -> None:
        """Leave a message; called on the bus's thread."""
        self.count(sample)
        self._slot.append(sample)
        self._raise_signal()

    def take(self, timeout_s: float) -> Sample | None:
        """Newest message; None after `timeout_s` without one, or as soon as `wake` was called."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                sample = self._slot.popleft()
            except IndexError:
                left_s = deadline_s - time.monotonic()
                if self._woken or left_s <= 0:
                    self._woken = False
                    return None
                self._signal.acquire(timeout=min(left_s, LONGEST_WAIT_S))
            else:
                self._taken += 1
                return sample

    def wake(self) -> None:
        """Make `take` return, now or the next time it would wait; callable from any thread and from a signal."""
        self._woken = True
        self._raise_signal()

    def _raise_signal(self) -> None:
        try:
            self._signal.release()
        except RuntimeError:  # it is raised already
            return
