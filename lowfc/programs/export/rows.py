"""Big arrays, row by row from a log into a file: frames and actuator commands are never in memory all at once."""

import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.history import History
from lowfc.adapters.log_parts import Parts, WholeLog
from lowfc.adapters.log_reader import LogReader
from lowfc.contract.codec import decode_frame
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import FRAME

if TYPE_CHECKING:
    from astropy.io import fits

Progress = Callable[[LogReader], None]

_FITS_BLOCK = 2880
_FITS_ZERO = 0x8000
"""FITS has no unsigned integers of 16 bits: it stores them less this."""


class Rows:
    """An array in a file, written row by row in any order; one of integers must get all its rows."""

    def __init__(self, path: Path, shape: tuple[int, ...], kind: str, *, block: int = 1) -> None:
        """Append an array of `shape` and of numpy's `kind` to a file, and fill the last `block` of bytes."""
        self._file = path.open("r+b")
        self._shape, self._kind, self._block = shape, kind, block
        self._offset = self._file.seek(0, 2)
        self._row_bytes = math.prod(shape[1:]) * np.dtype(kind).itemsize
        self._missing = np.ones(shape[0], bool)

    def __enter__(self) -> "Rows":
        return self

    def put(self, row: int, values: npt.NDArray[Any]) -> None:
        """Write a row."""
        self._file.seek(self._offset + row * self._row_bytes)
        self._file.write(values.astype(self._kind).tobytes())
        self._missing[row] = False

    def __exit__(self, fault: type[BaseException] | None, *_: object) -> None:
        """Write NaN where no row was put, and close the file."""
        with self._file:
            if fault is not None:
                return
            for row in np.flatnonzero(self._missing):
                self.put(int(row), np.full(self._shape[1:], np.nan, np.float32))
            end = self._offset + self._shape[0] * self._row_bytes
            self._file.truncate(end + -end % self._block)


class FitsIntegers(Rows):
    """Unsigned integers of 16 bits as FITS stores them."""

    def put(self, row: int, values: npt.NDArray[Any]) -> None:
        """Write a row."""
        super().put(row, values ^ np.uint16(_FITS_ZERO))


def npy_rows(path: Path, shape: tuple[int, ...]) -> Rows:
    """Unsigned integers of 16 bits in a new .npy file, which `numpy.load` maps with `mmap_mode="r"`."""
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<u2", "fortran_order": False, "shape": shape})
    return Rows(path, shape, "<u2")


def fits_rows(path: Path, image: "fits.ImageHDU", shape: tuple[int, ...], kind: str) -> Rows:
    """Rows of a new extension at the end of a FITS file, of kind ">f4" or ">u2".

    Its cards are those of `image`, whose own data is not used and has as many axes.
    """
    header = image.header.copy()
    header["BITPIX"] = {">f4": -32, ">u2": 16}[kind]
    for axis, length in enumerate(reversed(shape), 1):
        header[f"NAXIS{axis}"] = length
    if kind == ">u2":
        header["BSCALE"], header["BZERO"] = 1, _FITS_ZERO
    with path.open("ab") as stream:
        stream.write(header.tostring().encode("ascii"))
    return (FitsIntegers if kind == ">u2" else Rows)(path, shape, kind, block=_FITS_BLOCK)


def copy_frames(
    make: Callable[[tuple[int, int, int]], Rows], history: History, progress: Progress
) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.int64]]:
    """Copy the frames of a run from its log.

    Args:
        make: opens the rows for an array (frames, rows, columns) of 16 bits, DN.
        history: of the run.
        progress: called with the log that is read again.

    Returns:
        Sequence and time in ns of each frame, in the order they were recorded.

    Raises:
        DataFileError: there is no frame, or they have several sizes.
    """
    path, count = history.log.path, history.frame_sequence.size
    found = _frames(history.log.paths, count, progress)
    first = next(found, None)
    if first is None:
        raise DataFileError(f"{path} has no frames; export without --frames")
    sequence, time_ns = np.zeros(count, np.uint64), np.zeros(count, np.int64)
    with make((count, *first[2].shape)) as rows:
        for row, (sequence[row], time_ns[row], pixels) in enumerate(itertools.chain([first], found)):
            rows.put(row, pixels)
        if row + 1 < count:
            raise DataFileError(f"{path} changed while it was read: it has {row + 1} frames now, and had {count}")
    return sequence, time_ns


def _frames(files: Parts, count: int, progress: Progress) -> Iterator[tuple[int, int, npt.NDArray[np.uint16]]]:
    log = WholeLog(files, topics=(FRAME,), skip_damaged=True)
    shape: tuple[int, ...] | None = None
    for message in itertools.islice(log, count):
        frame = decode_frame(message.payload, message.sequence, 0)
        size = frame.pixels.shape if frame.pixels is not None else None
        shape = shape or size
        if frame.pixels is None or size != shape:
            raise DataFileError(
                f"{log.path}: frame {frame.sequence} is {size}, others are {shape}: they make no cube; "
                "export without --frames"
            )
        yield frame.sequence, frame.time_ns, frame.pixels
        progress(log)
