"""A log drawn as the live view would have drawn it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lowfc.adapters.clock import SimulatedClock
from lowfc.adapters.history_reader import attached_configuration
from lowfc.adapters.log_reader import Logged, LogReader
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import topic_of
from lowfc.programs.view.moment import PICTURES_HZ, PICTURES_PER_WHOLE, SHOWN, Gatherer, LogEnd
from lowfc.programs.view.painter import Painter

_PERIOD_NS = round(1e9 / PICTURES_HZ)
_STRIDE = 500  # messages between two words about the progress


@dataclass(slots=True)
class Drawn:
    """What was drawn of some logs.

    Attributes:
        moments: drawn.
        log_s: from the first message to the last.
        span_ns: times of the first and of the last moment with a frame, on the timeline; None without one.
        remarks: what a person should know: what is damaged, truncated, unreadable.
    """

    moments: int = 0
    log_s: float = 0.0
    span_ns: tuple[int, int] | None = None
    remarks: list[str] = field(default_factory=list)


def draw_logs(
    logs: Sequence[Path],
    config: Configuration | None,
    make_painter: Callable[[Configuration], Painter],
    progress: Callable[[int], None] = lambda done: None,
) -> Drawn:
    """Draw logs that follow each other.

    Args:
        logs: finished or not, damaged or whole.
        config: of the run; None takes the first log's own.
        make_painter: makes the painter, once the configuration is known.
        progress: is told how many bytes are done.

    Raises:
        DataFileError: one is no log, they are of several runs, or there is nothing to see in any of them.
    """
    drawn, gatherer, run = Drawn(), Gatherer(), ""
    painter: Painter | None = None
    due_ns = first_ns = last_ns = behind = 0
    complete, host = True, ""
    for log in logs:
        reader = LogReader(log, topics=SHOWN, skip_damaged=True)
        for number, message in enumerate(reader):
            if painter is None:
                own = config or _own(reader, drawn)
                painter = make_painter(own)
                gatherer = Gatherer(SimulatedClock().now_ns() if own.lockstep else None)
                first_ns = message.log_time_ns
            if number == 0:
                run = _same_run(run, reader)
                host = host or reader.metadata.get("lowfc", {}).get("host", "")
            last_ns = message.log_time_ns
            _take(gatherer, message)
            if last_ns >= due_ns:
                moment = gatherer.moment(last_ns, whole=drawn.moments % PICTURES_PER_WHOLE == 0)
                painter.draw(moment)
                if moment.frame is not None:
                    drawn.span_ns = (drawn.span_ns[0] if drawn.span_ns else moment.frame_ns), moment.time_ns
                drawn.moments += 1
                due_ns = last_ns + _PERIOD_NS
            if number % _STRIDE == 0:
                progress(behind + reader.position)
        behind += reader.size
        complete &= reader.complete
        drawn.remarks += [f"{log.name}: {damage}" for damage in reader.damage]
        if not reader.complete and not reader.damage:
            drawn.remarks.append(f"{log.name} has no end: its recorder was killed, or is still writing")
    if painter is None:
        raise DataFileError(f"there is nothing to see in {', '.join(map(str, logs))}: no message that a view shows")
    ended = LogEnd(logs[-1].name.partition(".")[0], complete, run, host)
    painter.draw(gatherer.moment(last_ns, ended=ended))
    if gatherer.unreadable:
        drawn.remarks.append(f"{gatherer.unreadable} messages could not be read")
    drawn.log_s = (last_ns - first_ns) * 1e-9
    return drawn


def _take(gatherer: Gatherer, message: Logged) -> None:
    gatherer.take(topic_of(message.key), message.key, message.payload, message.publish_time_ns, message.sequence)


def _same_run(before: str, reader: LogReader) -> str:
    run = reader.metadata.get("lowfc", {}).get("run", "")
    if before and run and run != before:
        raise DataFileError(
            f"{reader.path} is of run {run!r}, and the log before it of {before!r}: look at one at a time"
        )
    return run or before


def _own(reader: LogReader, drawn: Drawn) -> Configuration:
    """The log's own configuration; the default one, with a remark, where it has none that can be read."""
    found, remarks = attached_configuration(reader)
    drawn.remarks += remarks
    if found is None:
        drawn.remarks.append("the default configuration is used for pupil and telescope, as the log has none")
    return found or Configuration()
