"""One-slot mailbox from the bus's thread to the loop: the loop receives the newest message, or times out."""

import threading
import time
from collections import deque

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.sequence_gaps import Arrivals

MAX_WAIT_S = 0.5
"""Longest single wait. A signal that arrives just before a wait is handled after it, so this bounds the delay."""


class Mailbox(Arrivals):
    """Holds the message received last; the next one replaces it.

    Only one thread calls `take`. It waits on a bare lock: in CPython this is the cheapest wait with a timeout.
    """

    def __init__(self, key: str = "") -> None:
        super().__init__(key)
        self._taken = 0
        self._woken = False
        self._slot: deque[Sample] = deque(maxlen=1)
        self._available = threading.Lock()
        self._available.acquire()

    @property
    def skipped(self) -> int:
        """Number of messages that were replaced by a newer one before `take`."""
        return self.received - self._taken - len(self._slot)

    @property
    def waiting(self) -> bool:
        """Whether a message is waiting."""
        return bool(self._slot)

    def put(self, sample: Sample) -> None:
        """Store a message, usually on the bus's thread."""
        self.count(sample.sequence)
        self._slot.append(sample)
        self._notify()

    def take(self, timeout_s: float) -> Sample | None:
        """Remove and return the newest message; None after `timeout_s` without one, or after `wake`."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                sample = self._slot.popleft()
            except IndexError:
                left_s = deadline_s - time.monotonic()
                if self._woken or left_s <= 0:
                    self._woken = False
                    return None
                self._available.acquire(timeout=min(left_s, MAX_WAIT_S))
            else:
                self._taken += 1
                return sample

    def wake(self) -> None:
        """End the present or next wait of `take`; callable from any thread and from a signal handler."""
        self._woken = True
        self._notify()

    def _notify(self) -> None:
        try:
            self._available.release()
        except RuntimeError:  # released already
            return
