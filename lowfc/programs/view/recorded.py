"""Draw a log as the live view draws a run."""

import contextlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import rerun as rr
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.history import LAST_NS, REORDERING_NS, attached_configuration
from lowfc.adapters.logs.parts import missing_between
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.recovery import damage_in_words, missing_end_text
from lowfc.adapters.logs.writer import PART
from lowfc.adapters.process.clock import SIMULATED_START_NS
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import FRAME, MIRROR_STATE, Topic, topic_of, wire
from lowfc.control.loop.wording import counted
from lowfc.programs.view.renderer import Renderer
from lowfc.programs.view.snapshot import PICTURES_HZ, PICTURES_PER_COMPLETE, SHOWN, Accumulator, LogEnd
from lowfc.programs.view.verdicts.verdict import stroke_used_nm

_PERIOD_NS = round(1e9 / PICTURES_HZ)
_STRIDE = 500  # messages between progress reports


@dataclass(slots=True)
class DrawnLogs:
    """Summary of drawn logs: number of snapshots, duration, and `remarks` on damaged, truncated or unreadable parts.

    `span_ns`: times on the timeline of the first and the last snapshot with a frame; None without a frame.
    """

    snapshots: int = 0
    log_s: float = 0.0
    span_ns: tuple[int, int] | None = None
    remarks: list[str] = field(default_factory=list)


def draw_logs(
    logs: Sequence[Path],
    config: Configuration | None,
    stream: rr.RecordingStream,
    progress: Callable[[int], None] = lambda done: None,
) -> DrawnLogs:
    """Draw consecutive logs on a stream.

    Raises:
        DataFileError: a file is not a log, the logs are of several runs or not in order, or they have nothing to show.
    """
    drawing, earlier_bytes = _Drawing(config, stream), 0
    for log in logs:
        reader = LogReader(log, topics=SHOWN, skip_damaged=True)
        for number, message in enumerate(reader):
            if number == 0:
                drawing.begin(reader)
            drawing.add(message, reader.path)
            if number % _STRIDE == 0:
                progress(earlier_bytes + reader.position)
        drawing.end(reader)
        earlier_bytes += reader.size
    return drawing.finish(logs)


