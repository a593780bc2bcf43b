"""The recorder: every message of a run into one log, and an account of those that it did not get.

The bus's threads only append to a bounded queue; the loop here empties it, so that a slow disk costs messages, which
are counted, and never time in the loop.
"""

import importlib.metadata
import os
import platform
import shutil
import subprocess
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from google.protobuf.message import DecodeError

from lowfc import __version__
from lowfc.adapters.bus import ALL, Bus, Sample, name_in
from lowfc.adapters.clock import Clock, HostClock
from lowfc.adapters.envelope import start_of
from lowfc.adapters.ledger import Ledger
from lowfc.adapters.log_writer import Attachment, LogWriter, log_path
from lowfc.adapters.realtime import NOTHING, Granted, step_back
from lowfc.adapters.run import Run
from lowfc.adapters.service import Service
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import HEALTH, TOPICS, Role, Topic, wire

QUEUE_MESSAGES = 20_000
"""Messages that may wait for the disk: about 4 s of a 1 kHz loop, 90 MB."""

_TURN_S = 0.02
_FLUSH_NS = 250_000_000
_SETTLE_S = (0.3, 1.5)
_DRAIN_S = 1.0
_LIBRARIES = ("numpy", "scipy", "eclipse-zenoh", "mcap", "protobuf", "foxglove-schemas-protobuf", "lz4")


@dataclass(frozen=True, slots=True)
class Rotation:
    """When a log is finished and the next one begun."""

    largest_bytes: int = 4 << 30
    longest_s: float = 3600.0


@dataclass(frozen=True, slots=True)
class Summary:
    """What a recorder has done.

    Attributes:
        files: logs, in order.
        messages: recorded, in all of them.
        lost: messages published and not recorded, by topic; only topics that lost some.
        failure: why recording stopped early; empty when it did not.
    """

    files: tuple[Path, ...]
    messages: int
    lost: dict[str, int]
    failure: str


