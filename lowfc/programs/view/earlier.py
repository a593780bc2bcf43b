"""Events from before a view began, from the logs that the run's recorder has written so far."""

import platform
from pathlib import Path

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.writer import UNFINISHED
from lowfc.contract.errors import DataFileError
from lowfc.contract.events import Level
from lowfc.contract.messages import EVENT, Log, timestamp, wire

MOST = 1000
"""Events that are shown from before, the newest."""


def earlier_events(recorder: wire.Health | None, now_ns: int) -> list[Sample]:
    """The newest events in a recorder's logs; where they cannot be read, a line that says so.

    Only the chunks that hold events are read: a second for a log of 4 GB.

    Args:
        recorder: its last Health; None where there is no recorder.
        now_ns: time of that line, ns since the epoch.
    """
    if recorder is None:
        return [_line("earlier events are not shown: no recorder has kept them", now_ns)]
    if recorder.host and recorder.host != platform.node():
        return [_line(f"earlier events are not shown: they are in the log on {recorder.host}", now_ns)]
    found: list[Sample] = []
    missing = []
    for name in reversed(recorder.recording.files):
        path = _present(Path(recorder.recording.folder, name))
        try:
            log = list(LogReader(path, topics=(EVENT,), skip_damaged=True, sparse=True))
        except DataFileError as fault:
            missing.append(_line(f"earlier events are missing here: {fault}", now_ns))
            continue
        found[:0] = [Sample(one.key, one.payload, one.sequence, one.publish_time_ns, one.log_time_ns) for one in log]
        if len(found) >= MOST:
            break
    return [*found[-MOST:], *missing]


def _present(path: Path) -> Path:
    """A log under the name that it has now: it may be finished meanwhile, or not yet."""
    finished = path.with_name(path.name.removesuffix(UNFINISHED))
    part = path.with_name(finished.name + UNFINISHED)
    return finished if finished.exists() or not part.exists() else part


def _line(text: str, now_ns: int) -> Sample:
    log = Log(timestamp=timestamp(now_ns), level=Level.INFO.value, name="view", message=text)  # type: ignore[arg-type]
    return Sample(EVENT.key, log.SerializeToString(), 0, now_ns, now_ns)
