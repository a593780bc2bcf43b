"""Shapes of the mirror in files: FITS, or numpy's."""

import io
import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from lowfc.contract.errors import DataFileError


def read_shape(path: Path) -> npt.NDArray[np.float32]:
    """Shape of a mirror (rows, columns), nm of surface: the first image of a FITS file, or the array of a .npy file.

    Raises:
        DataFileError: the file is missing, damaged or holds something else.
    """
    if not path.is_file():
        raise DataFileError(f"{path}: there is no such file")
    try:
        shape = _npy(path) if path.suffix == ".npy" else _fits(path)
    except (OSError, TypeError, ValueError, EOFError, AstropyWarning) as error:
        raise DataFileError(f"{path}: neither a FITS image nor a numpy array (.npy): {error}") from None
    if shape.ndim != 2 or shape.dtype.kind not in "iuf":
        raise DataFileError(
            f"{path}: a mirror's shape is an array (rows, columns) of numbers, got {shape.shape} of {shape.dtype}"
        )
    return np.ascontiguousarray(shape, dtype=np.float32)


def _npy(path: Path) -> npt.NDArray[np.generic]:
    found: npt.NDArray[np.generic] = np.load(path, allow_pickle=False)
    return found


def _fits(path: Path) -> npt.NDArray[np.generic]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)  # a shortened file is no more than a warning to astropy
        with fits.open(io.BytesIO(path.read_bytes())) as units:
            images = [unit.data for unit in units if unit.is_image and unit.data is not None]
            if not images:
                raise ValueError("there is no image in it")
            return np.asarray(images[0])
