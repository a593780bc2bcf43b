"""Common tasks of every process of a run: stop at a signal, publish Health and events, receive others' Health."""

import contextlib
import os
import platform
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from math import inf
from types import FrameType
from typing import Literal

from lowfc import __version__
from lowfc.adapters.bus.bus import ALL, UNREADABLE, Bus, Publisher, Sample
from lowfc.adapters.bus.dispatch import Dispatch
from lowfc.adapters.bus.mailbox import Mailbox
from lowfc.adapters.bus.names import Names
from lowfc.adapters.process.clock import WALL_TOLERANCE_NS, Clock
from lowfc.adapters.process.host import resident_bytes
from lowfc.adapters.process.realtime import NOTHING, Granted
from lowfc.adapters.process.supervision import Supervisor
from lowfc.adapters.process.work_rate import WorkRate
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import BusError
from lowfc.contract.events import EVENTS, Level
from lowfc.contract.messages import EVENT, HEALTH, Log, Role, Topic, timestamp, wire
from lowfc.contract.sequence_gaps import Arrivals
from lowfc.control.loop.wording import counted

HEALTH_PERIOD_NS = 500_000_000
WAITING_NS = 2_000_000_000
"""A ready process that announces its state and waits longer than this for others prints their names."""
MAX_PRINTED, PRINTED_PERIOD_NS = 10, 10_000_000_000
"""Largest number of warnings of one kind printed on standard error within this time, ns; all are in the log."""
WORK: dict[str, str] = {Role.CAMERA: "frame", Role.CONTROLLER: "frame", Role.MIRROR: "command"}
"""What `Service.work` counts in the processes of the loop; other processes have their own summary."""
ProcessState = Literal["starting", "ready", "running", "stopping", "stopped"]

_POLL_S = 0.02


