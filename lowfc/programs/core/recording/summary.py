"""Summary of a recording at its end: as text and for `--json`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a recording; the name of a log that could not be finished ends in `.part`.

    Attributes:
        files: the logs.
        messages: number of messages recorded.
        lost: number of messages lost, by topic.
        failure: reason why the recording ended early; empty if it did not.
        longest_wait_ns: longest time from the arrival of a message until it was written, once a log was open.
        longest_unflushed_ns: longest time from the arrival of a message until a kill -9 of the recorder could no longer
            lose it.
        longest_write_ns: longest single write to the disk.
    """

    files: tuple[Path, ...]
    messages: int
    lost: dict[str, int]
    failure: str
    longest_wait_ns: int
    longest_unflushed_ns: int
    longest_write_ns: int


def json_object(summary: Summary) -> dict[str, Any]:
    """The summary for `--json`."""
    return {
        "messages_recorded": summary.messages,
        "messages_lost": sum(summary.lost.values()),
        "lost": summary.lost,
        "logs": [str(path) for path in summary.files],
        "failure": summary.failure or None,
        "longest_wait_ms": summary.longest_wait_ns / 1e6,
        "longest_unflushed_ms": summary.longest_unflushed_ns / 1e6,
        "longest_write_ms": summary.longest_write_ns / 1e6,
    }


def report(summary: Summary) -> str:
    """The summary as text."""
    if not summary.files and not summary.failure:
        return "no other process of this run was running: no log is kept"
    logs = ", ".join(map(str, summary.files))
    lines = [f"{summary.messages} messages in {logs}; {sum(summary.lost.values())} lost"]
    lines += [f"lost {count} of {topic}" for topic, count in sorted(summary.lost.items())]
    return "\n".join(lines)
