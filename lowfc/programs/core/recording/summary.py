"""What a recorder says at its end: to a person, and as figures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Summary:
    """What a recorder has done; a log that could not be finished ends in `.part`.

    The longest times are from a message's arrival, once there was a log, to its being written (wait) and to its
    surviving a kill -9 (unflushed), and of one write to the disk.
    """

    files: tuple[Path, ...]
    messages: int
    lost: dict[str, int]
    failure: str
    longest_wait_ns: int
    longest_unflushed_ns: int
    longest_write_ns: int


def figures(summary: Summary) -> dict[str, Any]:
    """What a recorder has done, for `--json`."""
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
    """The same for a person."""
    if not summary.files and not summary.failure:
        return "no process of this run was there: no log is kept"
    logs = ", ".join(map(str, summary.files))
    lines = [f"{summary.messages} messages in {logs}; {sum(summary.lost.values())} lost"]
    lines += [f"lost {count} of {topic}" for topic, count in sorted(summary.lost.items())]
    return "\n".join(lines)
