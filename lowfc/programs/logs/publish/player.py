"""Republish a log on the bus, at the recorded speed or another, for a viewer, a controller under test or another tool.

Payloads and sequences are those of the log, so that frame, step, command and mirror state can be joined. Publication
times are new, so that no message counts as late. Deadlines are absolute: timing errors do not accumulate.
"""

import contextlib
import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TextColumn

from lowfc.adapters.bus.bus import Publisher, Sample, name_in
from lowfc.adapters.bus.run import Run, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.history import LAST_NS, REORDERING_NS
from lowfc.adapters.logs.parts import WholeLog, titled
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.recovery import faults, missing_parts
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.progress import passing_bar
from lowfc.adapters.process.realtime import Granted, set_up
from lowfc.adapters.process.service import Service
from lowfc.contract.errors import ConfigurationError, DataFileError, nearest
from lowfc.contract.messages import COMMAND, HEALTH, MIRROR_STATE, Role, known_topic
from lowfc.control.durations import Durations
from lowfc.control.loop.wording import counted
from lowfc.programs.logs.publish.selection import PublishedKeys, role_of

BEHIND_NS = 1_000_000
"""Delay beyond which a message counts as published behind its time."""
LONG_WAIT_NS = 10_000_000_000
"""Time to the next message above which the wait is announced."""

_MAX_SLEEP_NS = 100_000_000
_PROGRESS_NS = 200_000_000
_SETTLE_S = 0.5  # programs without a port retry their connection every 0.2 s
_WAIT_FOR_S = 2.0


def publish(
    logs: Sequence[Path],
    run_id: str,
    *,
    speed: float = 1.0,
    topics: Sequence[str] = (),
    allow_commands: bool = False,
    wait_for: Collection[str] = (),
) -> dict[str, Any]:
    """Publish logs on the bus of a run until their end, or until SIGTERM or SIGINT.

    Args:
        logs: files in the order of recording, finished or not.
        run_id: name of the run; created if it does not exist.
        speed: 2 is twice as fast, a large number as fast as possible. Subscribers that do not keep up lose messages, as
            with a live camera.
        topics: keys or shell patterns of keys; if empty, events and all topics, except commands, of those roles of the
            loop that are not live.
        allow_commands: publish commands too, and frames even if they would move a live mirror.
        wait_for: roles that must be running and connected before the first message; their topics are not published.

    Returns:
        Results for `render` and `--json`.
    """
    if not 0 < speed < float("inf"):
        raise ConfigurationError(f"--speed must be above 0 (1: as recorded); got {speed:g}")
    console = Console(stderr=True)
    run = open_run(run_id, _mirror_names(logs[0]))
    for role in wait_for:
        if role not in run.links.ports:
            raise ConfigurationError(
                f"run {run_id!r} has no role {role!r} to wait for{nearest(role, run.links.ports)}; "
                f"it has {', '.join(sorted(run.links.ports))}"
            )
    keys = PublishedKeys(run.links, topics, run.links.live() | set(wait_for), allow_commands=allow_commands)
    granted = set_up(None, None, lock_memory=False, disable_cpu_idle=False)
    with _join(run, keys, granted) as (service, buses):
        console.print(f"publishing in run {run_id!r} as {', '.join(buses)}", highlight=False)
        player = Player(service, buses, keys, speed, console)
        if _wait_for_receivers(service, keys.live, wait_for, console):
            service.state = "running"
        return {"run": run_id, "logs": [str(path) for path in logs], "speed": speed, **player.play(logs)}


