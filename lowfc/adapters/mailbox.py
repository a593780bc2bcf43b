"""A one-slot mailbox between the bus's thread and the loop: the loop gets the newest message, or a timeout."""

import threading
import time
from collections import deque

from lowfc.adapters.bus import Sample
from lowfc.adapters.envelope import start_of


class Mailbox:
    """Holds the newest message of one publisher; a newer one replaces it.

    One thread puts and one takes. A bare lock is the signal: releasing it is the cheapest way for CPython to wake a
    thread that waits with a timeout.

    Attributes:
        key: what it gets, where it was made for one topic.
        received: messages put.
        missing: messages that never arrived, by gaps in the sequence of one start of the publisher.
        restarts: how often the publisher began anew.
        last_sequence: of the newest message.
    """

    def __init__(self, key: str = "") -> None:
        self.key = key
        self.received = 0
        self.missing = 0
        self.restarts = 0
        self.last_sequence = 0
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
        sequence, last = sample.sequence, self.last_sequence
        if not self.received:
            self.last_sequence = sequence
        elif sequence > last:
            if start_of(sequence) == start_of(last):
                self.missing += sequence - last - 1
            else:
                self.restarts += 1
            self.last_sequence = sequence
        self.received += 1
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
                self._signal.acquire(timeout=left_s)
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
