"""The recorder: writes the messages of a run into logs and counts those that it did not receive.

The bus's threads only append to a bounded queue, which the recorder's own loop empties: a slow disk costs messages,
which are counted, but never delays the control loop. A disk error ends the recording and nothing else.
"""

import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import partial
from pathlib import Path
from types import FrameType

from lowfc.adapters.bus.backlog import Backlog
from lowfc.adapters.bus.bus import ALL, UNREADABLE, Bus, Query, Sample
from lowfc.adapters.bus.names import MAX_HEALTH_LOGS
from lowfc.adapters.logs.loss_account import LossAccount
from lowfc.adapters.logs.selection import EVERYTHING, Selection
from lowfc.adapters.logs.series import STANDARD, LogLimits, LogSeries, shortage
from lowfc.adapters.logs.writer import Attachment
from lowfc.adapters.process.clock import Clock
from lowfc.adapters.process.realtime import NOTHING, Granted
from lowfc.adapters.process.service import Service
from lowfc.contract.errors import BadMessageError, DataFileError
from lowfc.contract.messages import EVENT, HEALTH, RECORD_KEY, TOPICS, Role, Topic, timestamp, wire
from lowfc.contract.printable import encodable
from lowfc.programs.core.recording.peers import Peers
from lowfc.programs.core.recording.summary import Summary
from lowfc.programs.core.recording.volume import growth_in_words

QUEUE_MESSAGES = 20_000
"""Largest number of messages waiting for the disk: about 4 s of a 1 kHz loop, 90 MB."""
QUEUE_BYTES = 256_000_000
"""Largest total size of payloads waiting for the disk."""
MAX_CHANNELS = 4096
"""Number of channels after which the next file is begun: each start of a publisher adds one, which costs memory."""

_ITERATION_S = 0.02
_FLUSH_NS = 250_000_000
_SETTLE_S = (0.3, 1.5)  # shortest and longest wait for the Health of the other processes
_DRAIN_S = 1.0
_SLOW_NS = 1_000_000_000  # duration of a write above which the disk counts as slow
_DONE = {"start": "recording into", "stop": "recording stopped:"}


