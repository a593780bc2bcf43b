"""Connection to a device under test: receives every message, with or without an envelope, and publishes messages."""

import contextlib
import json
import time
from collections import deque
from functools import cached_property
from typing import NamedTuple

import zenoh
from google.protobuf.message import DecodeError
from zenoh.handlers import Callback

from lowfc.adapters.bus.run import Links
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.envelope import Envelope, sequence_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import EVENT, HEALTH, Log, Topic, wire

NS_PER_S = 1_000_000_000
EVERYTHING = "lowfc/**"
_FAILURES = "DRIVER_FAILED", "DRIVER_HANGS"


class Received(NamedTuple):
    """One message as received, valid or not.

    Attributes:
        key: key under which it was published.
        payload: bytes of the message.
        attachment: bytes of the envelope; None without an envelope.
        receive_time_ns: time of arrival on the host's clock.
    """

    key: str
    payload: bytes
    attachment: bytes | None
    receive_time_ns: int

    @property
    def envelope(self) -> Envelope | None:
        """The decoded envelope; None without a valid one."""
        try:
            return None if self.attachment is None else Envelope.decode(self.attachment)
        except BusError:
            return None


class Connection:
    """A session that receives every message of a run; `ZenohBus` would refuse messages without an envelope.

    Attributes:
        offset_ns: the host's clock minus CLOCK_MONOTONIC.
    """

    def __init__(self, links: Links, role: str) -> None:
        """Join a run as `role`; BusError if that fails, for example because another process has this role."""
        self._clock = HostClock()
        self.offset_ns = self._clock.offset_ns
        self._start_s = links.claim_start(role, self._clock.start_s)
        self._waiting: deque[Received] = deque()
        self._counts: dict[str, int] = {}
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(links, role))))
        except zenoh.ZError as fault:
            raise BusError(
                f"cannot join run {links.run_id!r} as {role}: does another process have this role? Stop it first "
                f"(zenoh says: {str(fault).splitlines()[0][:200]})"
            ) from fault
        self._session.declare_subscriber(EVERYTHING, Callback(self._append, indirect=False))

    def now_ns(self) -> int:
        """Time of the host's clock."""
        return self._clock.now_ns()

    def wait(self, seconds: float) -> None:
        """Sleep for `seconds`."""
        time.sleep(seconds)

    def received(self) -> list[Received]:
        """Messages since the last call, on all keys."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def put(self, topic: Topic, name: str, payload: bytes) -> None:
        """Publish a payload with an envelope."""
        key = topic.at(name)
        count = self._counts.get(key, 0)
        self._counts[key] = count + 1
        envelope = Envelope(sequence_of(self._start_s, count), self.now_ns())
        self._session.put(key, payload, attachment=envelope.encode(), priority=zenoh.Priority.REAL_TIME)

    def ask(self, key: str) -> list[Received]:
        """Query the last message under a key; return the replies."""
        return [self._received(reply.ok) for reply in self._session.get(key, timeout=1.0) if reply.ok is not None]

    def peers(self) -> int:
        """Number of connected processes."""
        return len(self._session.info.peers_zid())

    def close(self) -> None:
        """Leave the run."""
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def _append(self, sample: zenoh.Sample) -> None:
        self._waiting.append(self._received(sample))

    def _received(self, sample: zenoh.Sample) -> Received:
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        return Received(str(sample.key_expr), sample.payload.to_bytes(), attachment, self.now_ns())


class CollectedMessages:
    """Messages of a device, in the order of arrival.

    Attributes:
        connection: connection to the device.
        key: key of the device's main topic.
        process: name under which the device publishes its Health.
        messages: all messages.
        seconds: duration of the check; set at the end.
    """

    def __init__(self, connection: Connection, key: str, process: str) -> None:
        """Start to collect; no message is stored before `collect`."""
        self.connection, self.key, self.process = connection, key, process
        self.messages: list[Received] = []
        self.seconds = 0.0

    def collect(self, seconds: float) -> None:
        """Wait, then store the messages that have arrived."""
        self.connection.wait(seconds)
        for message in self.connection.received():
            self.store(message)

    def store(self, message: Received) -> None:
        """Store a message."""
        self.messages.append(message)

    def on(self, key: str) -> list[Received]:
        """Messages under one key."""
        return [message for message in self.messages if message.key == key]

    @property
    def keys(self) -> str:
        """Keys of the messages received, as text."""
        return ", ".join(sorted({message.key for message in self.messages})) or "nothing"

    @property
    def driver_failure(self) -> str:
        """Last failure of the device's driver, or where to find it; empty if the driver has never failed."""
        for message in reversed(self.on(EVENT.key)):
            with contextlib.suppress(DecodeError):
                event = Log.FromString(message.payload)
                if event.name == self.process and event.message.startswith(_FAILURES):
                    return event.message
        for message in reversed(self.on(HEALTH.at(self.process))):
            with contextlib.suppress(DecodeError):
                health = wire.Health.FromString(message.payload)
                warning = health.last_warning
                failure = warning if warning.startswith(_FAILURES) else "see DRIVER_FAILED in its terminal or its log"
                return failure if health.driver_failures else ""
        return ""

    @cached_property
    def published(self) -> list[Received]:
        """Messages of the main topic; cached, so read it only after the last message."""
        return self.on(self.key)

    @cached_property
    def envelopes(self) -> list[Envelope]:
        """Envelopes of the main topic's messages; empty unless all have one."""
        found = [message.envelope for message in self.published]
        return [] if None in found else [envelope for envelope in found if envelope is not None]
