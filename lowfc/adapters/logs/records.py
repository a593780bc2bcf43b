"""Records of a log file: reads intact records, and finds damaged stretches and a truncated end.

Everything is checked by checksums. In a finished log they cover every byte: each chunk and attachment has its own,
DataEnd contains that of the data section, the footer that of the summary. A log rewritten by another tool may lack
checksums and chunks; a log written by lowfc may lack only the checksum of the data section.
"""

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, ChunkIndex, Header, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC as MAGIC

from lowfc.adapters.logs.chunk import CHUNK_START, MAX_BYTES, Chunk, CompressionError, UnsoundError, read_chunk
from lowfc.adapters.logs.writer import UNFINISHED
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import DataFileError

HEAD = struct.Struct("<BQ")
"""Header of every record: opcode, and length of the rest."""

_FOOTER_BYTES = HEAD.size + 20 + len(MAGIC)
_BLOCK_BYTES = 1 << 20
_MAY_FOLLOW = {Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END}
_CHANGED = "its parts are intact, but some are missing or out of order, or bytes between them changed"
_BEGIN = MAGIC + bytes([Opcode.HEADER])
_OF_CHUNKS = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
_FIRST_BLOCK_BYTES = 1 << 12
_TRIES = 4
"""Candidates for chunks are read up to this many times the file's size: no file may occupy the search for long."""


@dataclass(slots=True)
class Damage:
    """A damaged stretch of a log, which is left out.

    Attributes:
        position: first byte of the stretch.
        length: size of the stretch, bytes.
        why: reason.
        after_ns: log time of the last message delivered before it; None before the first.
        before_ns: log time of the next message delivered; None after the last.
    """

    position: int
    length: int
    why: str
    after_ns: int | None = None
    before_ns: int | None = None