class Recorder:
    """Records a run, from its bus to its logs."""

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        run_id: str,
        folder: Path,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Sequence[Attachment] = (),
        rotation: Rotation = Rotation(),
        granted: Granted = NOTHING,
    ) -> None:
        """Subscribe to everything; recording starts with `run`."""
        self._bus = bus
        self._clock = clock
        self._folder = folder
        self._metadata = metadata
        self._attachments = attachments
        self._rotation = rotation
        self._queue: deque[tuple[Topic, Sample]] = deque()
        self._ledger = Ledger()
        self._kept: dict[str, Sample] = {}
        self._asked: set[tuple[str, int]] = set()
        self._states: dict[tuple[str, int], str] = {}
        self._newcomers = False
        self._log: LogWriter | None = None
        self._files: list[Path] = []
        self._messages = 0
        self._bytes = 0
        self._failure = ""
        self._opened_s = 0.0
        self._flush_due_ns = 0
        # Before the service, which subscribes to Health: who has heard of that has heard of all others.
        for topic in TOPICS:
            bus.subscribe(topic, partial(self._arrived, topic))
        self.service = Service(Role.RECORDER, run_id, clock, bus, granted=granted, fill=self._fill)

    def run(self) -> Summary:
        """Record until told to stop.

        Raises:
            DataFileError: the first log cannot be opened.
        """
        self._settle()
        self._ask()
        self._open()
        self.service.state = "ready"
        while self.service.running:
            self._turn()
            time.sleep(_TURN_S)
        self.service.state = "stopping"
        self._drain()
        summary = self._close()
        self.service.finish()
        return summary

    def _arrived(self, topic: Topic, sample: Sample) -> None:
        """Take a message from the bus's thread; when too many wait it is left out, and the ledger will tell."""
        if len(self._queue) < QUEUE_MESSAGES:
            self._queue.append((topic, sample))

    def _settle(self) -> None:
        """Wait until those who are there already have been heard, so that they can be asked."""
        begun_s = time.monotonic()
        shortest_s, longest_s = _SETTLE_S
        while self.service.running:
            self.service.beat()
            time.sleep(_TURN_S)
            age_s = time.monotonic() - begun_s
            if age_s >= longest_s or (age_s >= shortest_s and len(self.service.heard) >= self._bus.peers()):
                return

    def _ask(self) -> None:
        """Get what was published before this process came: calibration and states."""
        self._newcomers = False
        for topic in TOPICS:
            if topic.queryable and topic is not HEALTH:
                for sample in self._bus.get(topic.at(ALL)):
                    kept = self._kept.get(sample.key)
                    if kept is None or kept.sequence < sample.sequence:
                        self._kept[sample.key] = sample
                        self._asked.add((sample.key, sample.sequence))
                        self._write(sample)

    def _open(self) -> None:
        """Begin a log, with what the messages in it depend on."""
        now_ns = self._clock.host_ns()
        self._log = LogWriter(log_path(self._folder, now_ns), now_ns, self._metadata, self._attachments)
        self._opened_s = time.monotonic()
        self._files.append(self._log.path)
        for sample in self._kept.values():
            self._write(sample)
        self.service.event("RECORDING")

    def _turn(self) -> None:
        """Write what has arrived; now and then flush, report and rotate."""
        for _ in range(len(self._queue)):
            self._take(*self._queue.popleft())
        if self._newcomers and self.service.running:
            self._ask()
        now_ns = self._clock.host_ns()
        if now_ns >= self._flush_due_ns:
            self._flush_due_ns = now_ns + _FLUSH_NS
            self._flush()
            for topic, count in self._ledger.news().items():
                self.service.event("MESSAGES_LOST", topic=topic, count=count)
        self.service.beat()

    def _take(self, topic: Topic, sample: Sample) -> None:
        """Record one message, unless it was recorded when it was asked for."""
        there = (sample.key, sample.sequence)
        recorded = there in self._asked or self._write(sample)
        self._asked.discard(there)
        self._ledger.enter(topic, sample, recorded=recorded)
        if topic is HEALTH:
            self._hear(sample)
        elif topic.queryable:
            self._kept[sample.key] = sample

    def _hear(self, sample: Sample) -> None:
        try:
            health = wire.Health.FromString(sample.payload)
        except DecodeError:
            return  # it is in the log as it came; the service counts it
        self._ledger.believe(sample, health)
        process = (name_in(HEALTH, sample.key), start_of(sample.sequence))
        self._newcomers |= process not in self._states
        self._states[process] = health.state

    def _write(self, sample: Sample) -> bool:
        if self._log is None:
            return False
        try:
            self._log.write(sample)
        except DataFileError as fault:
            self._fail(fault)
            return False
        self._messages += 1
        self.service.work += 1
        return True

    def _flush(self) -> None:
        if self._log is None:
            return
        try:
            self._log.flush()
            full = self._log.bytes_written >= self._rotation.largest_bytes
            if full or time.monotonic() - self._opened_s >= self._rotation.longest_s:
                self._finish_log()
                self._open()
        except DataFileError as fault:
            self._fail(fault)

    def _fail(self, fault: DataFileError) -> None:
        """Give up recording, and nothing else: the process lives, and counts what is lost from here."""
        if self._log is not None:
            self._bytes += self._log.bytes_written
        self._log = None
        self._failure = str(fault)
        self.service.event("RECORDING_FAILED", why=fault)

    def _drain(self) -> None:
        """Wait a while for the last Health of the others, which counts what they sent."""
        deadline_s = time.monotonic() + _DRAIN_S
        while True:
            self._turn()
            latest = {name: state for (name, _), state in sorted(self._states.items()) if name != self.service.name}
            if all(state == "stopped" for state in latest.values()) or time.monotonic() >= deadline_s:
                return
            time.sleep(_TURN_S)

    def _close(self) -> Summary:
        for topic, count in self._ledger.news().items():
            self.service.event("MESSAGES_LOST", topic=topic, count=count)
        self._turn()
        try:
            self._finish_log()
        except DataFileError as fault:
            self._fail(fault)
        return Summary(tuple(self._files), self._messages, self._ledger.lost(), self._failure)

    def _finish_log(self) -> None:
        if self._log is None:
            return
        lost = {f"lost {key}": str(count) for key, count in self._ledger.lost().items()}
        figures = {"messages": str(self._messages), "messages_lost": str(sum(self._ledger.lost().values())), **lost}
        self._log.finish({"recording": figures})
        self._bytes += self._log.path.stat().st_size
        self._log = None

    def _fill(self, health: wire.Health) -> None:
        health.recording.file = str(self._files[-1]) if self._files else ""
        health.recording.messages = self._messages
        health.recording.lost = sum(self._ledger.lost().values())
        health.recording.bytes = self._bytes + (self._log.bytes_written if self._log else 0)