class Service:
    """One process of a run.

    Attributes:
        name: name of the process, such as "camera" or "mirror-dm".
        running: True until SIGTERM, SIGINT or `stop`.
        why: cause of the end, once it is stopped.
        work: number of frames, commands, messages or snapshots processed; `rate_hz` in Health is its rate.
        last_health: newest Health of every other process, by name.
        announces: whether it prints on standard error that it is ready or stopped, and which processes it waits for.
        awaited: function that returns the names of the processes it waits for, as text; empty if none.
    """

    def __init__(
        self,
        name: str,
        run_id: str,
        clock: Clock,
        bus: Bus,
        *,
        granted: Granted = NOTHING,
        at_ready: Callable[[], Granted] | None = None,
        fill: Callable[[wire.Health], None] | None = None,
        announces: bool = False,
        supervisor: Supervisor | None = None,
    ) -> None:
        """Join the run.

        Args:
            name: name of the process.
            run_id: identifier of the run.
            clock: clock of the run.
            bus: bus of the process.
            granted: real-time measures requested before the bus was opened.
            at_ready: requests further measures once the process is ready; a refusal (older kernels) gives no event.
            fill: adds the role's own fields to each Health.
            announces: as the attribute.
            supervisor: service manager; by default the one that the environment names.
        """
        self.name = name
        self.clock = clock
        self.bus = bus
        self.running = True
        self.why = "finished"
        self.work = 0
        self.last_health: dict[str, wire.Health] = {}
        self.publishers: list[Publisher] = []
        self.arrivals: list[Arrivals] = []
        self.run_id = run_id
        self._granted = granted
        self._at_ready = at_ready
        self._host = platform.node()
        self.fill = fill
        self.announces = announces
        self.awaited: Callable[[], str] = lambda: ""
        self._check_waiting_ns: float = inf
        self._state: ProcessState = "starting"
        self._fault: Exception | None = None
        self._names = Names()
        self._starts: dict[str, int] = {}  # by name, not by id: in containers a restarted process has its former id
        self._known_starts: dict[str, int] = {}
        self._wakers: list[Callable[[], None]] = []
        self._event_lock = threading.Lock()
        self._last_warning: Log | None = None
        self._warned: dict[str, tuple[int, int]] = {}
        self._supervisor = supervisor or Supervisor()
        self._started_ns = clock.host_ns()
        self._work_rate = WorkRate()
        self._due_ns = 0
        self._events = self.publisher(EVENT)
        self._health = self.publisher(HEALTH, name)
        bus.subscribe(HEALTH, self._received_health)
        self.event("STARTED", process=name, version=__version__)
        if abs(ahead_ns := clock.ahead_ns()) > WALL_TOLERANCE_NS:
            self.event("CLOCK_OFF", ahead_ms=ahead_ns / 1e6)
        for measure, cost in granted.refused:
            self.event("REALTIME_REFUSED", measure=measure, cost=cost)

    def publisher(self, topic: Topic, name: str = "") -> Publisher:
        """Publisher of a topic, counted in Health."""
        publisher = self.bus.publisher(topic, name)
        self.publishers.append(publisher)
        return publisher

    def mailbox(self, topic: Topic, name: str = "") -> Mailbox:
        """Mailbox that receives a topic, counted in Health and woken by `stop`."""
        mailbox = Mailbox(topic.at(name))
        self.arrivals.append(mailbox)
        self.on_stop(mailbox.wake)
        self.bus.subscribe(topic, mailbox.put, name or ALL)
        return mailbox

    def dispatch(
        self,
        topic: Topic,
        handler: Callable[[Sample], None],
        name: str = "",
        *,
        period_ns: int,
        superseded: Callable[[Sample], None] | None = None,
    ) -> Callable[[], None]:
        """Handle a topic's messages on the receive thread, counted in Health; the returned function unsubscribes.

        An exception of the handler stops the process and `finish` raises it again, except for an unreadable message.
        `period_ns` and `superseded` are as for `Dispatch`; in lockstep no message is superseded.
        """

        def guarded(handle: Callable[[Sample], None]) -> Callable[[Sample], None]:
            def guard(sample: Sample) -> None:
                try:
                    handle(sample)
                except UNREADABLE as fault:
                    self.unreadable(sample.key, fault)
                except Exception as fault:
                    self._fault = fault
                    self.stop(f"the handler of {topic.at(name)} failed")

            return guard

        dispatch = Dispatch(
            topic.at(name),
            guarded(handler),
            self.clock.host_ns,
            None if self.clock.lockstep else period_ns,
            None if superseded is None else guarded(superseded),
        )
        self.arrivals.append(dispatch)
        return self.bus.subscribe(topic, dispatch.put, name or ALL)

    def has_newcomers(self) -> bool:
        """Whether a process has joined, or one other than a viewer has restarted, since the last call."""
        before, self._known_starts = self._known_starts, dict(self._starts)
        return before != self._known_starts

    def catch_signals(self) -> None:
        """Stop at SIGTERM and SIGINT; a SIGINT while stopping ends the process at once. Main thread only."""
        signal.signal(signal.SIGTERM, self._caught)
        signal.signal(signal.SIGINT, self._caught)

    def on_stop(self, waker: Callable[[], None]) -> None:
        """Call `waker` when the process is stopped, to end a wait of its loop."""
        self._wakers.append(waker)

    def stop(self, why: str) -> None:
        """Stop the process: `running` becomes False."""
        if self.running:
            self.why = why
            self.running = False
            self._supervisor.stopping()
        for waker in self._wakers:
            waker()

    @property
    def state(self) -> ProcessState:
        """State of the process, as in Health; setting it publishes Health immediately."""
        return self._state

    @state.setter
    def state(self, state: ProcessState) -> None:
        was_starting = self._state == "starting"
        if state == "ready" and was_starting and self._at_ready is not None:
            self._granted = replace(self._granted, granted=self._granted.granted + self._at_ready().granted)
        self._state = state
        self._send_health(self.clock.host_ns())
        if state in ("ready", "running"):
            self._supervisor.ready()
            if was_starting:
                self._check_waiting_ns = self.clock.host_ns() + WAITING_NS
                self._announce("ready")
        elif state in ("stopping", "stopped"):
            self._supervisor.stopping()

    def beat(self, *, alive: bool = True) -> None:
        """Publish Health when due, twice a second, and send the watchdog signal to the service manager if `alive`.

        Call it often, and only on the thread that does the process's work, as the watchdog must notice if it hangs.
        """
        now_ns = self.clock.host_ns()
        if alive:
            self._supervisor.alive(now_ns)
        if self._check_waiting_ns <= now_ns:
            self._check_waiting_ns = inf
            if awaited := self.awaited():
                self._announce(f"waiting for {awaited}")
        if now_ns >= self._due_ns:
            self._send_health(now_ns)

    def finish(self) -> None:
        """Publish a final Health, with all counts, as the last message, or raise the exception of a failed handler."""
        if self._fault is not None:
            raise self._fault
        self._report_unreadable()
        self.event("STOPPED", process=self.name, why=self.why)
        if noun := WORK.get(self.name.partition("-")[0]):
            self._announce(f"stopped after {counted(self.work, noun)}: {self.why}")
        self.state = "stopped"

    def event(self, event: str, **details: object) -> None:
        """Publish an event of the table; callable from any thread.

        Errors and warnings are also printed on standard error; warnings of one kind at most `MAX_PRINTED` times within
        `PRINTED_PERIOD_NS`.
        """
        kind = EVENTS[event]
        log = kind.log(self.name, self.clock.now_ns(), **details)
        with self._event_lock:
            self._events.put(log.SerializeToString())
        if kind.level >= Level.WARNING:
            self._last_warning, now_ns = log, self.clock.host_ns()
            since_ns, count = self._warned.get(event, (now_ns, 0))
            if now_ns - since_ns >= PRINTED_PERIOD_NS:
                since_ns, count = now_ns, 0
            self._warned[event] = since_ns, count + 1
            if count < MAX_PRINTED or kind.level > Level.WARNING:
                self._print(log.message)
            elif count == MAX_PRINTED:
                self._print(f"{event} recurs: more within {PRINTED_PERIOD_NS // 10**9} s are in the log only")

    def _announce(self, what: str) -> None:
        if self.announces:
            self._print(f"{what} (run {self.run_id})")

    def _print(self, line: str) -> None:
        with contextlib.suppress(OSError, ValueError):  # a closed terminal or a full disk must not end the process
            if select.select((), (2,), (), 0)[1]:  # nor may a stopped terminal (Ctrl-S) or a full pipe block it
                sys.stderr.write(f"{self.name}: {line}\n")

    def unreadable(self, key: str, why: object) -> None:
        """Count an unreadable message; each Health reports new ones in one event. Callable from any thread."""
        self.bus.faults.add_unreadable(key, why)

    def wait_for(self, names: Iterable[str], timeout_s: float) -> tuple[str, ...]:
        """Wait until these processes are ready and have received this one's Health, so that they get its first message.

        Set `state` to "ready" before: others may be waiting for this process.

        Returns:
            Names of those that were not ready in time, or when this process was stopped; empty if all were ready.
        """
        awaited = tuple(names)
        deadline_s = time.monotonic() + timeout_s
        self.awaited = lambda: ", ".join(name for name in awaited if not self._connected(name))
        while missing := tuple(name for name in awaited if not self._connected(name)):
            if not self.running or time.monotonic() >= deadline_s:
                return missing
            self.beat()
            time.sleep(_POLL_S)
        return ()

    def require(self, names: Iterable[str], timeout_s: float, consequence: str) -> None:
        """Wait for these processes as `wait_for` does.

        BusError, with the `consequence`, if one is not ready in time, unless this process has been stopped.
        """
        missing = self.wait_for(names, timeout_s)
        if missing and self.running:
            raise BusError(f"no sign of {', '.join(missing)} after {timeout_s:g} s; {consequence}")

    def health(self) -> wire.Health:
        """Present Health of the process."""
        now_ns = self.clock.host_ns()
        message = wire.Health(
            timestamp=timestamp(now_ns),
            process=self.name,
            state=self._state,
            run_id=self.run_id,
            pid=os.getpid(),
            host=self._host,
            version=__version__,
            memory_bytes=resident_bytes(),
            rate_hz=self._work_rate.update(now_ns, self.work),
            peers_alive=sorted(self.last_health),
            realtime_granted=self._granted.granted,
            realtime_refused=[f"{measure}: {cost}" for measure, cost in self._granted.refused],
            clock_offset_ns=self.clock.offset_ns,
            uptime_ns=now_ns - self._started_ns,
            topics=[*map(self._sent, self.publishers), *map(_received, self.arrivals)],
        )
        if (warning := self._last_warning) is not None:
            message.last_warning = warning.message
            message.last_warning_timestamp.CopyFrom(warning.timestamp)
        if self.bus.offset is not None and (exchange := self.bus.offset.best) is not None:
            message.router_offset_ns, message.router_round_trip_ns = exchange
        if self.fill:
            self.fill(message)
        return message

    def _sent(self, publisher: Publisher) -> wire.TopicCount:
        own = publisher is self._health  # the Health that reports this count is included
        published = publisher.published + own
        return wire.TopicCount(topic=publisher.key, published=published, missing=publisher.skipped)

    def _report_unreadable(self) -> None:
        for key, (count, why) in self.bus.faults.take_unreadable().items():
            self.event("BAD_MESSAGE", count=count, topic=key, why=why)

    def _send_health(self, now_ns: int) -> None:
        self._due_ns = now_ns + HEALTH_PERIOD_NS
        self._report_unreadable()
        message = self.health()
        self._health.put(message.SerializeToString())
        self._supervisor.send_status(message)

    def _received_health(self, sample: Sample) -> None:
        name, health = self._names.health(sample.key, sample.payload)
        if name == self.name:
            return
        self.last_health[name] = health
        start_s = start_of(sample.sequence)
        # Several viewers may share their name, so that the start under this name alternates.
        if name not in self._starts or (self._starts[name] != start_s and name != Role.VIEWER):
            self._starts[name] = start_s
            self._due_ns = 0  # publish Health at the next beat, so that a newcomer does not wait for it

    def _connected(self, name: str) -> bool:
        health = self.last_health.get(name)
        return health is not None and health.state in ("ready", "running") and self.name in health.peers_alive

    def _caught(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and not self.running:
            os._exit(128 + number)
        self.stop(signal.Signals(number).name)


def _received(arrivals: Arrivals) -> wire.TopicCount:
    return wire.TopicCount(
        topic=arrivals.key,
        received=arrivals.received,
        skipped=arrivals.skipped,
        missing=arrivals.missing,
        last_sequence=arrivals.last_sequence,
    )
