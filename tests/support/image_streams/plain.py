"""Reader and writer of ImageStreamIO streams after the published layout, independent of the code of lowfc.

Byte offsets are explicit, packed and unpacked with `struct`.
"""

import ctypes
import mmap
import os
import struct
import time
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

LIBC = ctypes.CDLL(None, use_errno=True)
UINT16, INT32, FLOAT32 = 3, 6, 9  # codes of pixel types
NUMPY_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "u8", 8: "i8", 9: "f4", 10: "f8"}
HEADER, KEYWORD, SEMAPHORE, TRACE = 384, 128, 32, 64  # sizes, bytes


def file_of(folder: Path, name: str) -> Path:
    return folder / f"{name}.im.shm"


class PlainStream:
    """A mapped stream; positions of its parts are computed from the arguments, never from the header."""

    def __init__(
        self, path: Path, columns: int, rows: int, pixel_type: int, planes: int = 1, keywords: int = 0
    ) -> None:
        self.type, self.shape = np.dtype(NUMPY_TYPES[pixel_type]), (planes, rows, columns)
        self.file = os.open(path, os.O_RDWR)
        self.map = mmap.mmap(self.file, os.fstat(self.file).st_size)
        length = planes * rows * columns * self.type.itemsize
        self.data = HEADER
        self.keywords = self.data + (length + 7) // 8 * 8
        self.semaphores = self.keywords + KEYWORD * keywords
        self.readers = self.semaphores + 11 * SEMAPHORE  # ten for readers, and one for the log
        self.writers = self.readers + 40  # ten process ids of four bytes each
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(self.map))

    @classmethod
    def make(
        cls,
        path: Path,
        columns: int,
        rows: int,
        pixel_type: int,
        *,
        planes: int = 1,
        version: bytes = b"2.00",
        header_bytes: int = HEADER,
        keywords: dict[str, float | str | int] | None = None,
        location: int = -1,
        kind: int = 2,
        axes: int = 2,
    ) -> Self:
        """Create a stream as the C library does: unlink an existing file; write the version of the layout last."""
        keyword_values = keywords or {}
        itemsize = np.dtype(NUMPY_TYPES.get(pixel_type, "f8")).itemsize
        elements = columns * rows * planes
        length = (elements * itemsize + 7) // 8 * 8
        # A circular buffer also has the times and a counter of each plane.
        ring_bytes = planes * 40 if kind & 0xF000F == 0x20001 else 0
        path.unlink(missing_ok=True)
        with path.open("wb") as file:
            os.fchmod(file.fileno(), 0o666)
            tail = KEYWORD * len(keyword_values) + 11 * SEMAPHORE + 4 * 40 + 10 * TRACE + ring_bytes
            file.truncate(header_bytes + length + tail)
        stream = cls(path, columns, rows, pixel_type if pixel_type in NUMPY_TYPES else 10, planes, len(keyword_values))
        stream.pack("80s", 32, path.name.removesuffix(".im.shm").encode())
        stream.pack("<B3xIII", 112, axes, columns, rows, planes if axes == 3 else 0)  # number of axes, sizes
        stream.pack("<QB7xQ", 128, elements, pixel_type, kind)
        stream.pack("<iiB", 216, os.getpid(), 0, 1)  # creator, owner, shared
        stream.pack("<Qb", 232, os.fstat(stream.file).st_ino, location)
        stream.pack("<HH", 258, 10, 10)  # numbers of semaphores and of traces
        stream.pack("<BxH", 288, 0, len(keyword_values))  # write flag, number of keywords
        stream.pack("<Q", 312, elements * itemsize)
        for index, (name, value) in enumerate(keyword_values.items()):
            offset = stream.keywords + KEYWORD * index
            stream.pack("16s", offset, name.encode())
            code, layout = {int: ("L", "q"), float: ("D", "d"), str: ("S", "16s")}[type(value)]
            stream.pack(f"s7x{layout}", offset + 16, code.encode(), value.encode() if isinstance(value, str) else value)
        for index in range(10):
            LIBC.sem_init(stream.semaphore(index), 1, 0)
            stream.pack("<i", stream.readers + 4 * index, -1)
            stream.pack("<i", stream.writers + 4 * index, -1)
        stream.pack("32s", 0, version)
        return stream

    def pack(self, layout: str, offset: int, *values: object) -> None:
        struct.pack_into(layout, self.map, offset, *values)

    def get(self, layout: str, offset: int) -> int:
        return struct.unpack_from(layout, self.map, offset)[0]

    def semaphore(self, index: int) -> ctypes.c_void_p:
        return ctypes.c_void_p(self.address + self.semaphores + SEMAPHORE * index)

    def value(self, index: int) -> int:
        """Value of a semaphore."""
        value = ctypes.c_int()
        LIBC.sem_getvalue(self.semaphore(index), ctypes.byref(value))
        return value.value

    @property
    def count(self) -> int:
        """Number of images written: cnt0."""
        return self.get("<Q", 264)

    @property
    def pixels(self) -> npt.NDArray[np.generic]:
        elements = int(np.prod(self.shape))
        flat = np.frombuffer(self.map[self.data : self.data + elements * self.type.itemsize], self.type)
        return flat.reshape(self.shape)

    def begin(self, image: npt.NDArray[np.generic], plane: int = 0) -> None:
        """Begin to write an image: set the write flag, write the pixels and the number of their plane."""
        self.pack("B", 288, 1)  # write flag
        raw = np.ascontiguousarray(image, self.type).tobytes()
        offset = self.data + plane * len(raw)
        self.map[offset : offset + len(raw)] = raw
        self.pack("<Q", 272, plane)  # cnt1

    def end(self, acquired_ns: int | None = None) -> None:
        """Finish the image: write times and counter, clear the write flag, post semaphores of a value below ten."""
        now_ns = time.clock_gettime_ns(time.CLOCK_TAI)
        self.pack("<qq", 184, *divmod(now_ns if acquired_ns is None else acquired_ns, 10**9))
        self.pack("<qq", 200, *divmod(now_ns, 10**9))
        self.pack("<Q", 264, self.count + 1)
        self.pack("B", 288, 0)
        for index in range(10):
            if self.value(index) < 10:
                LIBC.sem_post(self.semaphore(index))
                self.pack("<i", self.writers + 4 * index, os.getpid())

    def write(self, image: npt.NDArray[np.generic], acquired_ns: int | None = None, plane: int = 0) -> None:
        self.begin(image, plane)
        self.end(acquired_ns)

    def reserve_semaphore(self, index: int, pid: int | None = None) -> None:
        """Register a process, by default this one, as the reader of a semaphore."""
        self.pack("<i", self.readers + 4 * index, os.getpid() if pid is None else pid)

    def wait(self, index: int, timeout_s: float) -> bool:
        """Wait for a semaphore; return whether it was posted before the timeout."""
        end = struct.pack("@ll", *divmod(time.time_ns() + int(timeout_s * 1e9), 10**9))
        return LIBC.sem_timedwait(self.semaphore(index), ctypes.c_char_p(end)) == 0
