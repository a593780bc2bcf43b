"""Recovering logs: what is whole in a truncated or damaged one becomes a complete, indexed log beside it."""

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.records import Attachment, Metadata
from mcap.writer import CompressionType, Writer

from lowfc import __version__
from lowfc.adapters.log_reader import LogReader
from lowfc.adapters.log_records import Damage
from lowfc.adapters.log_writer import CHUNK_BYTES, UNFINISHED
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import DataFileError

RECOVERY = "recovery"
"""Name of the metadata that says what a recovered log was made from."""

_STRIDE = 1000  # messages between two words about the progress


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
    with _new_file(out, source) as file:
        writer = Writer(
            file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4, enable_crcs=True, enable_data_crcs=True
        )
        writer.start(profile="", library=f"lowfc {__version__}")
        messages = _copy(reader, writer, progress)
        if not messages and not reader.described:
            raise DataFileError(f"{source}: nothing in it is whole, so there is nothing to recover")
        writer.add_metadata(RECOVERY, _account(reader, messages))
        writer.finish()  # type: ignore[no-untyped-call]
    return Recovery(source, reader.size, out, messages, reader.finished, reader.damage, reader.unreadable)


def _copy(reader: LogReader, writer: Writer, progress: Callable[[int, int], None]) -> int:
    """Copy what describes a log, and its messages; return how many."""
    described = messages = 0
    channels: dict[tuple[str, int], int] = {}
    schemas: dict[int, int] = {}
    for message in reader:
        _describe(reader.described[described:], writer)
        described = len(reader.described)
        name = message.key, start_of(message.sequence)
        if name not in channels:
            channel = reader.channels[name]
            if channel.schema_id not in schemas:
                schema = reader.schemas[channel.schema_id]
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[name] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
            )
        writer.add_message(
            channel_id=channels[name],
            log_time=message.log_time_ns,
            publish_time=message.publish_time_ns,
            sequence=count_of(message.sequence),
            data=message.payload,
        )
        messages += 1
        if messages % _STRIDE == 0:
            progress(reader.position, reader.size)
    _describe(reader.described[described:], writer)
    return messages


def _describe(records: Sequence[Metadata | Attachment], writer: Writer) -> None:
    for record in records:
        if isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        else:
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)


def _account(reader: LogReader, messages: int) -> dict[str, str]:
    """What is said of a recovery in the recovered log."""
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


@contextlib.contextmanager
def _new_file(path: Path, source: Path) -> Iterator[IO[bytes]]:
    """A file with the permissions of `source`: it has its name when it is whole, and is gone when something fails."""
    try:
        mode = source.stat().st_mode & 0o666
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            part = Path(file.name)
            try:
                yield file
                file.flush()
                os.fsync(file.fileno())
                part.chmod(mode)
                if path.exists():
                    raise DataFileError(f"{path} has come into being meanwhile; a log is never overwritten")
                part.rename(path)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
    except OSError as fault:
        raise DataFileError(f"{path} cannot be written: {fault.strerror or fault}") from fault