class Player:
    """Publishes the messages of logs, each at its due time."""

    def __init__(
        self, service: Service, buses: dict[str, ZenohBus], keys: PublishedKeys, speed: float, console: Console
    ) -> None:
        """Publish `keys` as the roles of `buses` until `service` stops; `console` shows the progress."""
        self._service = service
        self._clock = service.clock
        self._buses = buses
        self._keys = keys
        self._speed = speed
        self._console = console
        self._publishers: dict[str, Publisher | None] = {}
        self._excluded: dict[str, str] = {}
        self._timing_errors = Durations()
        self._behind = 0
        self._first_log_ns = self._last_log_ns = 0
        self._begun_ns = self._sent_ns = 0
        self._initial_keys: set[str] = set()
        self._impossible_times = 0

    def play(self, logs: Sequence[Path]) -> dict[str, Any]:
        """Publish logs one after the other; return what was published, and the timing errors."""
        log, progress_due_ns = WholeLog(logs), 0
        with passing_bar(self._console, TextColumn("{task.description}", markup=False), BarColumn()) as bar:
            task = bar.add_task(titled(log.paths))
            for message in log:
                if not self._service.running:
                    break
                if message.receive_time_ns > LAST_NS:
                    self._impossible_times += 1
                    continue
                self._play(message)
                if self._sent_ns >= progress_due_ns:
                    progress_due_ns = self._sent_ns + _PROGRESS_NS
                    self._service.beat()
                    bar.update(task, completed=log.position, total=log.size, description=_utc(message.receive_time_ns))
        if self._service.running and not self._initial_keys and not self._timing_errors.count:
            left_out = ", ".join(f"{key} ({why})" for key, why in sorted(self._excluded.items()))
            excluded = f"; left out: {left_out}" if left_out else ""
            raise DataFileError(f"{titled(log.paths)}: no message of the selected topics{excluded}")
        p50_ns, p99_ns = self._timing_errors.percentiles_ns(0.5, 0.99)
        return {
            "messages": self._timing_errors.count + len(self._initial_keys),
            "published": {key: one.published for key, one in sorted(self._publishers.items()) if one is not None},
            "left_out": dict(sorted(self._excluded.items())),
            "messages_of_impossible_time": self._impossible_times,
            "span_s": (self._last_log_ns - self._first_log_ns) * 1e-9,
            "took_s": (self._sent_ns - self._begun_ns) * 1e-9,
            "timing_error_us": {"p50": p50_ns / 1e3, "p99": p99_ns / 1e3, "max": self._timing_errors.max_ns / 1e3},
            "messages_behind": self._behind,
            **missing_parts(log),
            "selection": [log.selection.description] if log.selection.description else [],
            "interrupted": not self._service.running,
        }

    def _play(self, message: Sample) -> None:
        if message.key not in self._publishers:
            self._publishers[message.key] = self._publisher(message.key)
        publisher = self._publishers[message.key]
        if publisher is None:
            return
        is_state = publisher.topic.queryable and publisher.topic is not HEALTH
        if is_state and not self._begun_ns and message.key not in self._initial_keys:
            # A log begins with the calibration and the states in force then. They may be old: they are sent at once.
            self._initial_keys.add(message.key)
            publisher.put(message.payload, None, message.sequence)
        elif not is_state and message.receive_time_ns < self._last_log_ns - REORDERING_NS:
            raise DataFileError("a log begins before the previous one ends; name each log once, in order of recording")
        else:
            self._send(publisher, message)

    def _send(self, publisher: Publisher, message: Sample) -> None:
        self._last_log_ns = max(self._last_log_ns, message.receive_time_ns)
        if not self._begun_ns:
            self._first_log_ns = self._last_log_ns
            self._begun_ns = self._sent_ns = self._clock.host_ns()
        due_ns = self._begun_ns + round(min((self._last_log_ns - self._first_log_ns) / self._speed, LAST_NS))
        if (wait_ns := due_ns - self._clock.host_ns()) > LONG_WAIT_NS:
            when = _utc(self._last_log_ns)
            text = f"the next message, of {when}, follows in {wait_ns / 1e9:.0f} s; Ctrl-C ends the publication"
            self._console.print(text, highlight=False)
        self._sleep_until(due_ns)
        if not self._service.running:
            return
        self._sent_ns = publisher.put(message.payload, None, message.sequence).publish_time_ns
        late_ns = self._sent_ns - due_ns
        self._timing_errors.add(abs(late_ns))
        self._behind += late_ns > BEHIND_NS

    def _sleep_until(self, due_ns: int) -> None:
        while (left_ns := due_ns - self._clock.host_ns()) > 0 and self._service.running:
            time.sleep(min(left_ns, _MAX_SLEEP_NS) * 1e-9)
            if left_ns > _MAX_SLEEP_NS:
                self._service.beat()

    def _publisher(self, key: str) -> Publisher | None:
        """Publisher of a key, in its role; None if the key is not published."""
        topic = known_topic(key)
        if topic is None:
            self._excluded[key] = "unknown to this version"
            return None
        if not self._keys.matches(key):
            return None
        if why := self._keys.exclusion_reason(key):
            self._excluded[key] = why
            return None
        bus = self._buses.get(role_of(key)) or next(iter(self._buses.values()))
        return bus.publisher(topic, name_in(topic, key))


