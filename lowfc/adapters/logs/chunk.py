"""Chunks of a log, checked and decompressed, with any compression of MCAP."""

import re
import struct
import zlib
from collections.abc import Callable
from typing import NamedTuple

import lz4.frame
import zstandard

MAX_BYTES = 1 << 28
"""Largest accepted size of a record, compressed or not: a damaged length must not use up the memory."""

CHUNK_START = re.compile(
    rb"\x06(?=.{36}(?:\x03\x00{3}lz4.{8}\x04\x22\x4d\x18|\x04\x00{3}zstd.{8}\x28\xb5\x2f\xfd|\x00{4}.{8}[\x03-\x05].{4}\x00{4}))",
    re.DOTALL,
)
"""Pattern that finds a chunk: its opcode, its head with a supported compression, and the start of its content."""

_HEAD = struct.Struct("<QQQII")  # times of first and last message; size and CRC when decompressed; length of a name
_COMPRESSED_SIZE = struct.Struct("<Q")  # after the name of the compression
_RECORD_HEAD_BYTES = 9  # opcode and length
_MAX_NAME_LENGTH = 40  # of an unsupported compression, in an error


class UnsoundError(Exception):
    """A part of a log is damaged; the text is the reason."""


class CompressionError(UnsoundError):
    """A chunk has an unsupported compression."""

    def __init__(self, name: str) -> None:
        super().__init__(f"a chunk is compressed with {name!r}; lz4, zstd and no compression are supported")
        self.name = name


class Chunk(NamedTuple):
    """A decompressed chunk: messages, and declarations of schemas and channels.

    Attributes:
        position: first byte of the chunk in the file.
        length: size of the chunk in the file, bytes.
        crc: CRC-32 of `content`.
        content: concatenated records.
    """

    position: int
    length: int
    crc: int
    content: bytes


def _zstd(data: memoryview, size: int) -> bytes:
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
        return stream.read(size)


# Decompressor of each compression, and the largest ratio of decompressed to compressed size (zstd: any).
_COMPRESSIONS: dict[bytes, tuple[Callable[[memoryview, int], bytes], int]] = {
    b"lz4": (lambda data, size: lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size), 255),
    b"zstd": (_zstd, MAX_BYTES),
    b"": (lambda data, size: bytes(data[:size]), 1),
}


def read_chunk(body: bytes, position: int, *, may_lack_crc: bool = False) -> Chunk:
    """Decompress and check a chunk.

    Args:
        body: record of the chunk, without opcode and length.
        position: position of the record in the file, bytes.
        may_lack_crc: whether to accept a chunk without a checksum.

    Raises:
        UnsoundError: the chunk is damaged.
        CompressionError: its compression is not supported.
    """
    try:
        _, _, size, crc, name_length = _HEAD.unpack_from(body)
        (compressed,) = _COMPRESSED_SIZE.unpack_from(body, _HEAD.size + name_length)
    except struct.error as fault:
        raise UnsoundError("a chunk is too short") from fault
    begin = _HEAD.size + name_length + _COMPRESSED_SIZE.size
    if compressed != len(body) - begin:
        raise UnsoundError("the head of a chunk is damaged")
    name = body[_HEAD.size : _HEAD.size + name_length]
    if name not in _COMPRESSIONS:
        raise CompressionError(name[:_MAX_NAME_LENGTH].decode(errors="backslashreplace"))
    decompress, largest_ratio = _COMPRESSIONS[name]
    if not 0 < size <= min(MAX_BYTES, largest_ratio * compressed):
        raise UnsoundError("a chunk declares an impossible size")
    try:
        content = decompress(memoryview(body)[begin:], size)
    except (RuntimeError, EOFError, zstandard.ZstdError) as fault:
        raise UnsoundError("a chunk cannot be decompressed") from fault
    computed = zlib.crc32(content)
    if computed != crc and not (may_lack_crc and crc == 0 and len(content) == size):
        raise UnsoundError("the checksum of a chunk is wrong")
    return Chunk(position, _RECORD_HEAD_BYTES + len(body), computed, content)
