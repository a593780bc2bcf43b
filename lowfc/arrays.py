"""Array types of the project."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
SingleComplex = npt.NDArray[np.complex64]
Complex = npt.NDArray[np.complex128]
Integers = npt.NDArray[np.intp]
Long = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Pixels = npt.NDArray[np.uint16]
Sequences = npt.NDArray[np.uint64]

_CACHE_LINE = 64  # bytes


def single(array: npt.ArrayLike) -> Single:
    """Convert to single precision in row-major (C) order, as the loop uses it."""
    return np.ascontiguousarray(array, dtype=np.float32)


def aligned(array: npt.ArrayLike) -> Single:
    """Copy to single precision in C order, with the first byte at the start of a cache line.

    numpy aligns arrays to 16 bytes only: every other vector load may then cross the border of a cache line.
    """
    values = np.asarray(array, np.float32)
    memory = np.empty(values.nbytes + _CACHE_LINE, np.uint8)
    start = -memory.ctypes.data % _CACHE_LINE
    copy: Single = memory[start : start + values.nbytes].view(np.float32).reshape(values.shape)
    copy[...] = values
    return copy
