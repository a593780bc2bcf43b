"""The bus between processes: zenoh peers over loopback TCP, each connected to all roles of its run that listen.

Monitors connect by Unix socket and get `latest_only` topics at a lower rate. In a run on several hosts, every process
connects to the router instead. `zenoh_session` and `routed` explain each setting.
"""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import zenoh
from zenoh.handlers import Callback, Handler, RingChannel

from lowfc.adapters.bus.access import CLOCK_KEY, ROUTER
from lowfc.adapters.bus.bus import ALL, Faults, Query, Sample
from lowfc.adapters.bus.direct_link import DirectCall, DirectReader, DirectWriter
from lowfc.adapters.bus.routed import RouterWatch, open_by_router, require_certificate
from lowfc.adapters.bus.run import Links, mirror_role
from lowfc.adapters.bus.zenoh_fault import cause_of, raising_bus_error
from lowfc.adapters.bus.zenoh_session import (
    keep_thread_state,
    prevent_slow_closing,
    receive_in_one_thread,
    session_config,
)
from lowfc.adapters.process.clock import Clock
from lowfc.adapters.process.clock_offset import ClockOffset, ClockQuerier
from lowfc.contract.envelope import Envelope, sequence_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import HEALTH, Role, Topic

ROLE_CHECK_S = 0.5
"""Timeout for an answer of the router, or of another process with the same role as this one."""
FLUSH_S = 2.0
"""Time that a closing session waits for peers that have not received everything yet."""
CLOSE_S = 5.0
"""Time that a closing session waits for a handler that does not return."""


def declare_publisher(session: zenoh.Session, topic: Topic, key: str, *, lockstep: bool = False) -> zenoh.Publisher:
    """Make a zenoh publisher of a topic with the loop's settings; in lockstep it waits for slow readers."""
    return session.declare_publisher(
        key,
        encoding=f"application/protobuf;{topic.message.DESCRIPTOR.full_name}",
        congestion_control=zenoh.CongestionControl.BLOCK if lockstep else zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME if topic.in_loop else zenoh.Priority.DATA,
        # If True, every message is its own batch: a burst of 16 fills the queue and the rest is lost. If False, the
        # latency is the same, as messages are batched only under back-pressure.
        express=False,
    )


class ZenohPublisher:
    """Publishes one topic; see `Publisher`."""

    def __init__(
        self,
        bus: "ZenohBus",
        session: zenoh.Session,
        topic: Topic,
        key: str,
        direct_link: DirectWriter | DirectCall | None,
    ) -> None:
        self.topic = topic
        self.key = key
        self.published = self.skipped = 0
        self.handed_ns = 0
        self.last: tuple[bytes, Envelope] | None = None
        self._host_ns = bus.clock.host_ns
        self._bus = bus
        self._encode = bus.encode
        self._publisher = declare_publisher(session, topic, key, lockstep=bus.clock.lockstep)
        self._direct_link = direct_link
        if topic.queryable:
            session.declare_queryable(key, Callback(self._answer, indirect=False))

    def put(self, payload: bytes, publish_time_ns: int | None = None, sequence: int | None = None) -> Envelope:
        """Send `payload`; wait at most 1 ms for a slow reader, which then loses the message; in lockstep, longer."""
        envelope = Envelope(
            sequence_of(self._bus.start_s, self.published) if sequence is None else sequence,
            self._host_ns() if publish_time_ns is None else publish_time_ns,
        )
        self.published += 1
        if self.topic.queryable:
            self.last = (payload, envelope)
        handed = self._direct_link is not None and self._direct_link.send(envelope.encode(), payload)
        if handed:
            self.handed_ns = self._host_ns()
        self._publisher.put(payload, attachment=self._encode(envelope))
        if not handed:
            self.handed_ns = self._host_ns()
        return envelope

    def close(self) -> None:
        """Release resources other than zenoh's."""
        if self._direct_link is not None:
            self._direct_link.close()

    def _answer(self, query: zenoh.Query) -> None:
        with self._bus.replying(query):
            if self.last is not None:
                payload, envelope = self.last
                query.reply(self.key, payload, attachment=self._encode(envelope))


