"""lowfc's own FITS files: named extensions with checksums; damaged files are refused."""

import contextlib
import gzip
import io
import lzma
import warnings
import zlib
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
from lowfc.contract.printable import printable

T = TypeVar("T")

MAX_BYTES = 1 << 33
"""Largest size of a file of arrays."""
DAMAGED = (
    *(OSError, KeyError, TypeError, ValueError, OverflowError, EOFError, MemoryError, RecursionError),
    *(AstropyWarning, fits.VerifyError, zlib.error, lzma.LZMAError),
)
"""Exceptions that reading a damaged or unrelated file may raise."""


def header_text(text: str) -> str:
    """Text for a header, which holds printable ASCII only: other characters become Python escapes."""
    return printable(text).encode("ascii", "backslashreplace").decode()


def primary_hdu(kind: str) -> fits.PrimaryHDU:
    """Make the primary HDU of a file of this kind."""
    primary = fits.PrimaryHDU()
    primary.header["KIND"] = (kind, "what this file is")
    return primary


def number(keyword: str, value: float, description: str) -> fits.Card:
    """Make a card of a number that reads back unchanged; astropy would shorten it to 20 characters."""
    card = fits.Card(keyword, value, description)
    if fits.Card.fromstring(str(card)).value == value:
        return card
    return fits.Card.fromstring(f"{keyword:8}= {repr(float(value)).upper()} / {description}")


def extension(name: str, array: npt.NDArray[np.generic], description: str, unit: str | None = None) -> fits.ImageHDU:
    """Make a named extension from an array, with its description and unit."""
    hdu = fits.ImageHDU(array, name=name)
    if unit is not None:
        hdu.header["BUNIT"] = unit
    hdu.header["CONTENT"] = description
    return hdu


def to_bytes(primary: fits.PrimaryHDU, extensions: list[fits.ImageHDU]) -> bytes:
    """Encode a file, with checksums."""
    stream = io.BytesIO()
    with warnings.catch_warnings(action="ignore", category=fits.verify.VerifyWarning):  # a truncated comment
        fits.HDUList([primary, *extensions]).writeto(stream, checksum=True)
    return stream.getvalue()


@contextlib.contextmanager
def opened(path: Path, content: bytes | None = None) -> Iterator[fits.HDUList]:
    """Open a file, or its `content`, for reading; raises one of `DAMAGED` if it is incomplete."""
    with (
        warnings.catch_warnings(),
        # closes the file if astropy raises
        input_file.opened(path, MAX_BYTES) if content is None else io.BytesIO(content) as stream,
    ):
        warnings.simplefilter("error", AstropyWarning)  # astropy only warns of a truncated file
        magic = stream.read(2)
        if magic in (b"PK", b"\x1f\x9d"):  # astropy's errors for these are not in DAMAGED
            raise ValueError("it is an archive, such as .npz or .Z, and not a FITS file")
        stream.seek(0)
        if magic == b"\x1f\x8b":  # gzip: astropy does not read as far as the checksum at its end
            with gzip.GzipFile(fileobj=stream) as unpacked:
                while unpacked.read(1 << 20):
                    pass
            stream.seek(0)
        with fits.open(stream, mode="readonly", memmap=False) as hdus:
            yield hdus


def load(
    path: Path,
    kinds: tuple[str, ...],
    what: str,
    parse: Callable[[fits.HDUList], T],
    advice: str = "",
    content: bytes | None = None,
) -> T:
    """Read one of lowfc's own files with `parse`.

    Args:
        path: path of the file.
        kinds: accepted values of KIND, the current one first.
        what: description of the file, for errors.
        parse: decodes the open file; raises one of `DAMAGED` if its content is invalid.
        advice: instruction to make such a file, for errors.
        content: content of the file, if it is not read from `path`, which then names it in errors.

    Raises:
        DataFileError: the file is missing or damaged, or is of another kind.
    """
    try:
        with opened(path, content) as hdus:
            found = hdus[0].header.get("KIND")
            if found not in kinds:
                raise ValueError(f"KIND in its header must be {kinds[0]!r}, found {found!r}")
            return parse(hdus)
    except FileNotFoundError:
        raise DataFileError(f"{path}: there is no such {what}{advice}") from None
    except DAMAGED as error:
        raise DataFileError(f"{path}: not a readable {what}: {one_line(error)}") from None


def single(hdus: fits.HDUList, name: str) -> Single:
    """Read an extension's array as float32.

    Raises:
        KeyError: there is no such extension.
        ValueError: it holds no array.
    """
    data = getattr(hdus[name], "data", None)  # a damaged extension may have an unknown type
    if data is None:
        raise ValueError(f"the extension {name} holds no array")
    return np.ascontiguousarray(data, dtype=np.float32)


def require_identity(path: Path, computed: str, stated: str) -> None:
    """Raise DataFileError if the identity stated in a file is not the one computed from its content."""
    if computed != stated:
        raise DataFileError(
            f"{path}: damaged: the identity of its content is {computed[:12]}, but its header states {stated[:12]}; "
            "restore the file from a copy, or make it again"
        )


def one_line(error: BaseException) -> str:
    """Text of an error on one line, at most 300 characters."""
    if "SIMPLE card" in str(error):
        return "it is not a FITS file"
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split())[:300] or type(error).__name__
