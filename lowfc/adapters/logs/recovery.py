"""Recovery of truncated or damaged logs: their intact parts are written to a complete, indexed log."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lowfc.adapters.logs.log_copy import LogCopy, new_log, refuse_existing
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.records import Damage, LogFile
from lowfc.adapters.logs.writer import UNFINISHED, being_recorded, stem_of
from lowfc.contract.errors import DataFileError
from lowfc.control.loop.wording import counted

RECOVERY = "recovery"
"""Name of the metadata with the origin of a recovered log."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of a recovery.

    Attributes:
        log: the original log, unchanged.
        bytes: size of the original log.
        finished: whether the original log had been finished.
        recovered: the new log; None if the original is intact.
        messages: number of messages in the new log.
        unreadable: number of messages left out because the record of their channel or schema was damaged.
        damage: damaged stretches that were left out.
    """

    log: Path
    bytes: int
    finished: bool = True
    recovered: Path | None = None
    messages: int = 0
    unreadable: int = 0
    damage: Sequence[Damage] = ()

    @property
    def json_object(self) -> dict[str, Any]:
        """The result as values for JSON."""
        named = {"log": str(self.log), "recovered": None if self.recovered is None else str(self.recovered)}
        return dataclasses.asdict(self) | named

    def __str__(self) -> str:
        """The result as text."""
        if self.recovered is None:
            name = self.log.name.removesuffix(UNFINISHED)
            advice = "there is nothing to recover" if name == self.log.name else f"rename it to {name}"
            return f"{self.log} is intact; {advice}"
        lines = [f"left out {damage_in_words(damage)}" for damage in self.damage]
        if self.unreadable:
            lines.append(
                f"left out {counted(self.unreadable, 'message')}: the record of their channel or schema was damaged"
            )
        if not self.finished:
            lines.append(f"{self.log} had not been finished")
        return "\n".join([*lines, f"{self.recovered}: {counted(self.messages, 'message')}"])


def recovered_path(source: Path) -> Path:
    """Default path of the recovered log, next to the original."""
    return source.parent / f"{stem_of(source)}-recovered.mcap"


def recover(source: Path, out: Path, progress: Callable[[int, int], None] | None = None) -> Recovery:
    """Write the intact parts of `source` to `out`; if `source` is wholly intact, write nothing.

    Messages with their channels and schemas, attachments and metadata are copied; metadata "recovery" are added.

    Args:
        source: a log, finished or not.
        out: a file that does not exist yet.
        progress: function called with the bytes read and their total.

    Raises:
        DataFileError: `source` is no log, has no intact part or is being recorded; `out` exists or cannot be written.
    """
    with LogFile(source):  # raises an error if it cannot be read
        pass
    if being_recorded(source):
        raise DataFileError(f"{source} is being recorded, and nothing is lost: `lowfc ctl record stop` finishes it")
    refuse_existing(out)
    reader = LogReader(source, topics=(), skip_damaged=True)
    for _ in reader:
        pass
    if reader.complete and not reader.damage and not reader.unreadable:
        return Recovery(source, reader.size)
    reader = LogReader(source, progress, skip_damaged=True)
    with new_log(out, source) as file:
        copy = LogCopy(file)
        copy.add_file(reader)
        if not copy.messages and not reader.records:
            raise DataFileError(f"{source}: no part of it is intact, so there is nothing to recover")
        copy.add_metadata(RECOVERY, origin(reader, copy.messages))
        copy.finish()
    return Recovery(source, reader.size, reader.finished, out, copy.messages, reader.unreadable, reader.damage)


def origin(reader: LogReader, messages: int) -> dict[str, str]:
    """Metadata on the origin of a copy of a damaged or unfinished log."""
    return {
        "source": reader.path.name,
        "source_bytes": str(reader.size),
        "source_finished": str(reader.finished).lower(),
        "messages": str(messages),
        "unreadable": str(reader.unreadable),
        "left_out": str(len(reader.damage)),
        **{f"left_out {number}": damage_in_words(damage) for number, damage in enumerate(reader.damage, 1)},
    }


def damage_in_words(damage: Damage) -> str:
    """Position, reason and lost time of a damaged stretch, as text."""
    place = f"at byte {damage.position}, {damage.length} bytes: {damage.why}"
    if not damage.length or damage.after_ns is None or damage.before_ns is None:
        return place
    return f"{place}; {(damage.before_ns - damage.after_ns) / 1e9:.3f} s between the messages around it"


def missing_end_text(paths: Sequence[Path], *, finished: bool) -> str:
    """Sentence on the missing end of a log; empty if it is `finished`."""
    if finished:
        return ""
    if any(map(being_recorded, paths)):
        if all(path.exists() for path in paths):
            return "the log has no end: it is being recorded, and `lowfc ctl record stop` finishes it"
        return "the log has no end: it was finished while it was read; read it again"
    return "the log has no end: it was cut off, as when its recorder is killed"


def missing_parts(reader: LogReader) -> dict[str, Any]:
    """Missing parts of a log that was read to its end, for JSON: `no_end` is empty for a finished log."""
    no_end = missing_end_text(reader.paths, finished=reader.finished)
    return {"finished": reader.finished, "no_end": no_end, "damaged": list(map(damage_in_words, reader.damage))}


def faults(damaged: Sequence[str], no_end: str) -> list[str]:
    """Lines of text on missing parts of a log."""
    lines = [f"truncated          {no_end}"] if no_end else []
    return lines + [f"damaged            left out: {part}" for part in damaged]
