"""Interface of the message bus: publish, subscribe, answer, query.

`ZenohBus` carries messages between processes, `MemoryBus` within one process, for tests. Handlers run on receive
threads: a slow handler delays the next message of the same publisher; meanwhile it may be called, on another thread,
with a message of another publisher.
"""

import contextlib
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
    """A received message.

    Attributes:
        key: key under which it was published.
        payload: protobuf bytes.
        sequence: sequence as in `Envelope`.
        publish_time_ns: time at which the publisher sent it, host clock.
        receive_time_ns: time at which a receive thread got it, or at which its ring was drained; host clock.
    """

    key: str
    payload: bytes
    sequence: int
    publish_time_ns: int
    receive_time_ns: int


@dataclass(slots=True)
class Query:
    """A query; `reply` sends its answer, once, at any time and from any thread."""

    key: str
    payload: bytes
    reply: Callable[[bytes], None]

    @property
    def name(self) -> str:
        """Name of the request: the last part of the key."""
        return self.key.rpartition("/")[2]


class Publisher(Protocol):
    """Publishes one topic under one key.

    Attributes:
        published: count in the next message's sequence: the number of messages so far plus `skipped`.
        skipped: number of counts without a message, because the camera lost the frame.
        handed_ns: time at which the last message was handed to the direct link, or to the bus if the link did not
            accept it; host clock.
    """

    topic: Topic
    key: str
    published: int
    skipped: int
    handed_ns: int

    def put(self, payload: bytes, publish_time_ns: int | None = None, sequence: int | None = None) -> Envelope:
        """Send `payload`, by default with the present time and the next sequence; the call may wait for slow readers.

        A caller that sets sequences (a replay sets those of the log) must set them in every call.
        """


class Ring(Protocol):
    """Ring buffer of the newest messages of one topic."""

    def drain(self) -> list[Sample]:
        """Return the messages since the last call, in order; their `receive_time_ns` is the time of this call."""

    def close(self) -> None:
        """End the subscription; may be called repeatedly."""


class Bus(Protocol):
    """A process's connection to all others of its run; `offset` is the router's clock offset, None on one host."""

    faults: "Faults"
    offset: ClockOffset | None

    def publisher(self, topic: Topic, name: str = "") -> Publisher:
        """Make a publisher of a topic; `get` on the key of a queryable topic returns its last message."""

    def subscribe(self, topic: Topic, handler: Callable[[Sample], None], name: str = ALL) -> Callable[[], None]:
        """Call `handler` with every message of a topic, from all or from `name`; the returned function unsubscribes."""

    def ring(self, topic: Topic, capacity: int) -> Ring:
        """Make a ring buffer of the newest `capacity` messages, for a monitor; it costs no processing until drained."""

    def queryable(self, key_expression: str, handler: Callable[[Query], None]) -> None:
        """Call `handler` with every query of a key expression such as "lowfc/request/*"."""

    def get(self, key: str, payload: bytes = b"", timeout_s: float = 1.0) -> list[Sample]:
        """Query a key and return the answers, none if no process answers; BusError for an invalid key or closed bus."""

    def peers(self) -> int:
        """Number of other processes connected to this one."""

    def restart(self) -> None:
        """Give later messages a new start time and count them from 0, as after a camera restarts its frame numbers."""

    def close(self) -> None:
        """Leave the run."""


def last_messages(bus: Bus, topics: Iterable[Topic], timeout_s: float = 1.0) -> Iterator[tuple[Topic, Sample]]:
    """Query the last messages of the queryable `topics` from all publishers, for a process that joins late.

    Health is not queried: it is published twice a second.
    """
    for topic in topics:
        if topic.queryable and topic is not HEALTH:
            for sample in bus.get(topic.at(ALL), timeout_s=timeout_s):
                yield topic, sample


UNREADABLE = (BadMessageError, DecodeError)
"""Exceptions raised by an unreadable message."""


class Faults:
    """Counts exceptions of handlers, and unreadable messages.

    The first exception at each place is printed on standard error with its traceback. Unreadable messages are only
    counted; `take_unreadable` returns and resets the counts.

    Attributes:
        counts: number of exceptions, by place and key.
        unreadable: number of unreadable messages and the last reason, by key.
    """

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.unreadable: dict[str, tuple[int, object]] = {}
        self._lock = threading.Lock()

    def add(self, place: str, key: str, fault: Exception) -> None:
        """Count an unreadable message of `key`, or an exception at `place` (as in "camera: handler of") and `key`."""
        if isinstance(fault, UNREADABLE):
            self.add_unreadable(key, fault)
            return
        location = f"{place} {key}"
        with self._lock:
            previous = self.counts.get(location, 0)
            self.counts[location] = previous + 1
        if not previous:
            text = "".join(traceback.format_exception(fault))
            with contextlib.suppress(OSError):  # for example a full disk: the receive thread must go on
                sys.stderr.write(f"{location}: {text}(further exceptions at this place are only counted)\n")

    def add_unreadable(self, key: str, why: object) -> None:
        """Count an unreadable message by its key or key expression."""
        with self._lock:
            count, _ = self.unreadable.get(key, (0, ""))
            self.unreadable[key] = count + 1, why

    def take_unreadable(self) -> dict[str, tuple[int, object]]:
        """Return the number of unreadable messages and the last reason, by key, and reset them."""
        with self._lock:
            unreadable, self.unreadable = self.unreadable, {}
        return unreadable


def name_in(topic: Topic, key: str) -> str:
    """Name of the mirror or process in a key of this topic; empty for a topic without one."""
    before, placeholder, after = topic.key.partition("{name}")
    return key[len(before) : len(key) - len(after)] if placeholder else ""
