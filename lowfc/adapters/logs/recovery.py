"""Recovering logs: what is whole in a truncated or damaged one becomes a complete, indexed log beside it."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lowfc.adapters.logs.log_copy import LogCopy, new_log
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.records import Damage
from lowfc.adapters.logs.writer import UNFINISHED, being_recorded, stem_of
from lowfc.contract.errors import DataFileError

RECOVERY = "recovery"
"""Name of the metadata with what a recovered log was made from."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of a recovery.

    Attributes:
        log: which is as it was.
        bytes: of it.
        finished: it had been finished.
        recovered: the new log; None where the log is whole.
        messages: in the new log.
        unreadable: messages left out because their declaration was damaged.
        damage: what was left out.
    """

    log: Path
    bytes: int
    finished: bool = True
    recovered: Path | None = None
    messages: int = 0
    unreadable: int = 0
    damage: Sequence[Damage] = ()

    @property
    def figures(self) -> dict[str, Any]:
        """The same for a program."""
        named = {"log": str(self.log), "recovered": None if self.recovered is None else str(self.recovered)}
        return dataclasses.asdict(self) | named

    def __str__(self) -> str:
        """The same for a person."""
        if self.recovered is None:
            name = self.log.name.removesuffix(UNFINISHED)
            advice = "there is nothing to recover" if name == self.log.name else f"only rename it to {name}"
            return f"{self.log} is whole; {advice}"
        lines = [f"left out {in_words(damage)}" for damage in self.damage]
        if self.unreadable:
            lines.append(f"left out {self.unreadable} messages: what declares them was in a damaged chunk")
        if not self.finished:
            lines.append(f"{self.log} had not been finished")
        return "\n".join([*lines, f"{self.recovered}: {self.messages} messages"])


def recovered_path(source: Path) -> Path:
    """Name for what is recovered from a log, beside it."""
    return source.with_name(f"{stem_of(source)}-recovered.mcap")


def recover(source: Path, out: Path, progress: Callable[[int, int], None] | None = None) -> Recovery:
    """Write what is whole of `source` to `out`; nothing where all of it is whole.

    Messages, channels, schemas, attachments and metadata stay as they are; a metadata record "recovery" is added.

    Args:
        source: a log, finished or not.
        out: a file that is not there yet.
        progress: called with the bytes done and their total.

    Raises:
        DataFileError: `source` is no log or is being recorded, `out` is there already, or the disk refuses.
    """
    if source.exists() and being_recorded(source):
        raise DataFileError(f"{source} is being recorded, and nothing is lost: `lowfc ctl record stop` finishes it")
    if out.exists():
        raise DataFileError(f"{out} already exists; a log is never overwritten; name another one with --out")
    reader = LogReader(source, topics=(), skip_damaged=True)
    for _ in reader:
        pass
    if reader.complete and not reader.damage and not reader.unreadable:
        return Recovery(source, reader.size)
    reader = LogReader(source, skip_damaged=True)
    reader.progress = progress
    with new_log(out, source) as file:
        copy = LogCopy(file)
        copy.take(reader)
        if not copy.messages and not reader.described:
            raise DataFileError(f"{source}: nothing in it is whole, so there is nothing to recover")
        copy.note(RECOVERY, account(reader, copy.messages))
        copy.finish()
    return Recovery(source, reader.size, reader.finished, out, copy.messages, reader.unreadable, reader.damage)


def account(reader: LogReader, messages: int) -> dict[str, str]:
    """Metadata for a copy of a damaged or unfinished log."""
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


def no_end(paths: Sequence[Path], *, finished: bool) -> str:
    """Sentence for a person on files without an end; empty for those that are `finished`."""
    if finished:
        return ""
    if any(map(being_recorded, paths)):
        if all(path.exists() for path in paths):
            return "the log has no end: it is being recorded, and `lowfc ctl record stop` finishes it"
        return "the log has no end: it was finished while it was read; read it again"
    return "the log has no end: it was cut off, as when its recorder is killed"


def faults(damaged: Sequence[str], no_end: str) -> list[str]:
    """Lines for a person on what is missing in a log that was read."""
    lines = [f"truncated          {no_end}"] if no_end else []
    return lines + [f"damaged            left out: {part}" for part in damaged]
