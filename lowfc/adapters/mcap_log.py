"""Logs: MCAP files that describe themselves, written so that a crash costs at most the last fraction of a second.

A log is written as `<name>.mcap.part` and renamed when it is finished. What describes it (metadata, attachments)
stands at its start. A channel is one topic of one start of its publisher: MCAP's sequence has 32 bits and takes the
count, the channel's metadata the start.
"""

import contextlib
import itertools
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import cast

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as ProtobufMessage
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from lowfc import __version__
from lowfc.adapters.bus import Sample
from lowfc.adapters.envelope import count_of, sequence_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import Topic, topic_of

UNFINISHED = ".part"
"""Appended to the name of a log that is being written, or was when its recorder died."""

_CHUNK_BYTES = 240 * 1024  # a chunk is closed by the message that passes this; with a frame it stays below 256 KiB
_LARGEST_RECORD_BYTES = 1 << 30
_START = "start_s"


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside a log."""

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Logged:
    """One message of a log.

    Attributes:
        key: where it was published; the log's topic without the leading slash.
        schema: full name of its protobuf message.
        payload: as it was on the bus.
        sequence: see `Envelope`.
        publish_time_ns: when it was sent.
        log_time_ns: when the recorder received it.
    """

    key: str
    schema: str
    payload: bytes
    sequence: int
    publish_time_ns: int
    log_time_ns: int


class LogWriter:
    """Writes one log.

    Attributes:
        path: what the log will be called when it is finished.
        messages: messages written.
    """

    def __init__(
        self,
        path: Path,
        time_ns: int,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Sequence[Attachment] = (),
    ) -> None:
        """Open `path` + ".part" and write what describes the log, made at `time_ns`.

        Raises:
            DataFileError: there is a log of that name, or the disk refuses.
        """
        self.path = path
        self.messages = 0
        self._part = path.with_name(path.name + UNFINISHED)
        self._good_bytes = 0
        self._channels: dict[tuple[str, int], int] = {}
        self._schemas: dict[str, int] = {}
        if path.exists() or self._part.exists():
            raise DataFileError(f"{path} exists already; a log is never overwritten")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._raw = FileIO(self._part, "x")
        except OSError as fault:
            raise DataFileError(f"{self._part} cannot be made: {fault.strerror}") from fault
        self._file = BufferedWriter(self._raw)
        self._writer = Writer(
            self._file,
            chunk_size=_CHUNK_BYTES,
            compression=CompressionType.LZ4,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        with self._disk():
            self._writer.start(profile="", library=f"lowfc {__version__}")
            for name, entries in metadata.items():
                self._writer.add_metadata(name, dict(entries))
            for attachment in attachments:
                self._writer.add_attachment(
                    create_time=time_ns,
                    log_time=time_ns,
                    name=attachment.name,
                    media_type=attachment.media_type,
                    data=attachment.data,
                )
            self._flush()

    @property
    def bytes_written(self) -> int:
        """Size of the file up to the last flush."""
        return self._good_bytes

    def write(self, sample: Sample) -> None:
        """Add one message, its payload verbatim.

        Raises:
            DataFileError: the disk refuses; the log keeps what was flushed and takes no more.
            KeyError: there is no such topic.
        """
        with self._disk():
            self._writer.add_message(
                channel_id=self._channel(sample),
                log_time=sample.receive_time_ns,
                publish_time=sample.publish_time_ns,
                sequence=count_of(sample.sequence),
                data=sample.payload,
            )
            self.messages += 1

    def flush(self) -> None:
        """Hand everything to the operating system: what was flushed survives a kill -9 of this process.

        Raises:
            DataFileError: as for `write`.
        """
        with self._disk():
            self._flush()

    def finish(self, metadata: Mapping[str, Mapping[str, str]]) -> Path:
        """Close the log, with what became known at its end, and give it its name.

        Raises:
            DataFileError: as for `write`.
        """
        with self._disk():
            for name, entries in metadata.items():
                self._writer.add_metadata(name, dict(entries))
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
            self._part.rename(self.path)
        return self.path

    def abandon(self) -> None:
        """Close the log unfinished, cut back to its last flush."""
        if not self._raw.closed:
            with contextlib.suppress(OSError):
                self._raw.truncate(self._good_bytes)
            self._raw.close()

    def _flush(self) -> None:
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._good_bytes = self._raw.tell()

    def _channel(self, sample: Sample) -> int:
        start_s = start_of(sample.sequence)
        channel = self._channels.get((sample.key, start_s))
        if channel is None:
            topic = topic_of(sample.key)
            channel = self._channels[sample.key, start_s] = self._writer.register_channel(
                topic="/" + sample.key,
                message_encoding="protobuf",
                schema_id=self._schema(topic),
                metadata={
                    "description": topic.sentence,
                    "publisher": ", ".join(sorted(topic.publisher)),
                    _START: str(start_s),
                },
            )
        return channel

    def _schema(self, topic: Topic) -> int:
        name = topic.message.DESCRIPTOR.full_name
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(
                name=name, encoding="protobuf", data=declaration(topic.message).SerializeToString()
            )
        return self._schemas[name]

    @contextlib.contextmanager
    def _disk(self) -> Iterator[None]:
        """Turn a fault of the disk into one error, and cut the file back to whole records."""
        try:
            yield
        except OSError as fault:
            self.abandon()
            raise DataFileError(
                f"{self._part} cannot be written ({fault.strerror}) after {self._good_bytes} bytes; "
                "make room or record elsewhere; what is there is readable"
            ) from fault


class LogReader:
    """Reads a log from its start, finished or not, and checks every checksum.

    Attributes:
        metadata: by name; complete once the messages have been read.
        attachments: by name; those of the start are there with the first message.
        complete: the end was reached; False while reading, and for a log whose recorder died.
        damaged_chunks: chunks left out because their checksum was wrong.
        unreadable: messages left out because what declares them was in one of those.
    """

    def __init__(self, path: Path, *, skip_damaged: bool = False) -> None:
        """Open the log at `path`; with `skip_damaged` a chunk that is damaged is left out instead of an error."""
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.complete = False
        self.damaged_chunks = 0
        self.unreadable = 0
        self._skip_damaged = skip_damaged

    def __iter__(self) -> Iterator[Logged]:
        """Messages in the order they were recorded.

        Raises:
            DataFileError: this is no log, or a part of it is damaged.
        """
        schemas: dict[int, str] = {}
        channels: dict[int, tuple[str, str, int]] = {}
        for record in self._records():
            match record:
                case Message():
                    if record.channel_id not in channels:  # its declaration was in a damaged chunk
                        self.unreadable += 1
                        continue
                    key, schema, start_s = channels[record.channel_id]
                    yield Logged(
                        key,
                        schema,
                        record.data,
                        sequence_of(start_s, record.sequence),
                        record.publish_time,
                        record.log_time,
                    )
                case Schema():
                    schemas[record.id] = record.name
                case Channel():
                    start_s = int(record.metadata.get(_START, 0))
                    channels[record.id] = record.topic.removeprefix("/"), schemas.get(record.schema_id, ""), start_s
                case Metadata():
                    self.metadata[record.name] = record.metadata
                case AttachmentRecord():
                    self.attachments[record.name] = record.data
                case Footer():
                    self.complete = True

    def _records(self) -> Iterator[McapRecord]:
        """Records of the file up to its end, or to where it breaks off."""
        try:
            file = self.path.open("rb")
        except OSError as fault:
            raise DataFileError(f"{self.path} cannot be read: {fault.strerror}") from fault
        with file:
            reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=_LARGEST_RECORD_BYTES)
            try:
                for record in reader.records:
                    yield from self._chunk(record) if isinstance(record, Chunk) else (record,)
            except (EndOfFile, RecordLengthLimitExceeded, UnicodeDecodeError, struct.error):
                return  # it breaks off here: its recorder was killed, or is still writing
            except InvalidMagic as fault:
                raise DataFileError(f"{self.path} is not an MCAP file") from fault
            except (CRCValidationError, McapError) as fault:
                if not self._skip_damaged:
                    raise self._damaged(fault) from fault

    def _chunk(self, chunk: Chunk) -> list[McapRecord]:
        try:
            return breakup_chunk(chunk, validate_crc=True)
        except (CRCValidationError, McapError, RuntimeError, struct.error) as fault:
            if not self._skip_damaged:
                raise self._damaged(fault) from fault
            self.damaged_chunks += 1
            return []

    def _damaged(self, fault: Exception) -> DataFileError:
        return DataFileError(f"{self.path} is damaged ({fault}); `lowfc recover` saves what is whole")


def log_path(folder: Path, time_ns: int) -> Path:
    """Name for a log begun at `time_ns`, UTC, that no log in the folder has, finished or not."""
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime(time_ns // 1_000_000_000))
    for number in itertools.count(1):
        path = folder / (f"{stamp}Z.mcap" if number == 1 else f"{stamp}Z-{number}.mcap")
        if not path.exists() and not path.with_name(path.name + UNFINISHED).exists():
            return path
    raise AssertionError("unreachable")


def declaration(message: type[ProtobufMessage]) -> FileDescriptorSet:
    """Declaration of a message with all it imports, in the order that a reader needs them."""
    declared = FileDescriptorSet()
    seen: set[str] = set()

    def add(file: FileDescriptor) -> None:
        for imported in file.dependencies:
            add(imported)
        if file.name not in seen:
            seen.add(file.name)
            file.CopyToProto(declared.file.add())

    add(cast("FileDescriptor", message.DESCRIPTOR.file))
    return declared
