"""Reading logs, finished or not: messages in recorded order, with all checksums checked."""

import re
import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.chunk import Chunk, UnsoundError
from lowfc.adapters.logs.records import HEAD, Damage, LogFile, parsed
from lowfc.adapters.logs.selection import Selection
from lowfc.adapters.logs.writer import START_KEY
from lowfc.contract.envelope import COUNT_BITS, sequence_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import Topic

_PREFIX_BYTES = 64  # identifies a chunk together with its 32-bit CRC, which two of a night's chunks may share
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel id, count, log time, publish time


class LogReader:
    """Reads a log from its start, finished or not, and checks every checksum.

    No message of a damaged chunk is delivered.

    Attributes:
        path: path of the log.
        paths: files of the log; here only `path`.
        size: size of the log when reading began, bytes.
        position: number of bytes read so far.
        records: metadata and attachments read so far, in order; those at the start are read before any message.
        schemas: schemas declared so far, by id.
        channels: channels declared so far, by key and start of the publisher.
        damage: damaged stretches that were left out.
        unreadable: number of messages left out because the record of their channel or schema was damaged.
        finished: whether the log has the end of a finished log; False during recording, or if its recorder died.
        complete: whether the end was reached with a valid summary; False while reading.
        progress: function called with the progress of reading, see `__init__`.
    """

    def __init__(
        self,
        path: Path,
        progress: Callable[[int, int], None] | None = None,
        *,
        topics: Collection[Topic] | None = None,
        skip_damaged: bool = False,
        from_ns: int = 0,
        always: Collection[Topic] = (),
        sparse: bool = False,
    ) -> None:
        """Read the log at `path`.

        Args:
            path: path of the log, with any name.
            progress: called at intervals with the bytes read and their total.
            topics: topics whose messages are delivered; None: all.
            skip_damaged: whether to leave out damaged stretches instead of raising an error.
            from_ns: log time, ns; chunks known to end before it are skipped.
            always: topics exempt from `from_ns`: a chunk with a message of any of them is read, with all its messages.
            sparse: whether to skip chunks without messages of `topics`, by their indexes: for topics with few messages
                in a long log. The checksums of skipped chunks, and then of the data section, are not checked.
        """
        self.path = path
        self.paths: tuple[Path, ...] = (path,)
        self.progress = progress
        self.size = 0
        self.position = 0
        self.records: list[Metadata | Attachment] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[tuple[str, int], Channel] = {}
        self.damage: list[Damage] = []
        self.unreadable = 0
        self.finished = False
        self.complete = False
        self._topics = topics
        self._skip_damaged = skip_damaged
        self._from_ns = from_ns
        self._always = always
        self._sparse = sparse
        self._declared: dict[int, Channel] = {}
        self._delivered: dict[int, tuple[str, int] | None] = {}  # by channel id: key and first sequence; None: excluded
        self._chunks: set[int] = set()  # identities of the intact chunks
        self._last_ns: int | None = None
        self._dated_damage = 0  # number of entries of `damage` whose `before_ns` is set
        self._has_chunks = False

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata read so far, by name."""
        return {record.name: record.metadata for record in self.records if isinstance(record, Metadata)}

    @property
    def attachments(self) -> dict[str, bytes]:
        """Attachments read so far, by name."""
        return {record.name: record.data for record in self.records if isinstance(record, Attachment)}

    @property
    def selection(self) -> Selection:
        """The selection that the log was recorded with."""
        return Selection.of(self.metadata)

    def __iter__(self) -> Iterator[Sample]:
        """Messages in recorded order; to be called once.

        Raises:
            DataFileError: the file is not a log, or a part of it is damaged.
        """
        with LogFile(self.path) as file:
            self.size, self.finished, self._file = file.size, file.finished, file
            if (declarations := file.declarations()) is not None:
                self._chunk(declarations)
            for part in file.parts(self._needs if self._sparse or self._from_ns else None):
                match part:
                    case Chunk():
                        self._has_chunks = True
                        self.position = part.position + part.length
                        if self.progress is not None:
                            self.progress(self.position, self.size)
                        yield from self._chunk(part)
                    case Damage():
                        self._leave_out(part)
                    case _:
                        self.records.append(part)
            self.position = self.size
            self.complete = file.complete
        if file.unsupported_compression and not self._has_chunks:
            raise self._error(0, "")
        if self.damage and not (self.damage[0].position or self.records or self._chunks):
            raise DataFileError(f"{self.path} is not an MCAP file")

    def _needs(self, end_ns: int, channels: Collection[int]) -> bool:
        """Whether to read a chunk with these channels that ends at `end_ns`; it may declare an unknown channel."""
        if any(channel_id not in self._delivered for channel_id in channels):
            return True
        if end_ns < self._from_ns:
            keys = [self._declared[channel_id].topic.removeprefix("/") for channel_id in channels]
            return any(topic.matches(key) for topic in self._always for key in keys)
        return not self._sparse or any(self._delivered[channel_id] for channel_id in channels)

    def _chunk(self, chunk: Chunk) -> list[Sample]:
        """Messages of a chunk; none of a repeated or inconsistent chunk, which counts as damage."""
        identity = hash((chunk.crc, chunk.content[:_PREFIX_BYTES]))
        try:
            if identity in self._chunks:
                raise UnsoundError("a chunk occurs a second time")
            messages = self._messages(chunk.content)
        except UnsoundError as fault:
            self._leave_out(Damage(chunk.position, chunk.length, str(fault)))
            return []
        self._chunks.add(identity)
        if self.unreadable and not self._skip_damaged:
            raise self._error(chunk.position, "the record of a channel or schema is missing")
        if messages:
            for damage in self.damage[self._dated_damage :]:
                damage.before_ns = messages[0].receive_time_ns
            self._dated_damage = len(self.damage)
            self._last_ns = messages[-1].receive_time_ns
        return messages

    def _messages(self, content: bytes) -> list[Sample]:
        """Decode a chunk's messages of the selected topics and store its declarations; UnsoundError if inconsistent."""
        samples: list[Sample] = []
        delivered, at, end = self._delivered, 0, len(content)
        read_head, read_message, make_sample = HEAD.unpack_from, _MESSAGE_HEAD.unpack_from, Sample._make
        message_opcode, head_bytes, message_bytes = int(Opcode.MESSAGE), HEAD.size, HEAD.size + _MESSAGE_HEAD.size
        try:
            while at < end:
                opcode, length = read_head(content, at)
                begin, at = at, at + head_bytes + length
                if opcode == message_opcode:
                    channel_id, count, receive_time_ns, publish_time_ns = read_message(content, begin + head_bytes)
                    channel = delivered.get(channel_id)
                    if channel is not None:
                        key, start = channel
                        payload = content[begin + message_bytes : at]
                        samples.append(make_sample((key, payload, start | count, publish_time_ns, receive_time_ns)))
                    elif channel_id not in delivered:
                        self.unreadable += 1
                elif opcode == Opcode.SCHEMA:
                    schema = parsed(Schema, content[begin + head_bytes : at])
                    if self.schemas.setdefault(schema.id, schema) != schema:
                        raise UnsoundError(f"schema {schema.id} is declared a second time, differently")
                elif opcode == Opcode.CHANNEL:
                    self._declare_channel(parsed(Channel, content[begin + head_bytes : at]))
        except struct.error as fault:
            raise UnsoundError("a record in a chunk extends beyond the chunk") from fault
        if at > end:
            raise UnsoundError("a record in a chunk extends beyond the chunk")
        return samples

    def _declare_channel(self, channel: Channel) -> None:
        if self._declared.setdefault(channel.id, channel) != channel:
            raise UnsoundError(f"channel {channel.id} is declared a second time, differently")
        if channel.schema_id and channel.schema_id not in self.schemas:
            return  # the schema's declaration was in a damaged chunk: the channel's messages are unreadable
        start = channel.metadata.get(START_KEY, "0")
        start_s = int(start) if re.fullmatch("[0-9]{1,10}", start) else -1
        if not 0 <= start_s < 1 << COUNT_BITS:
            raise UnsoundError(f"channel {channel.id} has {START_KEY} {start!r}, not a time in seconds")
        key = channel.topic.removeprefix("/")
        self.channels[key, start_s] = channel
        selected = self._topics is None or any(topic.matches(key) for topic in self._topics)
        self._delivered[channel.id] = (key, sequence_of(start_s, 0)) if selected else None

    def schema_of(self, message: Sample) -> str:
        """Full name of the protobuf type of a delivered message; empty if another tool wrote it without a schema."""
        schema_id = self.channels[message.key, start_of(message.sequence)].schema_id
        return self.schemas[schema_id].name if schema_id else ""

    def _leave_out(self, damage: Damage) -> None:
        if not self._skip_damaged:
            raise self._error(damage.position, damage.why)
        damage.after_ns = self._last_ns
        self.damage.append(damage)

    def _error(self, position: int, why: str) -> DataFileError:
        if self._file.unsupported_compression and not self._has_chunks:
            return DataFileError(
                f"{self.path} is compressed with {self._file.unsupported_compression!r}; lz4, zstd and no compression "
                "are supported: compress it again with `mcap compress --compression zstd`"
            )
        if position == 0:
            return DataFileError(f"{self.path} is not an MCAP file; if it was one, `lowfc recover` saves intact parts")
        return DataFileError(f"{self.path} is damaged at byte {position} ({why}); `lowfc recover` saves intact parts")
