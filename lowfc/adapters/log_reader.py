"""Reading logs, finished or not: messages in the order they were recorded, every checksum checked."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from lowfc.adapters.envelope import sequence_of
from lowfc.adapters.log_writer import START_KEY
from lowfc.contract.errors import DataFileError

_LARGEST_RECORD_BYTES = 1 << 30


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
                    start_s = int(record.metadata.get(START_KEY, 0))
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
