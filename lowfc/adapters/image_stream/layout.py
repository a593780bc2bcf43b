"""Layout of an ImageStreamIO stream file, version 2.00, as in `ImageStruct.h` of milk-org/ImageStreamIO.

This module only computes positions from a copy of the header.
"""

import struct
from math import prod
from typing import NamedTuple

import numpy as np

VERSION = "2.00"
HEADER_BYTES = 384
DAO_HEADER_BYTES = 4496
"""Header size of a library built with DAO_COMPAT, which states the same version."""
SEMAPHORE_BYTES = 32
_TIME = ("<i8", 2)  # seconds, nanoseconds

HEADER = np.dtype(
    {
        "names": [
            *("version", "name", "axes", "size", "elements", "type", "kind", "created", "accessed", "atime"),
            *("writetime", "creator", "owner", "shared", "inode", "location", "semaphores", "traces", "cnt0", "cnt1"),
            *("write", "keywords", "ring", "ring_index", "ring_cycle", "data_bytes"),
        ],
        "formats": [
            *("S32", "S80", "u1", ("<u4", 3), "<u8", "u1", "<u8", _TIME, _TIME, _TIME),
            *(_TIME, "<i4", "<i4", "u1", "<u8", "i1", "<u2", "<u2", "<u8", "<u8"),
            *("u1", "<u2", "<u4", "<u4", "<u8", "<u8"),
        ],
        "offsets": [
            *(0, 32, 112, 116, 128, 136, 144, 152, 168, 184),
            *(200, 216, 220, 224, 232, 240, 258, 260, 264, 272),
            *(288, 290, 292, 296, 304, 312),
        ],
        "itemsize": HEADER_BYTES,
    }
)
NEWEST, NEWEST_START = struct.Struct("@2q64x2Q8xB"), 184
"""Fields that change with each image, read at once (`atime`, `cnt0`, `cnt1`, `write`), and their first byte."""
TIMES = struct.Struct("<4q")
"""`atime` and `writetime`, from byte `NEWEST_START`, each in seconds and nanoseconds."""
KEYWORD = np.dtype(
    {
        "names": ["name", "type", "integer", "real", "text"],
        "formats": ["S16", "S1", "<i8", "<f8", "S16"],
        "offsets": [0, 16, 24, 24, 24],
        "itemsize": 128,
    }
)
TYPES = {
    number: np.dtype(name)
    for number, name in enumerate(("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8"), start=1)
}
NUMBERS = {dtype: number for number, dtype in TYPES.items()}
MATH_DATA = 2
"""Kind of a stream without a time axis, as created by the C library."""
_TIME_AXIS, _TIME_MASK = 0x20001, 0xF000F  # CIRCULAR_BUFFER | ZAXIS_TEMPORAL


class Layout(NamedTuple):
    """Positions of the parts of a stream.

    Attributes:
        dtype: type of a pixel.
        shape: (planes, rows, columns); more than one plane only if images are written to the planes in turn.
        keywords: number of keywords.
        semaphores: number of semaphores.
        ring: number of images in the circular buffer.
        starts: first byte of each part, by name.
        file_bytes: size of the file.
    """

    dtype: np.dtype[np.generic]
    shape: tuple[int, int, int]
    keywords: int
    semaphores: int
    ring: int
    starts: dict[str, int]
    file_bytes: int

    @classmethod
    def of(cls, header: np.void, file_bytes: int) -> "Layout":
        """Layout declared by a header, for a file of that size; ValueError with the reason if it is not supported."""
        version = header["version"].partition(b"\0")[0].decode("ascii", "backslashreplace")
        if version != VERSION:
            raise ValueError(f"has layout version {version!r}, expected {VERSION!r}")
        axes, size = int(header["axes"]), [int(length) for length in header["size"]]
        dtype = TYPES.get(int(header["type"]))
        if dtype is None:
            raise ValueError(f"has pixels of type {header['type']}, expected 1 to 10 (integer, float or double)")
        if axes not in (2, 3) or not all(size[:axes]):
            raise ValueError(f"has {axes} axes of {size}, expected columns x rows, or columns x rows x planes")
        time_axis = int(header["kind"]) & _TIME_MASK == _TIME_AXIS
        columns, rows, planes = size[0], size[1], size[2] if axes == 3 else 1
        if planes > 1 and not time_axis:
            raise ValueError(
                f"is a cube of {planes} planes without a time axis, expected images written to the planes in turn"
            )
        if header["location"] != -1:
            raise ValueError(f"is in the memory of graphics card {header['location']}, expected shared memory")
        if header["shared"] != 1:
            raise ValueError(f"is not in shared memory: shared is {header['shared']}, expected 1")
        elements, data_bytes = planes * rows * columns, planes * rows * columns * dtype.itemsize
        if int(header["elements"]) != elements or int(header["data_bytes"]) != data_bytes:
            raise ValueError(
                f"declares {header['elements']} pixels in {header['data_bytes']} bytes, expected {elements} in "
                f"{data_bytes}"
            )
        counts = (int(header[name]) for name in ("keywords", "semaphores", "traces", "ring"))
        layout = cls.computed(dtype, (planes, rows, columns), *counts, time_axis=time_axis and axes == 3)
        if layout.file_bytes != file_bytes:
            dao = file_bytes - layout.file_bytes == DAO_HEADER_BYTES - HEADER_BYTES
            built = "a library built with DAO_COMPAT wrote it" if dao else "a library built with other options wrote it"
            raise ValueError(f"has {file_bytes} bytes, expected {layout.file_bytes}: {built}")
        return layout

    @classmethod
    def computed(
        cls,
        dtype: np.dtype[np.generic],
        shape: tuple[int, int, int],
        keywords: int,
        semaphores: int,
        traces: int,
        ring: int,
        *,
        time_axis: bool = False,
    ) -> "Layout":
        """Compute the layout of a stream with these numbers of parts."""
        data_bytes, numbers_bytes = prod(shape) * dtype.itemsize, 4 * semaphores  # one int32 per semaphore
        parts = {
            "header": HEADER_BYTES,
            "data": data_bytes,
            "keywords": KEYWORD.itemsize * keywords,
            "semaphores": SEMAPHORE_BYTES * semaphores,
            "log": SEMAPHORE_BYTES,
            "readers": numbers_bytes,
            "writers": numbers_bytes,
            "control": numbers_bytes,
            "status": numbers_bytes,
            "traces": 64 * traces,
            "times": 40 * shape[0] if time_axis else 0,  # of each plane: two times of 16 bytes and a count of 8
            "ring_headers": 48 * ring,
            "ring": data_bytes * ring,
        }
        starts, end = {}, 0
        for name, length in parts.items():
            starts[name] = end
            end += (length + 7) // 8 * 8  # rounded up to 8 bytes
        return cls(dtype, shape, keywords, semaphores, ring, starts, end)
