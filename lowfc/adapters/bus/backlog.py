"""Messages that wait for a slow reader, bounded by their number and by their bytes."""

import threading
from collections import deque

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.messages import Rate, Topic


class Backlog:
    """A queue from the bus's threads to one that writes.

    A message that does not fit is left out, and counted as lost by its sequence. States, requests and events are few
    and needed to understand the rest: they always fit.
    """

    def __init__(self, most_messages: int, most_bytes: int) -> None:
        self._most_messages = most_messages
        self._most_bytes = most_bytes
        self._bytes = 0
        self._waiting: deque[tuple[Topic, Sample]] = deque()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, topic: Topic, sample: Sample) -> None:
        """Append a message, or leave it out where too many wait."""
        size = len(sample.payload)
        with self._lock:
            fits = len(self._waiting) < self._most_messages and self._bytes + size <= self._most_bytes
            if fits or topic.queryable or topic.rate is Rate.EVENT:
                self._waiting.append((topic, sample))
                self._bytes += size

    def take(self) -> tuple[Topic, Sample]:
        """Oldest message; IndexError where nothing waits."""
        with self._lock:
            topic, sample = self._waiting.popleft()
            self._bytes -= len(sample.payload)
        return topic, sample
