"""FITS files of our own: named extensions written at once, and read only where they are whole."""

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from lowfc.arrays import Single
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import DataFileError

T = TypeVar("T")

LARGEST_BYTES = 1 << 33
"""Size of a file of arrays, at most."""
DAMAGED = (
    *(OSError, KeyError, TypeError, ValueError, EOFError, MemoryError, RecursionError),
    *(AstropyWarning, fits.VerifyError),
)
"""What reading a file that is damaged, or something else, may raise."""


def header_of(kind: str) -> fits.PrimaryHDU:
    """The head of a file; `kind` says what it is."""
    primary = fits.PrimaryHDU()
    primary.header["KIND"] = (kind, "what this file is")
    return primary


def extension(name: str, array: npt.NDArray[np.generic], sentence: str, unit: str | None = None) -> fits.ImageHDU:
    """An array under its name, with what it is and its unit."""
    made = fits.ImageHDU(array, name=name)
    if unit is not None:
        made.header["BUNIT"] = unit
    made.header["CONTENT"] = sentence
    return made


def to_bytes(primary: fits.PrimaryHDU, extensions: list[fits.ImageHDU]) -> bytes:
    """The whole file, with checksums."""
    stream = io.BytesIO()
    fits.HDUList([primary, *extensions]).writeto(stream, checksum=True)
    return stream.getvalue()


@contextlib.contextmanager
def opened(path: Path) -> Iterator[fits.HDUList]:
    """A file to read; raises some of `DAMAGED` where it is not whole."""
    with (
        warnings.catch_warnings(),
        input_file.opened(path, LARGEST_BYTES) as stream,
    ):  # which astropy leaves open where it raises
        warnings.simplefilter("error", AstropyWarning)  # a shortened file is no more than a warning to astropy
        with fits.open(stream, mode="readonly", memmap=False) as units:
            yield units


def load(path: Path, kinds: tuple[str, ...], what: str, parse: Callable[[fits.HDUList], T], advice: str = "") -> T:
    """What `parse` makes of a file of our own.

    Args:
        path: of the file.
        kinds: one of which it must be, the present one first.
        what: it is, for people.
        parse: raises some of `DAMAGED` where something is wrong.
        advice: how such a file is made.

    Raises:
        DataFileError: the file is missing, damaged or holds something else.
    """
    try:
        with opened(path) as units:
            found = units[0].header.get("KIND")
            if found not in kinds:
                raise ValueError(f"its header should say KIND = {kinds[0]!r}, got {found!r}")
            return parse(units)
    except FileNotFoundError:
        raise DataFileError(f"{path}: there is no such {what}{advice}") from None
    except DAMAGED as error:
        raise DataFileError(f"{path}: not a whole {what}: {in_a_line(error)}") from None


def single(units: fits.HDUList, name: str) -> Single:
    """An extension's array.

    Raises:
        KeyError: there is no such extension.
        ValueError: it holds no array.
    """
    data = getattr(units[name], "data", None)  # damaged, it may be an extension of no known kind
    if data is None:
        raise ValueError(f"the extension {name} holds no array")
    return np.ascontiguousarray(data, dtype=np.float32)


def first_image(units: fits.HDUList) -> npt.NDArray[np.generic]:
    """The first image or cube that there is.

    Raises:
        ValueError: there is none.
    """
    found = next((unit.data for unit in units if unit.is_image and unit.data is not None), None)
    if found is None:
        raise ValueError("there is no image in it")
    return np.asarray(found)


def require_identity(path: Path, found: str, stated: str) -> None:
    """Refuse a file whose content is not what it says.

    Raises:
        DataFileError: it is not.
    """
    if found != stated:
        raise DataFileError(f"{path}: damaged: its content has identity {found[:12]}, it says {stated[:12]}")


def in_a_line(error: BaseException) -> str:
    """What an error says, whose text may have several lines, or more characters than a user reads."""
    if "SIMPLE card" in str(error):
        return "it is not a FITS file"
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split())[:300]