def record(
    run: Run,
    folder: Path,
    *,
    configuration: Path | None = None,
    calibration: Path | None = None,
    seed: int | None = None,
    rotation: Rotation = Rotation(),
    clock: Clock | None = None,
    priority: int | None = None,
) -> Summary:
    """Record a run into `folder` until SIGTERM or SIGINT; the process of `lowfc record`.

    Args:
        run: the run to join.
        folder: where the logs go.
        configuration: TOML file to put into the log.
        calibration: FITS file to put into the log.
        seed: of a simulated run.
        rotation: when a log is finished and the next begun.
        clock: the run's; the host's when None.
        priority: of SCHED_FIFO, below the loop's; None leaves the normal class.

    Raises:
        BusError: another recorder has this run.
        DataFileError: a file cannot be read, or no log can be written in `folder`.
    """
    attachments = [
        _attached(path, media_type)
        for path, media_type in ((configuration, "application/toml"), (calibration, "application/fits"))
        if path is not None
    ]
    granted = step_back(priority)
    clock = HostClock() if clock is None else clock
    bus = ZenohBus(run.links, Role.RECORDER, clock)
    try:
        recorder = Recorder(
            bus,
            clock,
            run.run_id,
            folder,
            metadata={"lowfc": provenance(run.run_id, seed)},
            attachments=attachments,
            rotation=rotation,
            granted=granted,
        )
        recorder.service.catch_signals()
        return recorder.run()
    finally:
        bus.close()


def provenance(run_id: str, seed: int | None) -> dict[str, str]:
    """Versions, host and run, as a log keeps them."""
    found = {
        "lowfc": __version__,
        "python": platform.python_version(),
        "host": platform.node(),
        "kernel": platform.release(),
        "processor": _processor(),
        "processors": str(os.cpu_count()),
        "run": run_id,
        **{library: importlib.metadata.version(library) for library in _LIBRARIES},
    }
    if seed is not None:
        found["seed"] = str(seed)
    if commit := _commit():
        found["git"] = commit
    return found


def _attached(path: Path, media_type: str) -> Attachment:
    try:
        return Attachment(path.name, media_type, path.read_bytes())
    except OSError as fault:
        raise DataFileError(f"{path} cannot be read for the log: {fault.strerror}") from fault


def _processor() -> str:
    with Path("/proc/cpuinfo").open() as lines:
        names = (line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "Model")))
        return next(names, platform.machine())


def _commit() -> str:
    """Commit of the checkout that runs, where it is one and git is there."""
    checkout = Path(__file__).parents[2]
    git = shutil.which("git")
    if git is None or not (checkout / ".git").exists():
        return ""
    done = subprocess.run(  # noqa: S603  # a fixed command
        [git, "-C", str(checkout), "describe", "--always", "--dirty", "--tags"],
        capture_output=True,
        text=True,
        timeout=5,
        check=False,
    )
    return done.stdout.strip()