class ZenohRing:
    """Ring buffer of a zenoh subscriber; see `Ring`."""

    def __init__(self, bus: "ZenohBus", subscriber: "zenoh.Subscriber[Handler[zenoh.Sample]]") -> None:
        self._bus, self._subscriber = bus, subscriber
        self._expression = str(subscriber.key_expr)
        self._key = _single_key(self._expression)

    def drain(self) -> list[Sample]:
        """See `Ring.drain`."""
        samples: list[Sample] = []
        now_ns = self._bus.clock.host_ns()
        with raising_bus_error(self._expression):
            while (sample := self._subscriber.try_recv()) is not None:
                try:
                    samples.append(self._bus.read(sample, now_ns, self._key))
                except Exception as fault:
                    self._bus.faults.add(f"{self._bus.role}: ring of", self._expression, fault)
        return samples

    def close(self) -> None:
        """See `Ring.close`."""
        with contextlib.suppress(zenoh.ZError):
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]


class ZenohBus:
    """One process's zenoh session; see `Bus`. After `close`, rings and methods with a topic or key raise BusError.

    Attributes:
        offset: offset of the router's clock, in a run on several hosts. Envelopes on the network have the router's
            time; those that `put` returns, and the samples that handlers get, have this host's time.
        read: converts a message of zenoh to a `Sample`.
        direct_readers: readers of the topics that this process receives over a direct link, by key.
    """

    def __init__(
        self, links: Links, role: str, clock: Clock, *, monitor: bool = False, beside: "ZenohBus | None" = None
    ) -> None:
        """Join a run.

        Args:
            links: endpoints and shared secret of the run.
            role: role of this process.
            clock: clock of the run.
            monitor: whether this process is a monitor; set it in a process's first bus. A monitor polls `Ring`s. It
                saves half the processor time by display rate (`latest_only`), one receive thread and a pool of buffers.
            beside: bus of another role in this process, already subscribed: the direct link to it is a function call.

        Raises:
            BusError: the role's port is in use, or the role runs on another host; zenoh opens no session; or the
                router refuses the certificate, or cannot be reached although it runs (an absent one is
                waited for).
            DataFileError: the run's secret is missing or damaged; across hosts, the role has no valid certificate.
        """
        self.role = role
        self._links = links
        self._closers: list[Callable[[], None]] = []
        self._publishers: list[ZenohPublisher] = []
        self.direct_readers: dict[str, DirectReader] = {}
        self._beside = beside
        self.clock = clock
        self.faults = Faults()
        self.offset: ClockOffset | None = None
        self.read = _sample
        self.start_s = links.claim_start(role, clock.start_s)
        if monitor:
            receive_in_one_thread()
        if links.network.router:
            require_certificate(links.network, role)
        config = zenoh.Config.from_json5(json.dumps(session_config(links, role, monitor=monitor)))
        if links.network.router and role != ROUTER:
            self._session = open_by_router(config, links.network, role)
            prevent_slow_closing(self._session)
            self._join_hosts()
            return
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as fault:
            what = f"{role} of run {links.run_id!r} cannot join"
            if role in {*links.ports, ROUTER}:
                own_port = f"127.0.0.1:{links.ports.get(role)}"
                address = own_port if role != ROUTER else links.network.listen or links.network.router
                advice = "is one running already? Stop that process, or start another run"
                what = f"{role} of run {links.run_id!r} cannot listen on {address}; {advice}"
            raise BusError(f"{what} ({cause_of(fault)})") from None
        prevent_slow_closing(self._session)
        if role == ROUTER:
            self.queryable(CLOCK_KEY, lambda query: query.reply(b""))

    def _join_hosts(self) -> None:
        """Refuse a role that is already in use (ports prevent it on one host); use the router's clock in envelopes."""
        if self.role in self._links.ports and self.get(HEALTH.at(self.role), timeout_s=ROLE_CHECK_S):
            self._session.close()  # type: ignore[no-untyped-call]
            raise BusError(
                f"run {self._links.run_id!r} has a {self.role} already, on this host or another; stop it first"
            )
        self.offset = ClockOffset()
        self.read = partial(_sample_across_hosts, self.offset)
        self._router = RouterWatch(self._links.network, self.role)
        self._closers.append(ClockQuerier(self.offset, self._query_time, self.clock.host_ns).close)

    def _query_time(self) -> list[tuple[int, int]]:
        self._router.update(linked=bool(self._session.info.routers_zid()))
        answers = self.get(CLOCK_KEY, timeout_s=ROLE_CHECK_S)
        return [(answer.publish_time_ns, answer.receive_time_ns) for answer in answers]

    def publisher(self, topic: Topic, name: str = "") -> ZenohPublisher:
        """See `Bus.publisher`."""
        key = topic.at(name)
        with raising_bus_error(key):
            publisher = ZenohPublisher(self, self._session, topic, key, self._direct_writer(topic, name, key))
        self._closers.append(publisher.close)
        self._publishers.append(publisher)
        return publisher

    def subscribe(self, topic: Topic, handler: Callable[[Sample], None], name: str = ALL) -> Callable[[], None]:
        """See `Bus.subscribe`; `handler` runs on receive threads, over a direct link one call at a time."""
        if _reader(topic, name) != self.role or (path := self._direct_link(topic, name)) is None:
            return self._subscribe(topic, handler, name)
        key = topic.at(name)
        reader = DirectReader(
            path,
            key,
            handler,
            lambda by_bus: self._subscribe(topic, by_bus, name),
            self.clock.host_ns,
            lambda fault: self.faults.add(f"{self.role}: handler of", key, fault),
            shared=topic.multiple_publishers,
        )
        self.direct_readers[key] = reader
        self._closers.append(reader.close)
        return reader.close

    def _subscribe(self, topic: Topic, handler: Callable[[Sample], None], name: str) -> Callable[[], None]:
        key, host_ns, faults, read = topic.at(name), self.clock.host_ns, self.faults, self.read
        single_key = _single_key(key)

        def received(sample: zenoh.Sample) -> None:
            now_ns = host_ns()
            keep_thread_state()
            try:
                handler(read(sample, now_ns, single_key))
            except Exception as fault:  # zenoh would only print it; count it here
                faults.add(f"{self.role}: handler of", key, fault)

        with raising_bus_error(key):
            return self._session.declare_subscriber(key, Callback(received, indirect=False)).undeclare

    def ring(self, topic: Topic, capacity: int) -> "ZenohRing":
        """See `Bus.ring`; zenoh's threads keep the messages without waking Python."""
        with raising_bus_error(topic.at(ALL)):
            return ZenohRing(self, self._session.declare_subscriber(topic.at(ALL), RingChannel(capacity)))

    def queryable(self, key_expression: str, handler: Callable[[Query], None]) -> None:
        """See `Bus.queryable`."""

        def queried(query: zenoh.Query) -> None:
            key = str(query.key_expr)
            try:
                payload = b"" if query.payload is None else query.payload.to_bytes()
                handler(Query(key, payload, self._replier(query, key)))
            except Exception as fault:
                query.drop()  # type: ignore[no-untyped-call]
                self.faults.add(f"{self.role}: queryable of", key, fault)

        with raising_bus_error(key_expression):
            self._session.declare_queryable(key_expression, Callback(queried, indirect=False))

    def get(
        self, key: str, payload: bytes = b"", timeout_s: float = 1.0, priority: zenoh.Priority = zenoh.Priority.DATA
    ) -> list[Sample]:
        """See `Bus.get`."""
        answers: list[Sample] = []
        done = threading.Event()

        def answered(reply: zenoh.Reply) -> None:
            if reply.ok is None:  # a timeout
                return
            try:
                answers.append(self.read(reply.ok, self.clock.host_ns()))
            except Exception as fault:
                self.faults.add(f"{self.role}: answer to", key, fault)

        with raising_bus_error(key):  # the key may be invalid
            self._session.get(
                key,
                Callback(answered, done.set, indirect=False),
                payload=payload,
                timeout=timeout_s,
                priority=priority,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                # A query with a payload, a request, waits for room in the queue: a large one would be lost otherwise.
                congestion_control=zenoh.CongestionControl.BLOCK if payload else zenoh.CongestionControl.DROP,
            )
        done.wait(timeout_s + 1.0)
        return list(answers)

    def encode(self, envelope: Envelope) -> bytes:
        """Encode an outgoing envelope: across hosts, with the router's time."""
        if self.offset is None:
            return envelope.encode()
        return Envelope(envelope.sequence, envelope.publish_time_ns + self.offset.offset_ns).encode()

    def peers(self) -> int:
        """See `Bus.peers`; across hosts, only the router is counted."""
        return len(self._session.info.peers_zid()) + len(self._session.info.routers_zid())

    def restart(self) -> None:
        """See `Bus.restart`."""
        self.start_s = self._links.claim_start(self.role, max(self.clock.host_ns() // 10**9, self.start_s + 1))
        for publisher in self._publishers:
            publisher.published = publisher.skipped = 0

    def close(self) -> None:
        """Leave the run; a role with a port first waits until its messages have been received, or the peers time out.

        A closing zenoh session interrupts the write of a message; a slow reader then gets half a message and loses the
        rest of the stream. A query of the lowest priority is sent last: its answer shows that all was sent.
        """
        if self.role in self._links.ports:
            with contextlib.suppress(BusError):  # already closed
                self.get(HEALTH.at(ALL), timeout_s=FLUSH_S, priority=zenoh.Priority.BACKGROUND)
        for close in self._closers:
            close()
        closing = threading.Thread(target=self._close_session, daemon=True)
        closing.start()
        closing.join(CLOSE_S)

    def _close_session(self) -> None:
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def _direct_writer(self, topic: Topic, name: str, key: str) -> DirectWriter | DirectCall | None:
        if self.role.partition("-")[0] not in topic.publishers or (path := self._direct_link(topic, name)) is None:
            return None
        reader = None if self._beside is None else self._beside.direct_readers.get(key)
        return DirectWriter(path) if reader is None else DirectCall(reader)

    def _direct_link(self, topic: Topic, name: str) -> Path | None:
        reader = _reader(topic, name)
        return None if reader is None else self._links.direct_link(reader)

    @contextlib.contextmanager
    def replying(self, query: zenoh.Query) -> Iterator[None]:
        """Finish a query, answered or not, so that its sender does not wait; a fault is only counted."""
        try:
            yield
        except Exception as fault:
            self.faults.add(f"{self.role}: queryable of", str(query.key_expr), fault)
        finally:
            query.drop()  # type: ignore[no-untyped-call]

    def _replier(self, query: zenoh.Query, key: str) -> Callable[[bytes], None]:
        def reply(body: bytes) -> None:
            with self.replying(query):
                envelope = Envelope(sequence_of(self.start_s, 0), self.clock.host_ns())
                query.reply(key, body, attachment=self.encode(envelope))

        return reply


def _reader(topic: Topic, name: str) -> str | None:
    """Role of the direct subscriber of a topic; None if it has none."""
    return mirror_role(name) if topic.direct_subscriber is Role.MIRROR else topic.direct_subscriber


def _single_key(expression: str) -> str | None:
    """Key of an expression without wildcard, otherwise None."""
    return None if ALL in expression else expression


def _sample(sample: zenoh.Sample, receive_time_ns: int, key: str | None = None) -> Sample:
    attachment = sample.attachment
    sequence, publish_time_ns = Envelope.decode_checked(b"" if attachment is None else attachment.to_bytes())
    return Sample(
        str(sample.key_expr) if key is None else key,
        sample.payload.to_bytes(),
        sequence,
        publish_time_ns,
        receive_time_ns,
    )


def _sample_across_hosts(
    offset: ClockOffset, sample: zenoh.Sample, receive_time_ns: int, key: str | None = None
) -> Sample:
    """As `_sample`, across hosts: the publish time converted to this host's clock."""
    received = _sample(sample, receive_time_ns, key)
    return received._replace(publish_time_ns=received.publish_time_ns - offset.offset_ns)