def render(results: dict[str, Any]) -> str:
    """Summary as text."""
    error = ", ".join(f"{name} {value:.0f} us" for name, value in results["timing_error_us"].items())
    lines = [
        f"published          {results['messages']} messages in run {results['run']!r}: {results['span_s']:.1f} s of "
        f"log in {results['took_s']:.1f} s" + (", interrupted" if results["interrupted"] else ""),
        f"timing error       {error}",
        f"behind             {results['messages_behind']} messages by more than {BEHIND_NS / 1e6:g} ms",
    ]
    lines += faults(results["damaged"], results["no_end"])
    lines += [f"the log has        {selection}" for selection in results["selection"]]
    lines += [f"left out           {key}: {why}" for key, why in results["left_out"].items()]
    if results["messages_of_impossible_time"]:
        count = counted(results["messages_of_impossible_time"], "message")
        lines.append(f"left out           {count} with a log time after the year 2262")
    return "\n".join(lines)


@contextlib.contextmanager
def _join(run: Run, keys: PublishedKeys, granted: Granted) -> Iterator[tuple[Service, dict[str, ZenohBus]]]:
    """Join the run in the roles of the selected topics, or as `replay` if events are the only topic."""
    with contextlib.ExitStack() as stack:
        clock = HostClock()
        buses: dict[str, ZenohBus] = {}
        for role in keys.roles or (Role.REPLAY,):
            buses[role] = ZenohBus(run.links, role, clock)
            stack.callback(buses[role].close)
        service = Service(Role.REPLAY, run.run_id, clock, next(iter(buses.values())), granted=granted)
        service.catch_signals()
        stack.callback(service.finish)
        yield service, buses


def _wait_for_receivers(service: Service, live: Collection[str], wait_for: Collection[str], console: Console) -> bool:
    """Wait for the processes that receive the first message; False if stopped meanwhile."""
    service.state = "ready"
    missing = service.wait_for(wait_for, _WAIT_FOR_S)
    if missing and service.running:
        console.print(
            f"waiting for {', '.join(missing)} of run {service.run_id!r}; Ctrl-C ends the publication", highlight=False
        )
    while missing and service.running:
        missing = service.wait_for(missing, _WAIT_FOR_S)
    begun_s = time.monotonic()
    service.wait_for(live, _WAIT_FOR_S)  # and not longer, because a user's program may never publish Health
    while service.running and time.monotonic() - begun_s < _SETTLE_S:
        time.sleep(0.02)
    return service.running


def _mirror_names(log: Path) -> tuple[str, ...]:
    """Names of the mirrors in a log, for a new run; in an unfinished log only the first mirror is found."""
    topics = MIRROR_STATE, COMMAND
    reader = LogReader(log, topics=topics, skip_damaged=True)
    next(iter(reader), None)
    names = {name_in(topic, key) for key, _ in reader.channels for topic in topics if topic.matches(key)}
    return tuple(sorted(names)) or ("dm",)


def _utc(time_ns: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(time_ns // 1_000_000_000)) + f".{time_ns // 10**8 % 10}Z"
