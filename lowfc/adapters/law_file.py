"""Control laws as FITS: one named extension for each matrix."""

import hashlib
import io
import warnings
from dataclasses import fields
from pathlib import Path

import numpy as np
import numpy.typing as npt
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from lowfc.adapters.whole_file import write_whole
from lowfc.contract.errors import DataFileError
from lowfc.control.linear_law import SIGNALS, LinearLaw

KIND = "lowfc law 1"

# Extension, attribute of LinearLaw, sentence.
_EXTENSIONS = (
    ("FOLLOW", "follow", "F of x[k] = F x[k-1] + G y[k] + H c[k-1]"),
    ("GAIN", "gain", "G, of the modes measured"),
    ("KEPT", "kept", "H, of the modal command before"),
    ("COAST", "coast", "A of x[k] = A x[k-1] + H c[k-1], without a frame"),
    ("OUTPUT", "output", "K, the modal command is K x[k]"),
)


def identity(law: LinearLaw) -> str:
    """SHA-256 of everything in a law."""
    digest = hashlib.sha256()
    for part in fields(law):
        value = getattr(law, part.name)
        digest.update(part.name.encode())
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()


def to_bytes(law: LinearLaw) -> bytes:
    """Law as a FITS file."""
    primary = fits.PrimaryHDU()
    header = primary.header
    header["KIND"] = (KIND, "what this file is")
    header["LAWID"] = identity(law)
    header["NAME"] = (law.name, "what kind of law it is")
    header["SIGNAL"] = (law.signal, "y: the error, or pseudo-open-loop modes")
    header["NOLL"] = (" ".join(map(str, law.noll)), "Noll index of each mode")
    header["DELAY"] = (law.delay_frames, "[frames] delay it was made for")
    header["RATE"] = (law.rate_hz, "[Hz] frame rate it was made for")
    units = [primary]
    for name, attribute, sentence in _EXTENSIONS:
        extension = fits.ImageHDU(getattr(law, attribute), name=name)
        extension.header["CONTENT"] = sentence
        units.append(extension)
    stream = io.BytesIO()
    fits.HDUList(units).writeto(stream, checksum=True)
    return stream.getvalue()


def save(law: LinearLaw, path: Path) -> None:
    """Write a FITS file.

    Raises:
        DataFileError: the file cannot be written.
    """
    write_whole(path, to_bytes(law))


def load(path: Path) -> LinearLaw:
    """Read a FITS file and check that it is whole.

    Raises:
        DataFileError: the file is missing, damaged or holds something else.
    """
    if not path.is_file():
        raise DataFileError(f"{path}: there is no such law file: make one with `lowfc tune LOG --out FILE`")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyWarning)  # a shortened file is no more than a warning to astropy
            with fits.open(path, mode="readonly", memmap=False) as units:
                law, stated = _read(units)
    except (OSError, KeyError, TypeError, ValueError, AstropyWarning) as error:
        raise DataFileError(f"{path}: not a whole law file: {' '.join(str(error).split())}") from None
    found = identity(law)
    if found != stated:
        raise DataFileError(f"{path}: damaged: its content has identity {found[:12]}, it says {stated[:12]}")
    return law


def _read(units: fits.HDUList) -> tuple[LinearLaw, str]:
    header = units[0].header
    if header.get("KIND") != KIND:
        raise ValueError(f"its header should say KIND = {KIND!r}, got {header.get('KIND')!r}")
    signal = next((each for each in SIGNALS if each == header["SIGNAL"]), None)
    if signal is None:
        raise ValueError(f"the signal of a law is one of {', '.join(SIGNALS)}, got {header['SIGNAL']!r}")

    def array(name: str) -> npt.NDArray[np.float32]:
        return np.ascontiguousarray(units[name].data, dtype=np.float32)

    matrices = {attribute: array(name) for name, attribute, _ in _EXTENSIONS}
    law = LinearLaw(
        signal=signal,
        name=str(header["NAME"]),
        noll=tuple(int(index) for index in str(header["NOLL"]).split()),
        delay_frames=float(header["DELAY"]),
        rate_hz=float(header["RATE"]),
        **matrices,
    )
    return law, str(header["LAWID"])
