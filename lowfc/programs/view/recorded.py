"""Draw a log as the live view draws a run."""

import contextlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import rerun as rr
from google.protobuf.message import DecodeError

from lowfc.adapters.logs.history import LAST_NS, REORDERING_NS, attached_configuration
from lowfc.adapters.logs.parts import missing_between
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.recovery import in_words, missing_end_text
from lowfc.adapters.logs.writer import PART
from lowfc.adapters.process.clock import SIMULATED_START_NS
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import FRAME, MIRROR_STATE, topic_of, wire
from lowfc.control.loop.wording import counted
from lowfc.programs.view.renderer import Renderer
from lowfc.programs.view.snapshot import PICTURES_HZ, PICTURES_PER_COMPLETE, SHOWN, Accumulator, LogEnd
from lowfc.programs.view.verdicts.verdict import stroke_used_nm

_PERIOD_NS = round(1e9 / PICTURES_HZ)
_STRIDE = 500  # messages between progress reports


@dataclass(slots=True)
class Drawn:
    """Summary of drawn logs: number of snapshots, duration, and `remarks` on damaged, truncated or unreadable parts.

    `span_ns`: times on the timeline of the first and last snapshot with a frame; None without one.
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
) -> Drawn:
    """Draw consecutive logs on a stream.

    Raises:
        DataFileError: a file is not a log, the logs are of several runs or not in order, or they have nothing to show.
    """
    drawn, accumulator = Drawn(), Accumulator()
    renderer: Renderer | None = None
    due_ns = first_ns = last_ns = ended_ns = earlier_bytes = 0
    newest_frame = last_frame = -1, 0  # largest sequence, and its publish time: so far, and before this log
    damaged, no_end, run, host = 0, "", "", ""
    stroke_nm: float | None = None
    lost: dict[str, int] = {}  # by recording; its last file has the count of all its files
    for log in logs:
        reader = LogReader(log, topics=SHOWN, skip_damaged=True)
        for number, message in enumerate(reader):
            if renderer is None:
                used_config = config or _configuration_of(reader, drawn.remarks)
                renderer = Renderer(used_config, stream)
                accumulator = Accumulator(SIMULATED_START_NS if used_config.lockstep else None)
            if number == 0:
                recorded = reader.metadata.get("lowfc", {})
                previous_run, run, host = run, recorded.get("run", "") or run, host or recorded.get("host", "")
                if previous_run not in ("", run):
                    raise DataFileError(
                        f"{log} is of run {run!r}, and the log before it is of {previous_run!r}: show one run at a time"
                    )
            topic = topic_of(message.key)
            if not topic.queryable and message.receive_time_ns < ended_ns - REORDERING_NS:
                raise DataFileError(f"{log} begins before the previous log ends; name each once, in order of recording")
            if topic is FRAME:
                sequence, sent_ns = message.sequence, message.publish_time_ns
                last_sequence, last_sent_ns = last_frame
                same_start = start_of(sequence) == start_of(last_sequence)
                if same_start and sequence <= last_sequence and sent_ns > last_sent_ns:
                    raise DataFileError(
                        f"{log} repeats frame numbers of the log before it, as a log of another lockstep run does: "
                        "show one run at a time"
                    )
                newest_frame = max(newest_frame, (sequence, sent_ns))
            if message.receive_time_ns > LAST_NS:
                accumulator.unreadable += 1
                continue
            accumulator.add(message)
            if topic is MIRROR_STATE:
                with contextlib.suppress(DecodeError):
                    used_nm = stroke_used_nm(wire.MirrorState.FromString(message.payload))
                    stroke_nm = used_nm if stroke_nm is None else max(stroke_nm, used_nm)
            last_ns = max(last_ns, message.receive_time_ns)
            if not topic.queryable:  # states queried by the recorder at its start may be hours old
                first_ns = first_ns or message.receive_time_ns
            if first_ns and last_ns >= due_ns:
                snapshot = accumulator.snapshot(last_ns, complete=drawn.snapshots % PICTURES_PER_COMPLETE == 0)
                renderer.draw(snapshot)
                if snapshot.frame is not None:
                    drawn.span_ns = (drawn.span_ns[0] if drawn.span_ns else snapshot.frame_ns), snapshot.time_ns
                drawn.snapshots += 1
                due_ns = last_ns + _PERIOD_NS
            if number % _STRIDE == 0:
                progress(earlier_bytes + reader.position)
        earlier_bytes, ended_ns, last_frame = earlier_bytes + reader.size, last_ns, newest_frame
        damaged += len(reader.damage)
        drawn.remarks += [f"{log.name}: left out {in_words(damage)}" for damage in reader.damage]
        if missing := missing_end_text([log], finished=reader.finished):
            no_end = missing
            drawn.remarks.append(f"{log.name}: {missing}")
        if re.fullmatch("[0-9]{1,18}", account := reader.metadata.get("recording", {}).get("messages_lost", "")):
            lost[reader.metadata.get(PART, {}).get("of", log.name)] = int(account)
    if renderer is None:
        raise DataFileError(f"nothing to show in {', '.join(map(str, logs))}: they have no message that a view shows")
    name, missing_files = logs[-1].name.partition(".")[0], missing_between(logs)
    ended = LogEnd(name, run, host, no_end, damaged, missing_files, sum(lost.values()), stroke_nm)
    renderer.draw(accumulator.snapshot(last_ns, ended=ended))
    if accumulator.unreadable:
        drawn.remarks.append(f"{counted(accumulator.unreadable, 'message')} could not be read")
    drawn.log_s = (last_ns - (first_ns or last_ns)) * 1e-9
    return drawn


def _configuration_of(reader: LogReader, remarks: list[str]) -> Configuration:
    """The configuration in a log, or the default one; reasons why parts of it are not used go to `remarks`."""
    attached, reasons = attached_configuration(reader)
    remarks += reasons
    if attached is None:
        remarks.append("the default configuration is used for pupil and telescope, because the log has no readable one")
    return attached or Configuration()
