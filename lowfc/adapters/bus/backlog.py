"""Queue for a slow reader, bounded in messages and in bytes."""

import threading
from collections import deque

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.messages import Rate, Topic


class Backlog:
    """Queue from the bus's threads to a writing thread.

    A message that does not fit is dropped, and its missing sequence number counts as a loss. Messages of queryable
    topics and of topics published on events are never dropped: they are few, and needed to interpret the others.
    """

    def __init__(self, max_messages: int, max_bytes: int) -> None:
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._bytes = 0
        self._waiting: deque[tuple[Topic, Sample]] = deque()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, topic: Topic, sample: Sample) -> None:
        """Append a message, or drop it if the queue is full."""
        size = len(sample.payload)
        with self._lock:
            fits = len(self._waiting) < self._max_messages and self._bytes + size <= self._max_bytes
            if fits or topic.queryable or topic.rate is Rate.EVENT:
                self._waiting.append((topic, sample))
                self._bytes += size

    def take(self) -> tuple[Topic, Sample]:
        """Remove and return the oldest message; IndexError if there is none."""
        with self._lock:
            topic, sample = self._waiting.popleft()
            self._bytes -= len(sample.payload)
        return topic, sample
