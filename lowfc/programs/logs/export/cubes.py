"""Copy large arrays from a log to a file: frames and actuator commands are never all in memory."""

import itertools
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.logs.history import LAST_NS, History
from lowfc.arrays import Pixels
from lowfc.contract.codecs.codec import decode_frame
from lowfc.contract.envelope import count_of
from lowfc.contract.errors import BadMessageError, DataFileError
from lowfc.contract.messages import FRAME

if TYPE_CHECKING:
    from astropy.io import fits

_FITS_BLOCK = 2880
_FITS_ZERO = 0x8000
"""Offset BZERO: FITS has no unsigned 16-bit integers and stores the value minus this offset."""


def fits_cube(path: Path, image: "fits.ImageHDU", shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Memory-mapped array ">f4" in a new extension at the end of a FITS file.

    The header is that of `image`, whose data is not used but has the same number of axes. OSError if the disk has no
    room for the array: a write to a memory map on a full disk would kill the process.
    """
    with path.open("ab") as stream:
        stream.write(_header(image, shape, BITPIX=-32))
        stream.flush()
        offset, size = stream.tell(), 4 * math.prod(shape)
        os.posix_fallocate(stream.fileno(), offset, size + -size % _FITS_BLOCK)
    return np.memmap(path, ">f4", "r+", offset, shape)


def copy_frames_to_fits(path: Path, image: "fits.ImageHDU", history: History) -> tuple[npt.NDArray[Any], ...]:
    """Copy the frames of a run into a new extension with the header of `image`; see `_copy_frames`."""

    def write_header(shape: tuple[int, ...]) -> None:
        stream.write(_header(image, shape, BITPIX=16, BSCALE=1, BZERO=_FITS_ZERO))

    with path.open("ab") as stream:
        copied = _copy_frames(
            history, stream, write_header, lambda pixels: (pixels ^ np.uint16(_FITS_ZERO)).astype(">u2")
        )
        stream.write(bytes(-stream.tell() % _FITS_BLOCK))
    return copied


def copy_frames_to_npy(path: Path, history: History) -> tuple[npt.NDArray[Any], ...]:
    """Copy the frames of a run into a .npy file, which `numpy.load` maps with `mmap_mode="r"`; see `_copy_frames`."""

    def write_header(shape: tuple[int, ...]) -> None:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<u2", "fortran_order": False, "shape": shape})

    with path.open("wb") as stream:
        return _copy_frames(history, stream, write_header, lambda pixels: pixels.astype("<u2"))


def _header(image: "fits.ImageHDU", shape: tuple[int, ...], **cards: int) -> bytes:
    header = image.header.copy()
    header.update({f"NAXIS{axis}": length for axis, length in enumerate(reversed(shape), 1)} | cards)
    return bytes(header.tostring().encode("ascii"))


def _copy_frames(
    history: History,
    stream: IO[bytes],
    write_header: Callable[[tuple[int, ...]], None],
    encode: Callable[[Pixels], npt.NDArray[Any]],
) -> tuple[npt.NDArray[Any], ...]:
    """Copy the frames of a log, encoded by `encode`, after the header for the shape (frames, rows, columns).

    Returns:
        Sequence and time, ns, of each frame in the order of recording.

    Raises:
        DataFileError: a frame cannot be copied.
    """
    path, count = history.log.path, history.frame_sequence.size
    sequence, time_ns = np.zeros(count, np.uint64), np.zeros(count, np.int64)
    shape: tuple[int, ...] | None = None
    row = -1
    kept = (one for one in history.reader(FRAME) if max(one.receive_time_ns, one.publish_time_ns) <= LAST_NS)
    for row, message in enumerate(itertools.islice(kept, count)):
        number = count_of(message.sequence)
        try:
            frame = decode_frame(message.payload, message.sequence, 0)
        except BadMessageError as fault:
            raise DataFileError(f"{path}: frame {number} cannot be read: {fault}; export without --frames") from None
        if frame.pixels is None:
            raise DataFileError(
                f"{path}: frame {number} is not a complete image of 16-bit pixels; export without --frames"
            )
        if shape is None:
            shape = frame.pixels.shape
            write_header((count, *shape))
        if frame.pixels.shape != shape:
            raise DataFileError(
                f"{path}: frame {number} has shape {frame.pixels.shape}, but earlier frames have {shape}; "
                "export without --frames"
            )
        stream.write(encode(frame.pixels).tobytes())
        sequence[row], time_ns[row] = frame.sequence, frame.time_ns
    if row + 1 < count:
        raise DataFileError(f"{path} changed while it was read: it has {row + 1} frames now, and had {count}")
    return sequence, time_ns
