"""Writing logs: self-describing MCAP files that lose at most the last fraction of a second in a crash.

A log is written as `<name>.mcap.part` and renamed when it is finished. Its attachments and first metadata are at its
start, its totals at its end. A channel is one topic from one start of its publisher: MCAP's 32-bit sequence is the
publisher's count of messages, and the channel's metadata contain the start.

Flushed data survive any death of the process, but not a loss of power: only a finished log with its final name is known
to be on the disk.
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
from typing import IO, TYPE_CHECKING, cast

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message as ProtobufMessage
from mcap.writer import CompressionType, Writer

from lowfc import __version__
from lowfc.adapters.bus.bus import Sample
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import DataFileError, raised_as
from lowfc.contract.messages import Topic, topic_of
from lowfc.contract.printable import encodable

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

UNFINISHED = ".part"
"""Suffix of a log that is being written, or whose recorder died."""

FILE_MODE = 0o640
"""Default permissions of a log, further reduced by the umask: notes and frames are not public."""

CHUNK_BYTES = 240 * 1024
"""The message with which a chunk exceeds this size ends it; with messages of up to 15 KiB, it stays below 256 KiB."""

PART = "part"
"""Name of the metadata with the recording that a file belongs to, and the file's number in it."""

START_KEY = "start_s"
"""Key of the publisher's start, the upper half of the sequences, in a channel's metadata."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file attached to a log."""

    name: str
    media_type: str
    data: bytes


class _File(FileIO):
    """File of a log; it keeps track of its size and of the longest call that writes to it."""

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

    If the disk refuses a write, methods raise DataFileError, and the log is closed, truncated to its last flush.

    Attributes:
        path: final name of the log.
        part: name of the log until it is finished.
        messages: number of messages written.
        messages_written: number of messages written up to the last flush.
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
        """Create `path` + ".part" with permissions `file_mode`; write metadata, and attachments dated `time_ns`.

        Raises:
            DataFileError: a log of that name exists, or the disk refuses a write.
        """
        self.path = path
        self.part = path.with_name(path.name + UNFINISHED)
        self.messages = self.messages_written = self.bytes_written = 0
        self._channels: dict[tuple[str, int], int] = {}
        self._schemas: dict[str, int] = {}
        if self.part.exists() or path.exists():
            raise DataFileError(f"{path} already exists; a log is never overwritten")
        with raised_as(DataFileError, OSError, f"{self.part} cannot be created"):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._raw = _File(self.part, file_mode)
        self._file = BufferedWriter(self._raw)
        try:
            self._writer = begun_writer(self._file)
            self._add_metadata(metadata)
            for attachment in attachments:
                self._writer.add_attachment(
                    create_time=time_ns,
                    log_time=time_ns,
                    name=encodable(attachment.name),
                    media_type=attachment.media_type,
                    data=attachment.data,
                )
            self.flush()
        except OSError as fault:
            raise self._refused(fault) from fault

    @property
    def longest_write_ns(self) -> int:
        """Longest duration of a call that writes to the file, ns."""
        return self._raw.longest_write_ns

    def write(self, sample: Sample) -> None:
        """Add a message with its payload unchanged; KeyError if its key belongs to no topic."""
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
        """Pass everything to the operating system; flushed data survive a kill -9 of this process."""
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
            self.part.stat()  # detects a removed file, which still accepts data
            self.bytes_written = self._raw.size
            self.messages_written = self.messages
        except OSError as fault:
            raise self._refused(fault) from fault

    def finish(self, metadata: Mapping[str, Mapping[str, str]]) -> Path:
        """Write the final metadata, close the log, and rename it once it is on the disk."""
        try:
            self.flush()
            self._add_metadata(metadata)
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._raw.fileno())
            self.bytes_written = self._raw.size
            self.part.rename(self.path)
            self._file.close()  # after the rename: the file is locked until it has its final name
        except OSError as fault:
            raise self._refused(fault) from fault
        with contextlib.suppress(OSError):  # not every file system supports this
            _sync_folder(self.path.parent)
        return self.path

    def abandon(self) -> None:
        """Close the log unfinished, truncated to its last flush; remove it if nothing was flushed."""
        if not self._raw.closed:
            with contextlib.suppress(OSError):
                self._raw.truncate(self.bytes_written)
                if not self.bytes_written:
                    self.part.unlink()
            self._raw.close()

    def _add_metadata(self, metadata: Mapping[str, Mapping[str, str]]) -> None:
        for name, entries in metadata.items():
            self._writer.add_metadata(name, {key: encodable(value) for key, value in entries.items()})

    def _refused(self, fault: OSError) -> DataFileError:
        """Close the log, truncated to complete records, and return the error for a disk that refused a write."""
        self.abandon()
        state = "its content is readable" if self.part.exists() else "the file was removed"
        return DataFileError(
            f"{self.part} cannot be written ({fault.strerror}) after {self.bytes_written} bytes; "
            f"free some space or record elsewhere; {state}"
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
                    "description": topic.description,
                    "publisher": ", ".join(sorted(topic.publishers)),
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


def begun_writer(file: IO[bytes]) -> Writer:
    """Writer of an MCAP file with all checksums; the file's header is already written."""
    writer = Writer(
        file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4, enable_crcs=True, enable_data_crcs=True
    )
    writer.start(profile="", library=f"lowfc {__version__}")
    return writer


def being_recorded(path: Path) -> bool:
    """Whether a recorder is writing this log: it holds a lock on the file until it ends or dies."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:  # finished meanwhile
        return path.name.endswith(UNFINISHED) and path.with_name(path.name.removesuffix(UNFINISHED)).exists()
    except OSError:  # reading the file raises this again
        return False
    return False


def stem_of(log: Path) -> str:
    """Name of a log without its suffixes."""
    return log.name.removesuffix(UNFINISHED).removesuffix(".mcap")


def log_path(folder: Path, time_ns: int) -> Path:
    """Unused path for a log that begins at `time_ns`, named by UTC time."""
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime(time_ns // 1_000_000_000))
    for number in itertools.count(1):
        path = folder / (f"{stamp}Z.mcap" if number == 1 else f"{stamp}Z-{number}.mcap")
        # In this order, so that a log that another thread finishes in between is detected.
        if not path.with_name(path.name + UNFINISHED).exists() and not path.exists():
            return path
    raise AssertionError("unreachable")


def declaration(message: type[ProtobufMessage]) -> FileDescriptorSet:
    """Descriptors of the .proto file that declares a message and of its imports, imports first, as readers require."""
    declared = FileDescriptorSet()
    added: set[str] = set()

    def add(file: FileDescriptor) -> None:
        for imported in file.dependencies:
            add(imported)
        if file.name not in added:
            added.add(file.name)
            file.CopyToProto(declared.file.add())

    add(cast("FileDescriptor", message.DESCRIPTOR.file))
    return declared


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
