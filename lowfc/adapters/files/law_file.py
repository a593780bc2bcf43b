"""Control laws as FITS files: one named extension per matrix."""

from pathlib import Path
from typing import cast

from astropy.io import fits

from lowfc.adapters.files import fits_file
from lowfc.adapters.files.whole_file import write_whole
from lowfc.contract.errors import DataFileError
from lowfc.contract.former_names import LAW_EXTENSIONS
from lowfc.control.laws.linear_law import LinearLaw, Signal

KIND = "lowfc law 2"
FORMER_KIND = "lowfc law 1"

# Extension, attribute of LinearLaw, description.
_EXTENSIONS = (
    ("TRANSITION", "transition", "F of x[k] = F x[k-1] + G y[k] + U c[k-1]"),
    ("MEASUREMENT_GAIN", "measurement_gain", "G, gain of the measured modes"),
    ("COMMAND_GAIN", "command_gain", "U, gain of the last modal command"),
    ("PREDICT_ONLY", "predict_only", "A of x[k] = A x[k-1] + U c[k-1], without a frame"),
    ("OUTPUT", "output", "K, the modal command is K x[k]"),
)


def to_bytes(law: LinearLaw) -> bytes:
    """Encode a law as a FITS file; DataFileError if the law's name cannot be stored in a header."""
    if not (law.name.isascii() and law.name.isprintable()) or law.name.endswith(" "):
        raise DataFileError(f"a law's name in a file is printable ASCII, without a space at its end; got {law.name!r}")
    primary = fits_file.primary_hdu(KIND)
    header = primary.header
    header["LAWID"] = law.id
    header["NAME"] = (law.name, "what kind of law it is")
    header["SIGNAL"] = (law.signal, "y: the error, or pseudo-open-loop modes")
    header["NOLL"] = (" ".join(map(str, law.noll)), "Noll index of each mode")
    header.append(fits_file.number("DELAY", law.delay_frames, "[frames] delay it was made for"))
    header.append(fits_file.number("RATE", law.rate_hz, "[Hz] frame rate it was made for"))
    extensions = [fits_file.extension(name, getattr(law, attribute), text) for name, attribute, text in _EXTENSIONS]
    return fits_file.to_bytes(primary, extensions)


def save(law: LinearLaw, path: Path) -> None:
    """Write a FITS file; DataFileError if that fails."""
    write_whole(path, to_bytes(law))


def load(path: Path) -> LinearLaw:
    """Read a FITS file and check its identity.

    Raises:
        DataFileError: the file is missing or damaged, or is of another kind.
    """
    law, stated = fits_file.load(
        path, (KIND, FORMER_KIND), "law file", _read, ": make one with `lowfc tune LOG --out FILE`"
    )
    fits_file.require_identity(path, law.id, stated)
    return law


def _read(hdus: fits.HDUList) -> tuple[LinearLaw, str]:
    header = hdus[0].header
    former = LAW_EXTENSIONS if header["KIND"] == FORMER_KIND else {}
    law = LinearLaw(
        signal=cast("Signal", str(header["SIGNAL"])),  # LinearLaw refuses any other
        name=str(header["NAME"]),
        noll=tuple(int(index) for index in str(header["NOLL"]).split()),
        delay_frames=float(header["DELAY"]),
        rate_hz=float(header["RATE"]),
        **{attribute: fits_file.single(hdus, former.get(name, name)) for name, attribute, _ in _EXTENSIONS},
    )
    return law, str(header["LAWID"])
