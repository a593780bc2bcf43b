"""Read an array from a file: the first image of a FITS file, or a .npy file."""

from pathlib import Path
from tokenize import TokenError

import numpy as np
import numpy.typing as npt
from numpy.lib.format import read_array as read_npy

from lowfc.adapters.files import fits_file
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import DataFileError, raised_as
from lowfc.contract.printable import printable


def read_array(
    path: Path, what: str, dimensions: tuple[int, ...], units: tuple[str, ...] = ()
) -> npt.NDArray[np.generic]:
    """Read the array of a file.

    Args:
        path: path of the file.
        what: clause on the expected content for errors, such as "a mirror's shape is an array (rows, columns)".
        dimensions: permitted numbers of dimensions.
        units: permitted units of a FITS image that states one; empty for any.

    Raises:
        DataFileError: the file is missing or damaged, or has no such array.
    """
    try:
        array, unit = (_npy(path), "") if path.suffix == ".npy" else _fits(path)
    except FileNotFoundError:
        raise DataFileError(f"{path}: there is no such file") from None
    except fits_file.DAMAGED as error:
        why = fits_file.one_line(error)
        raise DataFileError(f"{path}: neither a FITS image nor a numpy array (.npy): {why}") from None
    if array.ndim not in dimensions or not array.size or array.dtype.kind not in "biuf":
        raise DataFileError(f"{path}: {what} of numbers, got {array.shape} of {array.dtype}")
    if units and unit and unit not in units:
        raise DataFileError(f"{path}: its values are in {printable(unit)} (BUNIT), expected {units[0]}: convert them")
    return array


def _npy(path: Path) -> npt.NDArray[np.generic]:
    with (
        input_file.opened(path, fits_file.MAX_BYTES) as stream,
        raised_as(ValueError, TokenError, "its header cannot be read"),
    ):
        return np.asarray(read_npy(stream, allow_pickle=False))


def _fits(path: Path) -> tuple[npt.NDArray[np.generic], str]:
    """The first image or cube, and its unit (BUNIT), empty if it is not given."""
    with fits_file.opened(path) as hdus:
        image = next((hdu for hdu in hdus if hdu.is_image and hdu.data is not None), None)
        if image is None:
            raise ValueError("there is no image in it")
        return np.asarray(image.data), str(image.header.get("BUNIT", "")).strip()
