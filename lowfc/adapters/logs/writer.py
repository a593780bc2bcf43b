"""Writing logs: MCAP files that describe themselves, so that a crash costs at most the last fraction of a second.

A log is written as `<name>.mcap.part` and renamed when it is finished. What describes it (metadata, attachments)
stands at its start. A channel is one topic of one start of its publisher: MCAP's sequence has 32 bits and takes the
count, the channel's metadata the start.

What was flushed survives the death of the process, at any moment and in any way. It does not survive a loss of power:
only a finished log, when it has its name, is known to be on the disk itself.
"""

import contextlib
import fcntl
import itertools
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import TYPE_CHECKING, cast

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as ProtobufMessage
from mcap.writer import CompressionType, Writer

from lowfc import __version__
from lowfc.adapters.bus.bus import Sample
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import Topic, topic_of

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

UNFINISHED = ".part"
"""Appended to the name of a log that is being written, or was when its recorder died."""

FILE_MODE = 0o640
"""Permissions of a log, of which the process's umask may take more away: notes and frames are not for everybody."""

CHUNK_BYTES = 240 * 1024  # a chunk is closed by the message that passes this; with a frame it stays below 256 KiB
PART = "part"
"""Name of the metadata with the recording that a log belongs to, and its number there."""

START_KEY = "start_s"
"""Of a channel's metadata: the upper half of the sequences in it."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside a log."""

    name: str
    media_type: str
    data: bytes


class _File(FileIO):
    """A log's file: it knows its size without asking the system, and how long one write took at most."""

    def __init__(self, path: Path, mode: int) -> None:
        super().__init__(path, "x", opener=lambda name, flags: os.open(name, flags, mode))
        with contextlib.suppress(OSError):  # not every file system has locks
            fcntl.flock(self, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self.size = 0
        self.longest_write_ns = 0

    def write(self, data: "ReadableBuffer", /) -> int:
        begun_ns = time.monotonic_ns()
        written = super().write(data)
        self.longest_write_ns = max(self.longest_write_ns, time.monotonic_ns() - begun_ns)
        self.size += written
        return written

    def tell(self) -> int:
        return self.size


class LogWriter:
    """Writes one log.

    Attributes:
        path: what the log will be called when it is finished.
        part: what it is called until then.
        messages: messages written.
        messages_written: messages written up to the last flush.
        bytes_written: size of the file up to the last flush.
    """

    def __init__(
        self,
        path: Path,
        time_ns: int,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Sequence[Attachment] = (),
        file_mode: int = FILE_MODE,
    ) -> None:
        """Open `path` + ".part", with these permissions, and write what describes the log, made at `time_ns`.

        Raises:
            DataFileError: there is a log of that name, or the disk refuses.
        """
        self.path = path
        self.part = path.with_name(path.name + UNFINISHED)
        self.messages = self.messages_written = self.bytes_written = 0
        self._channels: dict[tuple[str, int], int] = {}
        self._schemas: dict[str, int] = {}
        if self.part.exists() or path.exists():
            raise DataFileError(f"{path} already exists; a log is never overwritten")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._raw = _File(self.part, file_mode)
        except OSError as fault:
            raise DataFileError(f"{self.part} cannot be made: {fault.strerror}") from fault
        self._file = BufferedWriter(self._raw)
        self._writer = Writer(
            self._file,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.LZ4,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        try:
            self._writer.start(profile="", library=f"lowfc {__version__}")
            self._describe(metadata)
            for attachment in attachments:
                self._writer.add_attachment(
                    create_time=time_ns,
                    log_time=time_ns,
                    name=attachment.name,
                    media_type=attachment.media_type,
                    data=attachment.data,
                )
            self._flush()
        except OSError as fault:
            raise self._refused(fault) from fault

    @property
    def longest_write_ns(self) -> int:
        """How long one write of this log took at most."""
        return self._raw.longest_write_ns

    def write(self, sample: Sample) -> None:
        """Add one message, its payload verbatim.

        Raises:
            DataFileError: the disk refuses; the log keeps what was flushed and takes no more.
            KeyError: there is no such topic.
        """
        try:
            self._writer.add_message(
                channel_id=self._channel(sample),
                log_time=sample.receive_time_ns,
                publish_time=sample.publish_time_ns,
                sequence=count_of(sample.sequence),
                data=sample.payload,
            )
        except OSError as fault:
            raise self._refused(fault) from fault
        self.messages += 1

    def flush(self) -> None:
        """Hand everything to the operating system: what was flushed survives a kill -9 of this process.

        Raises:
            DataFileError: as for `write`, or the file is no longer there.
        """
        try:
            self._flush()
        except OSError as fault:
            raise self._refused(fault) from fault

    def finish(self, metadata: Mapping[str, Mapping[str, str]]) -> Path:
        """Close the log, with what became known at its end, and give it its name once the disk has it.

        Raises:
            DataFileError: as for `write`.
        """
        try:
            self._flush()
            self._describe(metadata)
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._raw.fileno())
            self.bytes_written = self._raw.size
            self.part.rename(self.path)
            self._file.close()  # in this order: a file that is being recorded is locked until it has its name
        except OSError as fault:
            raise self._refused(fault) from fault
        with contextlib.suppress(OSError):  # not every file system has this for folders
            _sync_folder(self.path.parent)
        return self.path

    def abandon(self) -> None:
        """Close the log unfinished, cut back to its last flush."""
        if not self._raw.closed:
            with contextlib.suppress(OSError):
                self._raw.truncate(self.bytes_written)
            self._raw.close()

    def _describe(self, metadata: Mapping[str, Mapping[str, str]]) -> None:
        for name, entries in metadata.items():
            self._writer.add_metadata(name, dict(entries))

    def _flush(self) -> None:
        self._writer.flush()  # type: ignore[no-untyped-call]
        self.part.stat()  # a file that was removed takes data as if nothing had happened
        self.bytes_written = self._raw.size
        self.messages_written = self.messages

    def _refused(self, fault: OSError) -> DataFileError:
        """Turn a fault of the disk into one error, and cut the file back to whole records."""
        self.abandon()
        rest = "what is there is readable" if self.part.exists() else "somebody removed it"
        return DataFileError(
            f"{self.part} cannot be written ({fault.strerror}) after {self.bytes_written} bytes; "
            f"make room or record elsewhere; {rest}"
        )

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


def being_recorded(path: Path) -> bool:
    """Whether a recorder is writing this log, or was until now: it locks the file until it ends, in whatever way."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:  # finished since its name was looked up
        return path.name.endswith(UNFINISHED) and path.with_name(path.name.removesuffix(UNFINISHED)).exists()
    except OSError:  # reading it raises this again
        return False
    return False


def stem_of(log: Path) -> str:
    """Name of a log without its endings."""
    return log.name.removesuffix(UNFINISHED).removesuffix(".mcap")


def log_path(folder: Path, time_ns: int) -> Path:
    """Name for a log begun at `time_ns`, UTC, that no log in the folder has, finished or not."""
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime(time_ns // 1_000_000_000))
    for number in itertools.count(1):
        path = folder / (f"{stamp}Z.mcap" if number == 1 else f"{stamp}Z-{number}.mcap")
        # In this order: a log that is finished in between, by another thread, must not pass unseen.
        if not path.with_name(path.name + UNFINISHED).exists() and not path.exists():
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


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
