"""A line to a device under test: every message as it came, with or without an envelope, and puts of our own."""

import contextlib
import json
import time
from collections import deque
from typing import Protocol

import zenoh
from zenoh.handlers import Callback

from lowfc.adapters.clock import HostClock
from lowfc.adapters.run import Links
from lowfc.adapters.zenoh_bus import session_config
from lowfc.contract.envelope import Envelope, sequence_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import Topic
from lowfc.programs.conformance.checks import Heard

EVERYTHING = "lowfc/**"


class Line(Protocol):
    """What the checks ask of a bus.

    Attributes:
        offset_ns: what CLOCK_MONOTONIC is short of the epoch, on this host.
    """

    offset_ns: int

    def now_ns(self) -> int:
        """The host's clock."""
        ...

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        ...

    def heard(self) -> list[Heard]:
        """What arrived since the last call, on all keys."""
        ...

    def put(self, topic: Topic, name: str, payload: bytes) -> None:
        """Publish, with an envelope."""
        ...

    def ask(self, key: str) -> list[Heard]:
        """Ask for the last message of a key."""
        ...


class ZenohLine:
    """A session of a run that hears everything; `ZenohBus` would refuse what has no envelope."""

    def __init__(self, links: Links, role: str) -> None:
        """Join a run as `role`.

        Raises:
            BusError: the role's port is taken.
        """
        self._clock = HostClock()
        self.offset_ns = self._clock.offset_ns
        self._start_s = links.claim_start(role, self._clock.start_s)
        self._waiting: deque[Heard] = deque()
        self._counts: dict[str, int] = {}
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(links, role))))
        except zenoh.ZError as fault:
            raise BusError(
                f"cannot join run {links.run_id!r} as its {role}: is one running? Stop it first "
                f"(zenoh says: {str(fault).splitlines()[0][:200]})"
            ) from fault
        self._session.declare_subscriber(EVERYTHING, Callback(self._hear, indirect=False))

    def now_ns(self) -> int:
        """See `Line`."""
        return self._clock.now_ns()

    def wait(self, seconds: float) -> None:
        """See `Line`."""
        time.sleep(seconds)

    def heard(self) -> list[Heard]:
        """See `Line`."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def put(self, topic: Topic, name: str, payload: bytes) -> None:
        """See `Line`."""
        key = topic.at(name)
        count = self._counts.get(key, 0)
        self._counts[key] = count + 1
        envelope = Envelope(sequence_of(self._start_s, count), self.now_ns())
        self._session.put(key, payload, attachment=envelope.encode(), priority=zenoh.Priority.REAL_TIME)

    def ask(self, key: str) -> list[Heard]:
        """See `Line`."""
        replies = self._session.get(key, timeout=1.0)
        return [self._taken(reply.ok) for reply in replies if reply.ok is not None]

    def peers(self) -> int:
        """How many processes are connected."""
        return len(self._session.info.peers_zid())

    def close(self) -> None:
        """Leave the run."""
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def _hear(self, sample: zenoh.Sample) -> None:
        self._waiting.append(self._taken(sample))

    def _taken(self, sample: zenoh.Sample) -> Heard:
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        return Heard(str(sample.key_expr), sample.payload.to_bytes(), attachment, self.now_ns())
