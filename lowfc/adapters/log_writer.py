"""Writing logs: MCAP files that describe themselves, so that a crash costs at most the last fraction of a second.

A log is written as `<name>.mcap.part` and renamed when it is finished. What describes it (metadata, attachments)
stands at its start. A channel is one topic of one start of its publisher: MCAP's sequence has 32 bits and takes the
count, the channel's metadata the start.
"""

import contextlib
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import cast

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as ProtobufMessage
from mcap.writer import CompressionType, Writer

from lowfc import __version__
from lowfc.adapters.bus import Sample
from lowfc.adapters.envelope import count_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import Topic, topic_of

UNFINISHED = ".part"
"""Appended to the name of a log that is being written, or was when its recorder died."""

_CHUNK_BYTES = 240 * 1024  # a chunk is closed by the message that passes this; with a frame it stays below 256 KiB
START_KEY = "start_s"
"""Of a channel's metadata: the upper half of the sequences in it."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside a log."""

    name: str
    media_type: str
    data: bytes


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
                    START_KEY: str(start_s),
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
