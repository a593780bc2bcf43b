"""Recovering logs: what is whole in a truncated or damaged one becomes a complete, indexed log beside it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lowfc.adapters.log_copy import LogCopy, new_log
from lowfc.adapters.log_reader import LogReader
from lowfc.adapters.log_records import Damage
from lowfc.adapters.log_writer import UNFINISHED
from lowfc.contract.errors import DataFileError

RECOVERY = "recovery"
"""Name of the metadata that says what a recovered log was made from."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """What has been recovered.

    Attributes:
        source: the log, which is as it was.
        size: bytes of it.
        recovered: the new log; None where the source is whole.
        messages: in the new log.
        finished: the source had been finished.
        damage: what was left out.
        unreadable: messages left out because what declares them was in one of those.
    """

    source: Path
    size: int
    recovered: Path | None
    messages: int
    finished: bool
    damage: list[Damage]
    unreadable: int


def recovered_path(source: Path) -> Path:
    """Name for what is recovered from a log, beside it."""
    stem = source.name.removesuffix(UNFINISHED).removesuffix(".mcap")
    return source.with_name(f"{stem}-recovered.mcap")


def recover(source: Path, out: Path, progress: Callable[[int, int], None] = lambda done, size: None) -> Recovery:
    """Write what is whole of `source` to `out`; nothing where all of it is whole.

    Messages, channels, schemas, attachments and metadata stay as they are; a metadata record "recovery" is added.

    Args:
        source: a log, finished or not.
        out: a file that is not there yet.
        progress: is told how many bytes of how many are done.

    Raises:
        DataFileError: `source` is no log, `out` is there already, or the disk refuses.
    """
    if out.exists():
        raise DataFileError(f"{out} exists already; a log is never overwritten; name another one with --out")
    reader = LogReader(source, topics=(), skip_damaged=True)
    for _ in reader:
        pass
    if reader.complete and not reader.damage and not reader.unreadable:
        return Recovery(source, reader.size, None, 0, finished=True, damage=[], unreadable=0)
    reader = LogReader(source, skip_damaged=True)
    with new_log(out, source) as file:
        copy = LogCopy(file)
        copy.take(reader, progress)
        if not copy.messages and not reader.described:
            raise DataFileError(f"{source}: nothing in it is whole, so there is nothing to recover")
        copy.note(RECOVERY, account(reader, copy.messages))
        copy.finish()
    return Recovery(source, reader.size, out, copy.messages, reader.finished, reader.damage, reader.unreadable)


def account(reader: LogReader, messages: int) -> dict[str, str]:
    """What is said in a copy of a log that is not whole, of that log."""
    return {
        "source": reader.path.name,
        "source_bytes": str(reader.size),
        "source_finished": str(reader.finished).lower(),
        "messages": str(messages),
        "unreadable": str(reader.unreadable),
        "left_out": str(len(reader.damage)),
        **{f"left_out {number}": in_words(damage) for number, damage in enumerate(reader.damage, 1)},
    }


def in_words(damage: Damage) -> str:
    """A damaged stretch, where it is and what it cost."""
    place = f"at byte {damage.position}, {damage.length} bytes: {damage.why}"
    if not damage.length or damage.after_ns is None or damage.before_ns is None:
        return place
    return f"{place}; {(damage.before_ns - damage.after_ns) / 1e9:.3f} s between the messages around it"
