"""What the processes ask of a message bus: publish, subscribe, answer, ask.

`ZenohBus` carries the messages between processes; `MemoryBus` does the same within one, for tests. Handlers run on
the thread that receives, one message after the other: what they take, the next one waits for.
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
"""In place of a name: every mirror, or every process."""


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
    """A question that waits for its answer; `reply` may be called later and from any thread, once.

    Attributes:
        key: what was asked.
        name: last part of the key, such as "gain" of "lowfc/request/gain".
        payload: protobuf bytes; may be empty.
        reply: sends the answer.
    """

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
        published: messages so far.
        handed_ns: when the last one had been handed to the reader that waits for it, by the host's clock: by its short
            way, or else by the bus.
        last: message and envelope of a topic that can be asked for.
    """

    topic: Topic
    key: str
    published: int
    handed_ns: int
    last: tuple[bytes, Envelope] | None

    def put(self, payload: bytes, publish_time_ns: int | None = None, sequence: int | None = None) -> Envelope:
        """Send `payload`, by default now and with the next sequence; never waits for a reader.

        Whoever gives sequences (a replay, those of the log) gives them with every put.
        """
        ...


class Ring(Protocol):
    """Messages of one topic that wait to be looked at."""

    def drain(self) -> list[Sample]:
        """Those that arrived since the last call, in their order; `receive_time_ns` is that of this call."""
        ...

    def close(self) -> None:
        """Undeclare the subscription, once or more often."""
        ...


class Bus(Protocol):
    """A connection of one process to all others of its run.

    Attributes:
        faults: of handlers, and messages that could not be read.
        offset: of the router's clock, where the run is on several hosts.
    """

    faults: "Faults"
    offset: ClockOffset | None

    def publisher(self, topic: Topic, name: str = "") -> Publisher:
        """Publisher of a topic; the last message of a queryable topic is what `get` on its key returns."""
        ...

    def subscribe(self, topic: Topic, handler: Callable[[Sample], None], name: str = ALL) -> Callable[[], None]:
        """Call `handler` with every message of a topic, of one mirror or process or of all; return what ends it."""
        ...

    def ring(self, topic: Topic, capacity: int) -> "Ring":
        """Keep the newest `capacity` messages of a topic for who looks now and then, at no cost in between."""
        ...

    def queryable(self, key_expression: str, handler: Callable[[Query], None]) -> None:
        """Call `handler` with every question asked under a key expression such as "lowfc/request/*"."""
        ...

    def get(self, key: str, payload: bytes = b"", timeout_s: float = 1.0) -> list[Sample]:
        """Ask, and wait for the answers; nobody there is an empty list."""
        ...

    def peers(self) -> int:
        """How many other processes this one is connected to."""
        ...

    def close(self) -> None:
        """Leave the run."""
        ...


def states(bus: Bus, topics: Iterable[Topic], timeout_s: float = 1.0) -> Iterator[tuple[Topic, Sample]]:
    """Ask for the states among `topics`, each from everybody who publishes it, for who was not there to hear them.

    Health is none of them: it comes twice a second.
    """
    for topic in topics:
        if topic.queryable and topic is not HEALTH:
            for sample in bus.get(topic.at(ALL), timeout_s=timeout_s):
                yield topic, sample


UNREADABLE = (BadMessageError, DecodeError)
"""Exceptions that a message raises, and no mistake of this program."""


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
        """Count a fault at a place (such as "camera: handler of") that deals with a key; what a message did is its."""
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
