"""A line to a device under test: every message as it came, with or without an envelope, and puts of our own."""

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
from lowfc.contract.messages import HEALTH, Topic, wire

NS = 1_000_000_000
EVERYTHING = "lowfc/**"


class Received(NamedTuple):
    """One message as it arrived, whatever is wrong with it.

    Attributes:
        key: where it was published.
        payload: its bytes.
        attachment: what should be its envelope; None without one.
        receive_time_ns: when it was received, by the host's clock.
    """

    key: str
    payload: bytes
    attachment: bytes | None
    receive_time_ns: int

    @property
    def envelope(self) -> Envelope | None:
        """Its envelope; None where it has none that can be read."""
        try:
            return None if self.attachment is None else Envelope.decode(self.attachment)
        except BusError:
            return None


class Line:
    """A session of a run that receives everything; `ZenohBus` would refuse what has no envelope.

    Attributes:
        offset_ns: what CLOCK_MONOTONIC is short of the epoch, on this host.
    """

    def __init__(self, links: Links, role: str) -> None:
        """Join a run as `role`; BusError where the role's port is taken."""
        self._clock = HostClock()
        self.offset_ns = self._clock.offset_ns
        self._start_s = links.claim_start(role, self._clock.start_s)
        self._waiting: deque[Received] = deque()
        self._counts: dict[str, int] = {}
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(links, role))))
        except zenoh.ZError as fault:
            raise BusError(
                f"cannot join run {links.run_id!r} as its {role}: is one running? Stop it first "
                f"(zenoh says: {str(fault).splitlines()[0][:200]})"
            ) from fault
        self._session.declare_subscriber(EVERYTHING, Callback(self._keep, indirect=False))

    def now_ns(self) -> int:
        """The host's clock."""
        return self._clock.now_ns()

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        time.sleep(seconds)

    def received(self) -> list[Received]:
        """Messages since the last call, on all keys."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def put(self, topic: Topic, name: str, payload: bytes) -> None:
        """Publish, with an envelope."""
        key = topic.at(name)
        count = self._counts.get(key, 0)
        self._counts[key] = count + 1
        envelope = Envelope(sequence_of(self._start_s, count), self.now_ns())
        self._session.put(key, payload, attachment=envelope.encode(), priority=zenoh.Priority.REAL_TIME)

    def ask(self, key: str) -> list[Received]:
        """Ask for the last message of a key."""
        return [self._received(reply.ok) for reply in self._session.get(key, timeout=1.0) if reply.ok is not None]

    def peers(self) -> int:
        """How many processes are connected."""
        return len(self._session.info.peers_zid())

    def close(self) -> None:
        """Leave the run."""
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def _keep(self, sample: zenoh.Sample) -> None:
        self._waiting.append(self._received(sample))

    def _received(self, sample: zenoh.Sample) -> Received:
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        return Received(str(sample.key_expr), sample.payload.to_bytes(), attachment, self.now_ns())


class Collected:
    """Messages of a device, in the order of arrival.

    Attributes:
        line: to the device.
        key: of its main topic.
        process: name under which it publishes its Health.
        messages: all of them.
        seconds: for how long; set at the end.
    """

    def __init__(self, line: Line, key: str, process: str) -> None:
        """Begin to look at a device."""
        self.line, self.key, self.process = line, key, process
        self.messages: list[Received] = []
        self.seconds = 0.0

    def collect(self, seconds: float) -> None:
        """Wait, and take what has arrived."""
        self.line.wait(seconds)
        for message in self.line.received():
            self.take(message)

    def take(self, message: Received) -> None:
        """Keep a message."""
        self.messages.append(message)

    def on(self, key: str) -> list[Received]:
        """Messages under one key."""
        return [message for message in self.messages if message.key == key]

    @property
    def keys(self) -> str:
        """Keys under which something came, in words."""
        return ", ".join(sorted({message.key for message in self.messages})) or "nothing"

    @property
    def failing(self) -> str:
        """What the device's process says of a driver that fails; empty where it does not, or says nothing."""
        for message in reversed(self.on(HEALTH.at(self.process))):
            with contextlib.suppress(DecodeError):
                health = wire.Health.FromString(message.payload)
                return health.last_warning if health.driver_failures else ""
        return ""

    @cached_property
    def published(self) -> list[Received]:
        """Messages of the main topic; for when all have been collected."""
        return self.on(self.key)

    @cached_property
    def envelopes(self) -> list[Envelope]:
        """Their envelopes; none unless all have one."""
        found = [message.envelope for message in self.published]
        return [] if None in found else [envelope for envelope in found if envelope is not None]