class LogFile:
    """A log file open for reading up to its present end; a context manager.

    Attributes:
        path: path of the file.
        size: size of the file when opened, bytes.
        finished: whether it ends as a finished log.
        complete: whether the file is finished and was read up to a valid summary; set at the end of `parts`.
        unsupported_compression: name of the compression of an unsupported chunk; empty if there is none.
    """

    def __init__(self, path: Path) -> None:
        """Open the log at `path`; DataFileError if the file cannot be read."""
        self.path = path
        self.complete = False
        self.unsupported_compression = ""
        try:
            self._file = input_file.opened(path, input_file.UNBOUNDED)
            self.size = self._file.seek(0, io.SEEK_END)
        except OSError as fault:
            finished = Path(str(path).removesuffix(UNFINISHED))
            hint = f"; it is finished now: {finished}" if finished != path and os.access(finished, os.F_OK) else ""
            raise DataFileError(f"{path} cannot be read: {fault.strerror}{hint}") from fault
        if not self.size:
            self._file.close()
            raise DataFileError(f"{path} is empty: nothing was recorded")
        self.finished = self.size > len(MAGIC) and self._read(self.size - len(MAGIC), len(MAGIC)) == MAGIC
        self._by_lowfc = self._is_by_lowfc()
        self._summary = self._find_summary()
        self._bytes_to_try = _TRIES * self.size

    def __enter__(self) -> "LogFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def declarations(self) -> Chunk | None:
        """Schemas and channels declared in the summary, as a chunk; None without a valid summary."""
        if self._summary is None:
            return None
        content = b"".join(self._in_summary(Opcode.SCHEMA, Opcode.CHANNEL))
        return Chunk(self._summary, len(content), zlib.crc32(content), content)

    def index(self) -> Iterator[ChunkIndex]:
        """Index of each chunk from the summary, in file order, up to a damaged one."""
        with contextlib.suppress(UnsoundError):
            for record in self._in_summary(Opcode.CHUNK_INDEX):
                yield parsed(ChunkIndex, record[HEAD.size :])

    def parts(
        self, needed: Callable[[int, Collection[int]], bool] | None = None
    ) -> Iterator[Chunk | Metadata | Attachment | Damage]:
        """Content of the file, in order.

        `needed` is called with the end (log time) of each indexed chunk and the ids of its channels; if it returns
        False, the chunk is skipped unread.

        Raises:
            DataFileError: the file cannot be read.
        """
        magic = self._read(0, len(MAGIC))
        begins = MAGIC.startswith(magic)
        at, crc, intact = len(MAGIC), zlib.crc32(magic), begins
        if not begins:
            yield Damage(0, len(magic), "it does not begin like an MCAP file")
        while at < self.size:
            head = self._read(at, HEAD.size)
            opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, self.size)
            end = at + HEAD.size + length
            if needed and opcode == Opcode.CHUNK and end <= self.size:
                end_ns = int.from_bytes(self._read(at + HEAD.size + 8, 8), "little")
                if (channels := self._channels_after(end)) and not needed(end_ns, channels):
                    at, intact = end, False  # the checksum of the data section cannot be computed without this chunk
                    continue
            try:
                if opcode in _OF_CHUNKS and self._unchunked and (content := self._unchunked_records(at)):
                    yield Chunk(at, len(content), zlib.crc32(content), content)
                    crc, at = zlib.crc32(content, crc), at + len(content)
                    continue
                if end > self.size or length > MAX_BYTES:
                    raise UnsoundError("a record has an impossible length")
                body = self._read(at + HEAD.size, length)
                if opcode == Opcode.DATA_END and length == 4 and self._summary in (None, end):
                    if intact and int.from_bytes(body, "little") not in (0, crc):
                        yield Damage(at, 0, _CHANGED)
                    if self._summary is None and (second := self._appended(end - len(MAGIC), self.size)):
                        yield second
                    elif self.finished and self._summary is None:
                        yield Damage(end, self.size - end, "the summary is damaged, or another file was appended")
                    self.complete = self._summary is not None
                    return
                crc = zlib.crc32(body, zlib.crc32(head, crc))
                part = self._part(opcode, body, at)
            except UnsoundError as fault:
                resumed = self._resume(at, end)
                # Stop at an appended log: it uses the same ids for other channels.
                if begins and (second := self._appended(max(1, at - len(MAGIC)), resumed)):
                    if at < second.position:
                        yield Damage(at, second.position - at, str(fault))
                    yield second
                    return
                if resumed == self.size < end and not self.finished:
                    return  # the last record is truncated
                intact = False
                yield Damage(at, resumed - at, str(fault))
                at = resumed
            else:
                if part is not None:
                    yield part
                at = end

    def _appended(self, at: int, end: int) -> Damage | None:
        """Another log that begins between `at` and `end`, as damage to the end of the file; None without one."""
        for begin in range(at, end, _BLOCK_BYTES):
            block = self._read(begin, min(_BLOCK_BYTES, end - begin) + len(MAGIC))
            if (offset := block.find(_BEGIN)) >= 0:
                copy = f"`tail -c +{begin + offset + 1} {self.path.name} > second.mcap` copies it"
                why = f"it is another log, appended to this one; {copy}"
                return Damage(begin + offset, self.size - begin - offset, why)
        return None

    def _find_summary(self) -> int | None:
        """First byte of the summary, or of the footer if there is no summary.

        None without an intact footer, or if a required checksum is wrong or missing.
        """
        footer_at = self.size - _FOOTER_BYTES
        footer = self._read(footer_at, _FOOTER_BYTES) if self.finished and footer_at > 0 else b""
        if not footer or HEAD.unpack_from(footer) != (Opcode.FOOTER, 20):
            return None
        start, _, stored = struct.unpack_from("<QQI", footer, HEAD.size)
        if not self._by_lowfc and not (start and stored):
            start = start or footer_at  # without a summary only the footer follows the data
            return start if len(MAGIC) <= start <= footer_at else None
        if not len(MAGIC) <= start < footer_at:
            return None
        crc = 0
        for at in range(start, footer_at, _BLOCK_BYTES):
            crc = zlib.crc32(self._read(at, min(_BLOCK_BYTES, footer_at - at)), crc)
        return start if zlib.crc32(footer[: HEAD.size + 16], crc) == stored else None

    def _channels_after(self, at: int) -> list[int]:
        """Ids of the channels in the message indexes at `at`, after a chunk; empty without an index."""
        channels = []
        while len(head := self._read(at, HEAD.size + 2)) == HEAD.size + 2:
            opcode, length = HEAD.unpack_from(head)
            if opcode != Opcode.MESSAGE_INDEX or at + HEAD.size + length > self.size:
                break
            channels.append(int.from_bytes(head[HEAD.size :], "little"))
            at += HEAD.size + length
        return channels

    def _resume(self, at: int, end: int) -> int:
        """Position to continue after a damaged record.

        It is the record's end if a record begins there, else the next intact chunk, else the end of the data.
        """
        if end == self.size:
            return end
        if end < self.size:
            head = self._read(end, HEAD.size)
            if len(head) == HEAD.size:
                opcode, length = HEAD.unpack(head)
                if opcode in _MAY_FOLLOW and end + HEAD.size + length <= self.size:
                    return end
            self._bytes_to_try -= min(end - at, MAX_BYTES)  # these bytes have been read once already
        start, block = at + 1, _FIRST_BLOCK_BYTES
        while start < self.size and self._bytes_to_try > 0:
            for match in CHUNK_START.finditer(self._read(start, block + 64)):
                if self._intact_chunk_at(start + match.start()):
                    return start + match.start()
            start, block = start + block, min(2 * block, _BLOCK_BYTES)
        data_end = 0 if self._summary is None else self._summary - HEAD.size - 4
        return data_end if data_end > at else self.size

    def _intact_chunk_at(self, at: int) -> bool:
        _, length = HEAD.unpack(self._read(at, HEAD.size))
        at += HEAD.size
        if at + length > self.size or length > min(MAX_BYTES, self._bytes_to_try):
            return False
        try:
            self._bytes_to_try -= length
            read_chunk(self._read(at, length), at, may_lack_crc=not self._by_lowfc)
        except UnsoundError:
            return False
        return True

    def _part(self, opcode: int, body: bytes, at: int) -> Chunk | Metadata | Attachment | None:
        """Decode a record of the data section; None for an index or header, UnsoundError if it is damaged."""
        if opcode not in (Opcode.CHUNK, Opcode.ATTACHMENT) and _BEGIN in body:
            raise UnsoundError("a record is cut off")
        match opcode:
            case Opcode.CHUNK:
                try:
                    return read_chunk(body, at, may_lack_crc=not self._by_lowfc)
                except CompressionError as fault:
                    self.unsupported_compression = fault.name
                    raise
            case Opcode.ATTACHMENT:
                crc = int.from_bytes(body[-4:], "little")
                if crc != zlib.crc32(body[:-4]) and (crc or self._by_lowfc):
                    raise UnsoundError("the checksum of an attachment is wrong")
                return parsed(Attachment, body)
            case Opcode.METADATA:
                return parsed(Metadata, body)
            case Opcode.MESSAGE_INDEX:
                if len(body) < 6 or int.from_bytes(body[2:6], "little") != len(body) - 6:
                    raise UnsoundError("an index of messages is damaged")
            case Opcode.HEADER if at == len(MAGIC):
                pass
            case Opcode.MESSAGE | Opcode.SCHEMA | Opcode.CHANNEL:
                raise UnsoundError("a record is outside the chunks, without a checksum")
            case _:
                raise UnsoundError("no record begins here")
        return None

    def _is_by_lowfc(self) -> bool:
        """Whether the header names lowfc as the writer, which requires checksums; True if the header is damaged."""
        head = self._read(len(MAGIC), HEAD.size)
        opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
        if opcode != Opcode.HEADER or length > _BLOCK_BYTES:
            return True
        try:
            header = parsed(Header, self._read(len(MAGIC) + HEAD.size, length))
        except UnsoundError:
            return True
        return header.library.startswith("lowfc ")

    @cached_property
    def _unchunked(self) -> bool:
        """Whether messages may be outside chunks."""
        records = (parsed(Statistics, record[HEAD.size :]) for record in self._in_summary(Opcode.STATISTICS))
        return not self._by_lowfc or any(not statistics.chunk_count for statistics in records)

    def _unchunked_records(self, at: int) -> bytes:
        """Complete records from `at` on, of the kinds that are usually in chunks, until they reach 1 MiB in total."""
        end = at
        while end - at < _BLOCK_BYTES and len(head := self._read(end, HEAD.size)) == HEAD.size:
            opcode, length = HEAD.unpack(head)
            if opcode not in _OF_CHUNKS or length > MAX_BYTES or end + HEAD.size + length > self.size:
                break
            end += HEAD.size + length
        return self._read(at, end - at)

    def _in_summary(self, *opcodes: Opcode) -> Iterator[bytes]:
        """Records of some kinds in the summary, up to one of impossible length; nothing without a valid summary."""
        at, end = self.size if self._summary is None else self._summary, self.size - _FOOTER_BYTES
        while at < end:
            opcode, length = HEAD.unpack(self._read(at, HEAD.size))
            if length > min(MAX_BYTES, end - at - HEAD.size):
                return
            if opcode in opcodes:
                yield self._read(at, HEAD.size + length)
            at += HEAD.size + length

    def _read(self, at: int, length: int) -> bytes:
        try:
            self._file.seek(at)
            return self._file.read(length)
        except OSError as fault:
            raise DataFileError(f"{self.path} cannot be read: {fault.strerror}") from fault


_Record = TypeVar("_Record", Attachment, ChunkIndex, Header, Metadata, Schema, Statistics, Channel)


def parsed(kind: type[_Record], body: bytes) -> _Record:
    """Decode a record of this kind; UnsoundError if the body is not such a record."""
    stream = ReadDataStream(io.BytesIO(body))
    try:
        record: _Record = kind.read(stream)
    except (McapError, UnicodeDecodeError, struct.error) as fault:
        raise UnsoundError(f"a record ({kind.__name__.lower()}) cannot be read") from fault
    return record
