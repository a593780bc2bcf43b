"""In-memory bus for unit and fault tests: a put calls the handlers before it returns."""

import contextlib
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeVar

from lowfc.adapters.bus.bus import ALL, Faults, Query, Sample
from lowfc.adapters.process.clock import Clock
from lowfc.adapters.process.clock_offset import ClockOffset
from lowfc.contract.envelope import Envelope, sequence_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import Topic

T = TypeVar("T")


@dataclass(slots=True)
class MemoryHub:
    """Connects the buses of one test; `lose` decides whether a message to a role is lost."""

    buses: "list[MemoryBus]" = field(default_factory=list)
    starts: dict[str, int] = field(default_factory=dict)  # start time of the newest bus of each role, Unix seconds
    lose: Callable[[str, str, Envelope], bool] = lambda role, key, envelope: False


class MemoryPublisher:
    """Publishes one topic to all buses of the hub."""

    def __init__(self, bus: "MemoryBus", topic: Topic, key: str) -> None:
        self.topic = topic
        self.key = key
        self.published = self.skipped = 0
        self.handed_ns = 0
        self.last: tuple[bytes, Envelope] | None = None
        self._bus = bus

    def put(self, payload: bytes, publish_time_ns: int | None = None, sequence: int | None = None) -> Envelope:
        """Deliver `payload` to every handler before returning."""
        if self._bus.closed:
            raise BusError(f"{self.key}: the bus is closed")
        clock = self._bus.clock
        if sequence is None:
            sequence = sequence_of(self._bus.start_s, self.published)
        envelope = Envelope(sequence, clock.host_ns() if publish_time_ns is None else publish_time_ns)
        self.published += 1
        if self.topic.queryable:
            self.last = (payload, envelope)
        for bus in list(self._bus.hub.buses):
            bus.deliver(self.key, payload, envelope)
        self.handed_ns = clock.host_ns()
        return envelope


class MemoryRing:
    """Ring buffer as `Ring`, but `receive_time_ns` is the time of the put. It is closed once nothing refers to it."""

    def __init__(self, bus: "MemoryBus", topic: Topic, capacity: int) -> None:
        self.waiting: deque[Sample] = deque(maxlen=capacity)
        self._leave = weakref.finalize(self, bus.subscribe(topic, self.waiting.append))

    def drain(self) -> list[Sample]:
        """See `Ring.drain`."""
        return [self.waiting.popleft() for _ in range(len(self.waiting))]

    def close(self) -> None:
        """See `Ring.close`."""
        self._leave()


class MemoryBus:
    """One process's connection to a `MemoryHub`."""

    def __init__(self, hub: MemoryHub, role: str, clock: Clock) -> None:
        self.hub = hub
        self.role = role
        self.clock = clock
        self.closed = False
        self.faults = Faults()
        self.offset: ClockOffset | None = None
        self.start_s = max(clock.start_s, hub.starts.get(role, -1) + 1)
        hub.starts[role] = self.start_s
        self.publishers: list[MemoryPublisher] = []
        self._subscriptions: list[tuple[Callable[[str], bool], str, Callable[[Sample], None]]] = []
        self.queryables: list[tuple[str, Callable[[Query], None]]] = []
        hub.buses.append(self)

    def publisher(self, topic: Topic, name: str = "") -> MemoryPublisher:
        """See `Bus.publisher`."""
        publisher = MemoryPublisher(self, topic, topic.at(name))
        self.publishers.append(publisher)
        return publisher

    def subscribe(self, topic: Topic, handler: Callable[[Sample], None], name: str = ALL) -> Callable[[], None]:
        """See `Bus.subscribe`."""
        subscription = (lru_cache(topic.matches) if name == ALL else topic.at(name).__eq__, topic.at(name), handler)
        self._subscriptions.append(subscription)
        return lambda: self._subscriptions.remove(subscription)

    def ring(self, topic: Topic, capacity: int) -> "MemoryRing":
        """See `Bus.ring`."""
        return MemoryRing(self, topic, capacity)

    def queryable(self, key_expression: str, handler: Callable[[Query], None]) -> None:
        """See `Bus.queryable`."""
        self.queryables.append((key_expression, handler))

    def get(self, key: str, payload: bytes = b"", timeout_s: float = 1.0) -> list[Sample]:
        """See `Bus.get`; returns once every handler has replied or failed, or after `timeout_s`; any key is valid."""
        if self.closed:
            raise BusError(f"{key} cannot be queried: the bus is closed")
        answers: list[Sample] = []
        replied = threading.Semaphore(0)
        pending = 0
        for bus in list(self.hub.buses):
            matching = [stored for stored in bus.publishers if key in (stored.key, stored.topic.at(ALL))]
            answers.extend(_sample(stored.key, *stored.last, self.clock) for stored in matching if stored.last)
            start = Envelope(sequence_of(bus.start_s, 0), self.clock.host_ns())

            def reply(body: bytes, envelope: Envelope = start) -> None:
                answers.append(_sample(key, body, envelope, self.clock))
                replied.release()

            for handler in [handler for expression, handler in bus.queryables if _covers(expression, key)]:
                pending += bus.call("queryable of", key, handler, Query(key, payload, reply))
        deadline_s = time.monotonic() + timeout_s
        while pending and replied.acquire(timeout=max(0.0, deadline_s - time.monotonic())):
            pending -= 1
        return answers

    def peers(self) -> int:
        """See `Bus.peers`."""
        return sum(bus is not self for bus in self.hub.buses)

    def restart(self) -> None:
        """See `Bus.restart`."""
        self.start_s = self.hub.starts[self.role] = max(self.clock.host_ns() // 10**9, self.start_s + 1)
        for publisher in self.publishers:
            publisher.published = publisher.skipped = 0

    def close(self) -> None:
        """Leave the hub."""
        self.closed = True
        with contextlib.suppress(ValueError):
            self.hub.buses.remove(self)

    def deliver(self, key: str, payload: bytes, envelope: Envelope) -> None:
        """Call the handlers for a published message."""
        if self.hub.lose(self.role, key, envelope):
            return
        for matches, pattern, handler in list(self._subscriptions):
            if matches(key):
                self.call("handler of", pattern, handler, _sample(key, payload, envelope, self.clock))

    def call(self, what: str, key: str, handler: Callable[[T], None], argument: T) -> bool:
        """Call a handler; return False if it raised. The exception is counted in `faults` of this bus."""
        try:
            handler(argument)
        except Exception as fault:
            self.faults.add(f"{self.role}: {what}", key, fault)
            return False
        return True


def _sample(key: str, payload: bytes, envelope: Envelope, clock: Clock) -> Sample:
    return Sample(key, payload, envelope.sequence, envelope.publish_time_ns, clock.host_ns())


def _covers(expression: str, key: str) -> bool:
    return expression == key or (expression.endswith("/*") and key.rpartition("/")[0] == expression[:-2])