class Recorder:
    """Records the messages of a run into logs."""

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        run_id: str,
        folder: Path,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Sequence[Attachment] = (),
        limits: LogLimits = STANDARD,
        granted: Granted = NOTHING,
        selection: Selection = EVERYTHING,
        expected_bytes_per_s: Callable[[wire.CameraState | None], float] = lambda camera: 0.0,
        awaited: AbstractSet[str] = frozenset(),
    ) -> None:
        """Subscribe to everything; `run` starts the recording. Each log starts with `metadata` and `attachments`.

        Recording starts once each of the `awaited` processes has sent Health, or after a timeout. If none is named, as
        many processes are awaited as the bus has peers; across hosts only one, because the router is the only peer.
        `expected_bytes_per_s` is called before the first log begins, with the camera's state or None; its result holds
        until growth is measured.
        """
        self._awaited = awaited
        self._bus = bus
        self._clock = clock
        self._backlog = Backlog(QUEUE_MESSAGES, QUEUE_BYTES)
        self._account = LossAccount()
        self._selection = selection
        self._folder, self._min_free_bytes = folder, limits.min_free_bytes
        self._working_folder = encodable(str(Path.cwd()))  # read now: the folder may be removed later
        self._estimate_bytes_per_s, self._expected_bytes_per_s = expected_bytes_per_s, 0.0
        self._series = LogSeries(folder, clock, {**metadata, **selection.metadata}, attachments, limits)
        self._peers = Peers(bus)
        self._paused = self._stopping = self._skip_drain = False
        self._failure = ""
        self._flush_due_ns = self._max_starts = 0
        self._begun_ns = self._oldest_ns = 0  # start of the first recording; arrival of the oldest unflushed message
        self._messages_before, self._lost_before = 0, dict[str, int]()  # of earlier recordings
        self._longest_wait_ns = self._longest_unflushed_ns = self._slowest_ns = 0
        # The service subscribes to Health after these: a peer that knows of that subscription knows of all these.
        for topic in TOPICS:
            bus.subscribe(topic, partial(self._backlog.put, topic))
        self.service = Service(Role.RECORDER, run_id, clock, bus, granted=granted, fill=self._fill_health)
        self._queries: deque[Query] = deque()
        bus.queryable(RECORD_KEY.format(name=ALL), self._queries.append)

    def catch_signals(self) -> None:
        """Finish the log at SIGTERM or Ctrl-C; to be called in the main thread.

        After a second signal the recorder does not wait for the last Health of the other processes.
        """
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._stop_by_signal)

    def run(self) -> Summary:
        """Record until stopped; DataFileError if the first log cannot be opened."""
        self._settle()
        self._peers.query()  # fills `newest`, with which the log begins
        self._expected_bytes_per_s = self._estimate_bytes_per_s(self._peers.camera())
        self._begin()
        self._begun_ns = self._clock.host_ns()
        self.service.awaited = lambda: "" if self.service.last_health else "any other process"
        self.service.state = "ready"
        while self.service.running:
            self._iterate()
            time.sleep(_ITERATION_S)
        self.service.state = "stopping"
        self._drain()
        summary = self._close()
        self.service.finish()
        return summary

    def _stop_by_signal(self, number: int, frame: FrameType | None) -> None:
        self._skip_drain = not self.service.running
        self.service.stop(signal.Signals(number).name)

    def _settle(self) -> None:
        """Wait for the Health of each process that is running or awaited, so that it can be queried."""
        begun_s = time.monotonic()
        shortest_s, longest_s = _SETTLE_S
        while self.service.running:
            self.service.beat()
            time.sleep(_ITERATION_S)
            age_s = time.monotonic() - begun_s
            alive = self.service.last_health.keys()
            complete = self._awaited <= alive if self._awaited else len(alive) >= self._bus.peers()
            if age_s >= longest_s or (age_s >= shortest_s and complete):
                return

    def _begin(self, *, anew: bool = True) -> None:
        """Begin a recording, or its next file if not `anew`; each begins with calibration and states then in force."""
        if anew:
            self._messages_before, self._lost_before = self._series.messages, self._account.lost()
        self._series.begin(self._peers.newest.values(), new_recording=anew)
        self._max_starts = self._account.starts + MAX_CHANNELS
        self.service.event("RECORDING")

    def _iterate(self) -> None:
        """Write what has arrived; periodically flush, report and rotate; carry out an operator's request."""
        self._write_waiting()
        for sample in self._peers.query_in_background(start=self.service.running):
            self._write(sample)
        if self._clock.host_ns() >= self._flush_due_ns:
            self._maintain()
        self._answer_operator()
        self.service.beat()

    def _write_waiting(self) -> None:
        for _ in range(len(self._backlog)):
            topic, sample = self._backlog.take()
            self._record(topic, sample)
            now_ns = self._clock.host_ns()
            self._longest_wait_ns = max(self._longest_wait_ns, now_ns - self._arrival_ns(sample))
            if now_ns >= self._flush_due_ns:
                self._maintain()

    def _answer_operator(self) -> None:
        """Start or stop on request and answer with the log's path; a stop is answered once the log is on the disk."""
        while self._queries:
            query = self._queries[0]
            if query.name not in ("start", "stop"):
                refusal: str | None = f"a recorder can start and stop, not {query.name}"
            else:
                refusal = self._resume() if query.name == "start" else self._pause()
            if refusal is None:
                return
            self._queries.popleft()
            path = encodable(str(self._series.files[-1].absolute())) if self._series.files else ""
            growth = self._series.bytes_per_s or self._expected_bytes_per_s
            started = query.name == "start" and not refusal
            estimate = growth_in_words(growth, self._folder, self._min_free_bytes) if started and growth else ""
            answer = wire.Request(
                timestamp=timestamp(self._clock.now_ns()),
                name=query.name,
                text=path,
                accepted=not refusal,
                reply=encodable(refusal) or "; ".join(filter(None, (f"{_DONE[query.name]} {path}", estimate))),
            )
            query.reply(answer.SerializeToString())

    def _pause(self) -> str | None:
        """Finish the log; return None until it is on the disk, then the reason of a failure or an empty text."""
        try:
            if not self._stopping:
                if self._failure or self._paused:
                    return self._failure or "nothing is being recorded"
                self.service.event("RECORDING_STOPPED", why="operator asked")
                self._report_losses()
                self._write_waiting()
                self._flush()
                self._series.end(self._totals(), wait=False)
                self._paused = self._stopping = True
            if self._series.finishing:
                return None
            self._series.end({})  # raises if the log could not be finished
        except DataFileError as fault:
            self._fail(fault)
        self._paused, self._stopping = not self._failure, False
        self.service.state = "ready"  # publishes Health, so that the next `status` is current
        return self._failure

    def _resume(self) -> str:
        """Begin a recording; return the reason of a refusal, or an empty text."""
        if not (self._paused or self._failure) or not self.service.running:
            return "recording is already in progress" if self.service.running else "the recorder is ending"
        try:
            if short := shortage(self._folder, self._min_free_bytes):
                return short
            self._begin()
        except DataFileError as fault:
            self._series.give_up()
            return str(fault)
        self._paused, self._failure = False, ""
        self.service.state = "ready"
        self._peers.query_soon()
        return ""

    def _maintain(self) -> None:
        """Flush, begin the next file if it is due, report losses, publish Health."""
        self._flush()
        self._flush_due_ns = self._clock.host_ns() + _FLUSH_NS
        if not self._failure:  # otherwise every message is lost, which is reported at the end
            self._report_losses()
        if self._series.longest_write_ns > max(_SLOW_NS, self._slowest_ns):
            self._slowest_ns = self._series.longest_write_ns
            self.service.event("DISK_SLOW", stall_s=self._slowest_ns * 1e-9, waiting=len(self._backlog))
        self.service.beat()

    def _record(self, topic: Topic, sample: Sample) -> None:
        try:
            self._account.names.admit(topic, sample.key)
        except BadMessageError as fault:
            self.service.unreadable(topic.key, fault)
            return
        written = self._peers.already_received(sample)  # if so, it was written when the query returned it
        unwanted = self._paused or not self._selection.keeps(topic, sample.sequence, sample.payload)
        recorded = not self._failure if written else not unwanted and self._write(sample)
        self._account.enter(topic, sample, recorded=recorded, unwanted=unwanted)
        if topic is HEALTH:
            self._note_health(topic, sample)
        elif topic.queryable:
            self._peers.store(sample)

    def _note_health(self, topic: Topic, sample: Sample) -> None:
        try:
            _, health = self._account.names.health(sample.key, sample.payload)
        except UNREADABLE:
            return  # the log has the message as received; the service counts it as unreadable
        self._peers.note(sample, health)
        try:
            self._account.reconcile(sample, health)
        except BadMessageError as fault:
            self.service.unreadable(topic.key, fault)

    def _write(self, sample: Sample) -> bool:
        try:
            written = self._series.write(sample)
        except DataFileError as fault:
            self._fail(fault)
            return False
        if written:
            self.service.work += 1
            self._oldest_ns = self._oldest_ns or self._arrival_ns(sample)
        return written

    def _arrival_ns(self, sample: Sample) -> int:
        return max(sample.receive_time_ns, self._begun_ns)

    def _flush(self) -> None:
        """Flush; begin the next file if this one is full, and end the recording if the disk is nearly full."""
        try:
            self._series.flush()
            self._note_flush()
            if self._failure or self._paused:
                return
            if short := shortage(self._folder, self._min_free_bytes):
                self._failure = short
                self._series.end(self._totals() | {"stopped": short})
                self.service.event("RECORDING_FAILED", why=f"{short}; the log is complete")
            elif self._series.full or self._account.starts >= self._max_starts:
                self._series.end(self._totals(), wait=False)
                self._begin(anew=False)
                self._peers.query_soon()
        except DataFileError as fault:
            self._fail(fault)

    def _note_flush(self) -> None:
        self._account.mark_flushed()
        if self._oldest_ns:
            age_ns = self._clock.host_ns() - self._oldest_ns
            self._longest_unflushed_ns = max(self._longest_unflushed_ns, age_ns)
            self._oldest_ns = 0

    def _fail(self, fault: DataFileError) -> None:
        """End the recording, but not the process: it counts the messages lost from now on."""
        self._series.give_up()
        self._account.revert()
        self._failure = str(fault)
        self.service.event("RECORDING_FAILED", why=fault)

    def _report_losses(self) -> None:
        for topic, count in self._account.newly_lost().items():
            self.service.event("MESSAGES_LOST", topic=topic, count=count)

    def _drain(self) -> None:
        """Wait up to _DRAIN_S for the last Health of the other processes, which counts the messages they sent."""
        deadline_s = time.monotonic() + _DRAIN_S
        while not self._skip_drain:
            self._iterate()
            if self._peers.stopped(except_name=self.service.name) or time.monotonic() >= deadline_s:
                return
            time.sleep(_ITERATION_S)

    def _close(self) -> Summary:
        self._report_losses()
        self._iterate()
        while self._stopping:  # until the operator's request to stop is answered
            time.sleep(_ITERATION_S)
            self._iterate()
        self._flush()
        try:
            self._series.end(self._totals())
            own = {EVENT.key, HEALTH.at(self.service.name)}
            peers_recorded = self.service.last_health or self._peers.newest or set(self._account.recorded()) - own
            if not (self._failure or peers_recorded):
                self._series.remove()
        except DataFileError as fault:
            self._fail(fault)
        return Summary(
            tuple(self._series.files),
            self._series.messages,
            self._account.lost(),
            self._failure,
            self._longest_wait_ns,
            self._longest_unflushed_ns,
            self._series.longest_write_ns,
        )

    def _totals(self) -> dict[str, str]:
        """Totals at the end of a log, over all files of its recording so far."""
        lost = Counter(self._account.lost()) - Counter(self._lost_before)
        return {
            "messages": str(self._series.messages - self._messages_before),
            "messages_lost": str(sum(lost.values())),
            **{f"lost {key}": str(count) for key, count in lost.items()},
        }

    def _fill_health(self, health: wire.Health) -> None:
        lost = self._account.lost()
        health.recording.files.extend(encodable(str(file)) for file in self._series.files[-MAX_HEALTH_LOGS:])
        health.recording.file = health.recording.files[-1] if health.recording.files else ""
        health.recording.folder = self._working_folder
        health.recording.messages = self._series.messages
        health.recording.lost = sum(lost.values())
        health.recording.failure = encodable(self._failure)
        health.recording.stopped = self._paused and not self._failure
        health.recording.bytes = self._series.bytes_written
        counts = {count.topic: count for count in health.topics}  # already has this process's sent counts
        for key, recorded in self._account.recorded().items():
            count = counts[key] if key in counts else health.topics.add(topic=key)
            count.received, count.missing = recorded, lost.get(key, 0)
