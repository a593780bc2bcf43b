"""The message bus as processes use it: publish, subscribe, answer, query.

`ZenohBus` carries the messages between processes; `MemoryBus` does the same within one, for tests. Handlers run on
the thread that receives, one message after the other: a slow handler delays the next message.
"""

import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from google.protobuf.message import DecodeError

from lowfc.adapters.process.clock_offset import ClockOffset
from lowfc.contract.envelope import Envelope
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import HEALTH, Topic

ALL = "*"
"""Wildcard for the name of any mirror or process."""


class Sample(NamedTuple):
    """One message as it arrived.

    Attributes:
        key: where it was published.
        payload: protobuf bytes.
        sequence: see `Envelope`.
        publish_time_ns: when the publisher sent it, host clock.
        receive_time_ns: when the thread that received it had it here, host clock.
    """

    key: str
    payload: bytes
    sequence: int
    publish_time_ns: int
    receive_time_ns: int


@dataclass(slots=True)
class Query:
    """A query of a key that waits for its answer: `reply` sends it, later and from any thread, once."""

    key: str
    payload: bytes
    reply: Callable[[bytes], None]

    @property
    def name(self) -> str:
        """Last part of the key."""
        return self.key.rpartition("/")[2]


class Publisher(Protocol):
    """Publishes one topic under one key.

    Attributes:
        published: messages so far, with those skipped.
        skipped: messages that never were: frames that a camera lost.
        handed_ns: time at which the last one had been handed to its direct link, or else to the bus, host clock.
        last: message and envelope, of a topic that can be queried.
    """

    topic: Topic
    key: str
    published: int
    skipped: int
    handed_ns: int
    last: tuple[bytes, Envelope] | None

    def put(self, payload: bytes, publish_time_ns: int | None = None, sequence: int | None = None) -> Envelope:
        """Send `payload`, by default now and with the next sequence; never waits for a reader.

        A publisher that sets sequences (a replay: those of the log) sets them with every put.
        """
        ...


class Ring(Protocol):
    """The newest messages of one topic, kept until they are drained."""

    def drain(self) -> list[Sample]:
        """Messages since the last call, in their order; `receive_time_ns` is that of this call."""
        ...

    def close(self) -> None:
        """Undeclare the subscription, once or more often."""
        ...


class Bus(Protocol):
    """A connection of one process to all others of its run; `offset` is of the router's clock, across hosts."""

    faults: "Faults"
    offset: ClockOffset | None

    def publisher(self, topic: Topic, name: str = "") -> Publisher:
        """Publisher of a topic; the last message of a queryable topic is what `get` on its key returns."""
        ...

    def subscribe(self, topic: Topic, handler: Callable[[Sample], None], name: str = ALL) -> Callable[[], None]:
        """Call `handler` with every message of a topic, of one mirror or process or of all; return what ends it."""
        ...

    def ring(self, topic: Topic, capacity: int) -> "Ring":
        """Keep the newest `capacity` messages of a topic for a monitor, at no cost until it drains them."""
        ...

    def queryable(self, key_expression: str, handler: Callable[[Query], None]) -> None:
        """Call `handler` with every query of a key expression such as "lowfc/request/*"."""
        ...

    def get(self, key: str, payload: bytes = b"", timeout_s: float = 1.0) -> list[Sample]:
        """Query a key and return the answers; an empty list where no process answers."""
        ...

    def peers(self) -> int:
        """Number of other processes that this one is connected to."""
        ...

    def restart(self) -> None:
        """Begin a new start of this process, as where a camera's numbers begin again: publishers count from 0."""
        ...

    def close(self) -> None:
        """Leave the run."""
        ...


def states(bus: Bus, topics: Iterable[Topic], timeout_s: float = 1.0) -> Iterator[tuple[Topic, Sample]]:
    """Query the states among `topics` from all of their publishers, for a process that joins late.

    Health is none of them: it is published twice a second.
    """
    for topic in topics:
        if topic.queryable and topic is not HEALTH:
            for sample in bus.get(topic.at(ALL), timeout_s=timeout_s):
                yield topic, sample


UNREADABLE = (BadMessageError, DecodeError)
"""Exceptions that a bad message raises."""


class Faults:
    """Exceptions of handlers, and messages that cannot be read.

    Of exceptions, the first of each place goes to standard error with its traceback. Messages that cannot be read are
    counted without one, until `take_unreadable`.

    Attributes:
        counts: of exceptions, by place.
        unreadable: count and last reason of messages that could not be read, by key.
    """

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.unreadable: dict[str, tuple[int, object]] = {}
        self._lock = threading.Lock()

    def add(self, place: str, key: str, fault: Exception) -> None:
        """Count a fault at a place (such as "camera: handler of") and a key; a bad message counts as unreadable."""
        if isinstance(fault, UNREADABLE):
            self.add_unreadable(key, fault)
            return
        where = f"{place} {key}"
        with self._lock:
            seen = self.counts.get(where, 0)
            self.counts[where] = seen + 1
        if not seen:
            text = "".join(traceback.format_exception(fault))
            sys.stderr.write(f"{where}: {text}(further ones here are only counted)\n")

    def add_unreadable(self, key: str, why: object) -> None:
        """Count a message that could not be read, by its key or its key expression."""
        with self._lock:
            count, _ = self.unreadable.get(key, (0, ""))
            self.unreadable[key] = count + 1, why

    def take_unreadable(self) -> dict[str, tuple[int, object]]:
        """Messages that could not be read since the last call: count and last reason, by key."""
        with self._lock:
            taken, self.unreadable = self.unreadable, {}
        return taken


def name_in(topic: Topic, key: str) -> str:
    """Name of the mirror or process in a key of this topic; empty for a topic without one."""
    before, placeholder, after = topic.key.partition("{name}")
    return key[len(before) : len(key) - len(after)] if placeholder else ""