class _Drawing:
    """Draws the messages of consecutive logs at the rate of the live view."""

    def __init__(self, config: Configuration | None, stream: rr.RecordingStream) -> None:
        self._config, self._stream = config, stream
        self._drawn, self._order, self._accumulator = DrawnLogs(), _Order(), Accumulator()
        self._renderer: Renderer | None = None
        self._due_ns = self._first_ns = self._last_ns = 0
        self._damaged, self._no_end = 0, ""
        self._stroke_nm: float | None = None
        self._lost: dict[str, int] = {}  # by recording: its last file has the count of all its files

    def begin(self, reader: LogReader) -> None:
        """Begin the next log; the metadata at its start have been read with its first message."""
        self._order.begin(reader, self._last_ns)
        if self._renderer is None:
            config = self._config or _configuration_of(reader, self._drawn.remarks)
            self._renderer = Renderer(config, self._stream)
            self._accumulator = Accumulator(SIMULATED_START_NS if config.lockstep else None)

    def add(self, message: Sample, log: Path) -> None:
        """Add a message of the log; draw a snapshot if one is due."""
        topic, time_ns = topic_of(message.key), message.receive_time_ns
        self._order.check(message, topic, log)
        if time_ns > LAST_NS:
            self._accumulator.unreadable += 1
            return
        self._accumulator.add(message)
        if topic is MIRROR_STATE:
            with contextlib.suppress(DecodeError):
                used_nm = stroke_used_nm(wire.MirrorState.FromString(message.payload))
                self._stroke_nm = used_nm if self._stroke_nm is None else max(self._stroke_nm, used_nm)
        self._last_ns = max(self._last_ns, time_ns)
        if not topic.queryable:  # states queried by the recorder at its start may be hours old
            self._first_ns = self._first_ns or time_ns
        if self._renderer is not None and self._first_ns and self._last_ns >= self._due_ns:
            self._draw(self._renderer)

    def _draw(self, renderer: Renderer) -> None:
        drawn = self._drawn
        snapshot = self._accumulator.snapshot(self._last_ns, complete=drawn.snapshots % PICTURES_PER_COMPLETE == 0)
        renderer.draw(snapshot)
        if snapshot.frame is not None:
            drawn.span_ns = (drawn.span_ns[0] if drawn.span_ns else snapshot.frame_ns), snapshot.time_ns
        drawn.snapshots += 1
        self._due_ns = self._last_ns + _PERIOD_NS

    def end(self, reader: LogReader) -> None:
        """End a log: keep its damage, a missing end and its count of lost messages."""
        log = reader.path
        self._damaged += len(reader.damage)
        self._drawn.remarks += [f"{log.name}: left out {damage_in_words(damage)}" for damage in reader.damage]
        if missing := missing_end_text([log], finished=reader.finished):
            self._no_end = missing
            self._drawn.remarks.append(f"{log.name}: {missing}")
        if re.fullmatch("[0-9]{1,18}", lost := reader.metadata.get("recording", {}).get("messages_lost", "")):
            self._lost[reader.metadata.get(PART, {}).get("of", log.name)] = int(lost)

    def finish(self, logs: Sequence[Path]) -> DrawnLogs:
        """Draw the verdict on the logs, and return the summary."""
        if self._renderer is None:
            raise DataFileError(
                f"nothing to show in {', '.join(map(str, logs))}: there is no message that a view shows"
            )
        ended = LogEnd(
            name=logs[-1].name.partition(".")[0],
            run=self._order.run,
            host=self._order.host,
            no_end=self._no_end,
            damaged=self._damaged,
            missing_files=missing_between(logs),
            lost=sum(self._lost.values()),
            stroke_nm=self._stroke_nm,
        )
        self._renderer.draw(self._accumulator.snapshot(self._last_ns, ended=ended))
        if unreadable := self._accumulator.unreadable:
            self._drawn.remarks.append(f"{counted(unreadable, 'message')} could not be read")
        self._drawn.log_s = (self._last_ns - (self._first_ns or self._last_ns)) * 1e-9
        return self._drawn


class _Order:
    """Checks that consecutive logs are of one run, and in order of recording.

    Attributes:
        run, host: name of the run, and host of the first recorder that names one.
    """

    def __init__(self) -> None:
        self.run = self.host = ""
        self._ended_ns = 0
        # Largest frame sequence and its publish time: up to now, and up to the end of the log before this one.
        self._newest_frame = self._last_frame = (-1, 0)

    def begin(self, reader: LogReader, ended_ns: int) -> None:
        """Begin the next log; the one before it ended at `ended_ns`."""
        recorded = reader.metadata.get("lowfc", {})
        run = recorded.get("run", "") or self.run
        if self.run not in ("", run):
            raise DataFileError(
                f"{reader.path} is of run {run!r}, and the log before it is of {self.run!r}: show one run at a time"
            )
        self.run, self.host = run, self.host or recorded.get("host", "")
        self._ended_ns, self._last_frame = ended_ns, self._newest_frame

    def check(self, message: Sample, topic: Topic, log: Path) -> None:
        """Check a message of the log."""
        if not topic.queryable and message.receive_time_ns < self._ended_ns - REORDERING_NS:
            raise DataFileError(f"{log} begins before the previous log ends; name each log once, in order of recording")
        if topic is FRAME:
            sequence, sent_ns = message.sequence, message.publish_time_ns
            last_sequence, last_sent_ns = self._last_frame
            same_start = start_of(sequence) == start_of(last_sequence)
            if same_start and sequence <= last_sequence and sent_ns > last_sent_ns:
                raise DataFileError(
                    f"{log} repeats frame numbers of the log before it, as a log of another lockstep run does: "
                    "show one run at a time"
                )
            self._newest_frame = max(self._newest_frame, (sequence, sent_ns))


def _configuration_of(reader: LogReader, remarks: list[str]) -> Configuration:
    """The configuration in a log, or the default one; reasons why parts of it are not used go to `remarks`."""
    attached, reasons = attached_configuration(reader)
    remarks += reasons
    if attached is None:
        remarks.append("the default configuration is used for pupil and telescope, because the log has no readable one")
    return attached or Configuration()
