"""Thinned copies of logs, with the same selection rules as in a recorder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Metadata

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.log_copy import LogCopy, new_log
from lowfc.adapters.logs.parts import Parts, WholeLog, metadata_at_start, titled
from lowfc.adapters.logs.recovery import RECOVERY, missing_parts, origin
from lowfc.adapters.logs.selection import SELECTION, Selection
from lowfc.adapters.logs.writer import PART, stem_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import known_topic


def thin(
    log: Parts, out: Path | None, requested: Selection, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Write a thinned log from all files of a log, with its selection in the metadata; return the results for JSON.

    By default the thinned log is written next to the original.

    Raises:
        DataFileError: a file is not a log, none has messages, `out` exists already, or it cannot be written.
    """
    combined = requested.within(Selection.of(metadata_at_start(log[0])))
    reader = WholeLog(log, progress)
    excluded_names = {PART, SELECTION}  # the thinned log is a single file with its own selection

    def include(message: Sample) -> bool:
        topic = known_topic(message.key)
        return topic is None or combined.keeps(topic, message.sequence, message.payload)

    def include_record(record: Metadata | Attachment) -> bool:
        """Whether to copy a record: the first of a name; all "recording" and "recovery", as readers use the last."""
        excluded = record.name in excluded_names and record.name not in ("recording", RECOVERY)
        excluded_names.add(record.name)
        return not excluded

    out = out or log[0].parent / f"{stem_of(log[0])}-every-{requested.interval_frames}.mcap"
    with new_log(out, log[0]) as file:
        copy = LogCopy(file)
        for name, entries in combined.metadata.items():
            copy.add_metadata(name, entries)
        copy.add_file(reader, include=include, include_record=include_record)
        if not copy.read:
            raise DataFileError(f"{titled(log)} has no messages: there is nothing to copy")
        if not reader.complete or reader.damage or reader.unreadable:
            copy.add_metadata(RECOVERY, origin(reader, copy.messages))
        copy.finish()
    return {
        "file": str(out),
        "selection": combined.description,
        "messages": copy.messages,
        "bytes": out.stat().st_size,
        "messages_before": copy.read,
        "bytes_before": reader.size,
        **missing_parts(reader),
    }
