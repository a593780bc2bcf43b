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


def single(array: npt.ArrayLike) -> Single:
    """Convert to single precision in row-major (C) order, as the loop uses it."""
    return np.ascontiguousarray(array, dtype=np.float32)
