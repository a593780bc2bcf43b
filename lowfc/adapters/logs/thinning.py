"""Smaller copies of logs, by the rules of a recorder that leaves something out."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Metadata

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.log_copy import LogCopy, new_log
from lowfc.adapters.logs.parts import Parts, WholeLog, metadata_at_start
from lowfc.adapters.logs.recovery import RECOVERY, account, faults, in_words, no_end
from lowfc.adapters.logs.selection import SELECTION, Selection
from lowfc.adapters.logs.writer import PART, stem_of
from lowfc.contract.messages import topic_of


@dataclass(frozen=True, slots=True)
class Thinned:
    """A smaller copy of a log.

    Attributes:
        file: the copy.
        selection: what it has, in words.
        messages, bytes: of the copy; of the log `messages_before` and `bytes_before`.
        finished: the log had been finished; `no_end` is why not.
        damaged: what of the log could not be read, a sentence each.
    """

    file: str
    selection: str
    messages: int
    bytes: int
    messages_before: int
    bytes_before: int
    finished: bool
    no_end: str
    damaged: list[str]

    def __str__(self) -> str:
        """The same for a person."""
        lines = [
            f"{self.file}: {self.messages} of {self.messages_before} messages, "
            f"{self.bytes / 1e6:.1f} of {self.bytes_before / 1e6:.1f} MB; {self.selection or 'nothing was left out'}"
        ]
        return "\n".join([*lines, *faults(self.damaged, self.no_end)])


def thinned_path(source: Path, asked: Selection) -> Path:
    """Name for a smaller copy of a log, beside it."""
    return source.with_name(f"{stem_of(source)}-every-{asked.every}.mcap")


def thin(log: Parts, out: Path, asked: Selection, progress: Callable[[int, int], None] | None = None) -> Thinned:
    """Write a smaller log of all files of a log; its metadata names what was left out.

    Raises:
        DataFileError: a file is no log, `out` is there already, or the disk refuses.
    """
    made = Selection.of(metadata_at_start(log[0])).within(asked)
    reader, messages = WholeLog(log, skip_damaged=True), 0
    reader.progress = progress
    described: set[str] = {PART, SELECTION}  # the copy has its own

    def wanted(message: Sample) -> bool:
        nonlocal messages
        messages += 1
        return made.keeps(topic_of(message.key), message.sequence, message.payload)

    def new(record: Metadata | Attachment) -> bool:
        """Of a later file only its account, which replaces that of the file before."""
        known = record.name in described and record.name not in ("recording", RECOVERY)
        described.add(record.name)
        return not known

    with new_log(out, log[0]) as file:
        copy = LogCopy(file)
        for name, entries in made.metadata.items():
            copy.note(name, entries)
        copy.take(reader, wanted=wanted, described=new)
        if not reader.complete or reader.damage or reader.unreadable:
            copy.note(RECOVERY, account(reader, copy.messages))
        copy.finish()
    return Thinned(
        str(out),
        made.sentence,
        copy.messages,
        out.stat().st_size,
        messages,
        reader.size,
        reader.finished,
        no_end(log, finished=reader.finished),
        [in_words(one) for one in reader.damage],
    )
