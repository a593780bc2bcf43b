"""Copy large arrays from a log to a file: frames and actuator commands are never all in memory."""

import itertools
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.logs.columns import Columns
from lowfc.adapters.logs.history import LAST_NS, History
from lowfc.arrays import Pixels
from lowfc.contract.codecs.codec import decode_frame
from lowfc.contract.envelope import count_of
from lowfc.contract.errors import BadMessageError, DataFileError
from lowfc.contract.messages import FRAME
from lowfc.control.loop.inputs import Frame

if TYPE_CHECKING:
    from astropy.io import fits

_FITS_BLOCK = 2880
_FITS_ZERO = 0x8000
"""Offset BZERO: FITS has no unsigned 16-bit integers and stores the value minus this offset."""


def fits_cube(path: Path, image: "fits.ImageHDU", shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Memory-mapped array of type ">f4" in a new extension at the end of a FITS file.

    The header is that of `image`, which must have the same number of axes; its data is not used. OSError if the disk
    has no room for the array: a write to a memory map on a full disk would kill the process.
    """
    with path.open("ab") as stream:
        stream.write(_header(image, shape, BITPIX=-32))
        stream.flush()
        offset, size = stream.tell(), 4 * math.prod(shape)
        os.posix_fallocate(stream.fileno(), offset, size + -size % _FITS_BLOCK)
    return np.memmap(path, ">f4", "r+", offset, shape)


def copy_frames_to_fits(path: Path, image: "fits.ImageHDU", history: History) -> Columns:
    """Copy the frames of a run into a new extension with the header of `image`; DataFileError if one is unreadable.

    Returns:
        `sequence` and `time_ns` of each frame in the order of recording.
    """
    copied = Columns(sequence="Q", time_ns="q")
    with path.open("ab") as stream:
        for frame, pixels in _frames(history):
            if not copied:
                shape = (history.frame_sequence.size, *pixels.shape)
                stream.write(_header(image, shape, BITPIX=16, BSCALE=1, BZERO=_FITS_ZERO))
            stream.write((pixels ^ np.uint16(_FITS_ZERO)).astype(">u2").tobytes())
            copied.add(sequence=frame.sequence, time_ns=frame.time_ns)
        stream.write(bytes(-stream.tell() % _FITS_BLOCK))
    return copied


def copy_frames_to_npy(path: Path, history: History) -> None:
    """Copy the frames of a run into a .npy file that numpy can map; DataFileError if one is unreadable."""
    with path.open("wb") as stream:
        for _, pixels in _frames(history):
            if not stream.tell():
                shape = (history.frame_sequence.size, *pixels.shape)
                header = {"descr": "<u2", "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(stream, header)
            stream.write(pixels.astype("<u2").tobytes())


def _header(image: "fits.ImageHDU", shape: tuple[int, ...], **cards: int) -> bytes:
    header = image.header.copy()
    header.update({f"NAXIS{axis}": length for axis, length in enumerate(reversed(shape), 1)} | cards)
    return bytes(header.tostring().encode("ascii"))


def _frames(history: History) -> Iterator[tuple[Frame, Pixels]]:
    """The frames of a log in the order of recording, with their pixels (rows, columns), all of one shape.

    Raises:
        DataFileError: a frame is unreadable or incomplete, or has another shape than the first one.
    """
    path, count = history.log.path, history.frame_sequence.size
    shape: tuple[int, ...] | None = None
    copied = 0
    kept = (one for one in history.reader(FRAME) if max(one.receive_time_ns, one.publish_time_ns) <= LAST_NS)
    for message in itertools.islice(kept, count):
        number = count_of(message.sequence)
        try:
            frame = decode_frame(message.payload, message.sequence, 0)
        except BadMessageError as fault:
            raise DataFileError(f"{path}: frame {number} cannot be read: {fault}; export without --frames") from None
        if frame.pixels is None:
            raise DataFileError(
                f"{path}: frame {number} is not a complete image of 16-bit pixels; export without --frames"
            )
        shape = shape or frame.pixels.shape
        if frame.pixels.shape != shape:
            raise DataFileError(
                f"{path}: frame {number} has shape {frame.pixels.shape}, but earlier frames have {shape}; "
                "export without --frames"
            )
        copied += 1
        yield frame, frame.pixels
    if copied < count:
        raise DataFileError(f"{path} changed while it was read: it has {copied} frames now, and had {count}")
