"""Big arrays from a log into a file: frames and actuator commands are never in memory all at once."""

import itertools
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.logs.history import History
from lowfc.arrays import Pixels
from lowfc.contract.codecs.codec import decode_frame
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import FRAME

if TYPE_CHECKING:
    from astropy.io import fits

_FITS_BLOCK = 2880
_FITS_ZERO = 0x8000
"""FITS has no unsigned integers of 16 bits: it stores them less this."""


def fits_cube(path: Path, image: "fits.ImageHDU", shape: tuple[int, ...], kind: str) -> npt.NDArray[Any]:
    """Array in a new extension at the end of a FITS file, of kind ">f4" or ">i2"; the latter for unsigned ones.

    Its cards are those of `image`, whose own data is not used and has as many axes.
    """
    header = image.header.copy()
    header["BITPIX"] = {">f4": -32, ">i2": 16}[kind]
    for axis, length in enumerate(reversed(shape), 1):
        header[f"NAXIS{axis}"] = length
    if kind == ">i2":
        header["BSCALE"], header["BZERO"] = 1, _FITS_ZERO
    with path.open("ab") as stream:
        stream.write(header.tostring().encode("ascii"))
    return _mapped(path, shape, kind, _FITS_BLOCK)


def copy_frames_to_fits(path: Path, image: "fits.ImageHDU", history: History) -> tuple[npt.NDArray[Any], ...]:
    """Copy the frames of a run into a new extension with the cards of `image`; see `_copy_frames`."""
    flip = np.uint16(_FITS_ZERO)
    return _copy_frames(
        history, lambda shape: fits_cube(path, image, shape, ">i2"), lambda pixels: (pixels ^ flip).view(np.int16)
    )


def copy_frames_to_npy(path: Path, history: History) -> tuple[npt.NDArray[Any], ...]:
    """Copy the frames of a run into a .npy file, which `numpy.load` maps with `mmap_mode="r"`; see `_copy_frames`."""

    def make(shape: tuple[int, ...]) -> npt.NDArray[Any]:
        with path.open("wb") as stream:
            np.lib.format.write_array_header_1_0(stream, {"descr": "<u2", "fortran_order": False, "shape": shape})
        return _mapped(path, shape, "<u2")

    return _copy_frames(history, make, lambda pixels: pixels)


def _mapped(path: Path, shape: tuple[int, ...], kind: str, block: int = 1) -> npt.NDArray[Any]:
    """Array behind what is in a file, mapped into memory; the file becomes a multiple of `block` bytes.

    The disk has room for all of it, or this is an OSError: a map onto a full disk would kill the process.
    """
    offset, size = path.stat().st_size, math.prod(shape) * np.dtype(kind).itemsize
    with path.open("r+b") as stream:
        os.posix_fallocate(stream.fileno(), offset, size + -(offset + size) % block)
    return np.memmap(path, kind, "r+", offset, shape)


def _copy_frames(
    history: History,
    make: Callable[[tuple[int, ...]], npt.NDArray[Any]],
    stored: Callable[[Pixels], npt.NDArray[Any]],
) -> tuple[npt.NDArray[Any], ...]:
    """Copy frames from a run's log into an array (frames, rows, columns), which `make` makes, as they are `stored`.

    Returns:
        Sequence and time in ns of each frame, in the order they were recorded.

    Raises:
        DataFileError: there is no frame, or they have several sizes.
    """
    path, count = history.log.path, history.frame_sequence.size
    sequence, time_ns = np.zeros(count, np.uint64), np.zeros(count, np.int64)
    cube: npt.NDArray[Any] | None = None
    row = -1
    for row, message in enumerate(itertools.islice(history.again(FRAME), count)):
        frame = decode_frame(message.payload, message.sequence, 0)
        if cube is None and frame.pixels is not None:
            cube = make((count, *frame.pixels.shape))
        if frame.pixels is None or cube is None or frame.pixels.shape != cube.shape[1:]:
            raise DataFileError(
                f"{path}: frame {frame.sequence} is {None if frame.pixels is None else frame.pixels.shape}, others are "
                f"{None if cube is None else cube.shape[1:]}: they make no cube; export without --frames"
            )
        cube[row], sequence[row], time_ns[row] = stored(frame.pixels), frame.sequence, frame.time_ns
    if row + 1 < count:
        raise DataFileError(f"{path} changed while it was read: it has {row + 1} frames now, and had {count}")
    return sequence, time_ns
