"""Calibrations as FITS: one named extension for each array, units in the headers."""

import io
import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from lowfc.adapters.whole_file import write_whole
from lowfc.contract.calibration_codec import identified
from lowfc.contract.errors import DataFileError
from lowfc.control.calibration import Calibration

KIND = "lowfc calibration 1"

# Extension, attribute of Calibration, unit.
_EXTENSIONS = (
    ("REFERENCE", "reference", "", "reference image I0, fraction of the flux"),
    ("RESPONSE", "response", "nm-1", "response matrix H, fraction of the flux per nm rms of wavefront"),
    ("RECONSTRUCTOR", "reconstructor", "nm", "reconstructor R, nm rms of wavefront per fraction of the flux"),
    ("MASK", "good", "", "1 where a pixel is used"),
    ("DARK", "dark", "adu", "frame without light"),
    ("MODES2ACT", "modes_to_actuators", "", "nm of surface per nm rms of wavefront"),
    ("ACT2MODES", "actuators_to_modes", "", "nm rms of wavefront that R makes of a nm of surface"),
)
_MAY_LACK = "ACT2MODES"


def to_bytes(calibration: Calibration) -> bytes:
    """Calibration as a FITS file."""
    primary = fits.PrimaryHDU()
    header = primary.header
    header["KIND"] = (KIND, "what this file is")
    header["CALID"] = calibration.id
    header["OPERATOR"] = calibration.operator_hash
    header["ESTIMATE"] = (calibration.estimator, "how R was made")
    header["NOLL"] = (" ".join(map(str, calibration.noll)), "Noll index of each mode")
    header["WAVELEN"] = (calibration.wavelength_nm, "[nm] wavelength")
    header["ROWS"] = (calibration.shape[0], "rows of the frame")
    header["COLUMNS"] = (calibration.shape[1], "columns of the frame")
    header["MIRROWS"] = (calibration.grid[0], "rows of the mirror")
    header["MIRCOLS"] = (calibration.grid[1], "columns of the mirror")
    header["FLUX"] = (calibration.flux_dn, "[adu] expected sum of the good pixels")
    header["SATURATE"] = (calibration.saturation_dn, "[adu] highest value of a pixel")
    units = [primary]
    for name, attribute, unit, sentence in _EXTENSIONS:
        array = getattr(calibration, attribute)
        if name == _MAY_LACK and not array.size:
            continue
        extension = fits.ImageHDU(array, name=name)
        extension.header["BUNIT"] = unit
        extension.header["CONTENT"] = sentence
        units.append(extension)
    stream = io.BytesIO()
    fits.HDUList(units).writeto(stream, checksum=True)
    return stream.getvalue()


def save(calibration: Calibration, path: Path) -> None:
    """Write a FITS file.

    Raises:
        DataFileError: the file cannot be written.
    """
    write_whole(path, to_bytes(calibration))


def load(path: Path) -> Calibration:
    """Read a FITS file and check that it is whole.

    Raises:
        DataFileError: the file is missing, damaged or holds something else.
    """
    if not path.is_file():
        raise DataFileError(f"{path}: there is no such calibration file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyWarning)  # a shortened file is no more than a warning to astropy
            with fits.open(path, mode="readonly", memmap=False) as units:
                calibration = _read(units)
    except (OSError, KeyError, TypeError, ValueError, AstropyWarning) as error:
        raise DataFileError(f"{path}: not a whole calibration file: {error}") from None
    found = identified(calibration).id
    if found != calibration.id:
        raise DataFileError(f"{path}: damaged: its content has identity {found[:12]}, it says {calibration.id[:12]}")
    return calibration


def _read(units: fits.HDUList) -> Calibration:
    header = units[0].header
    if header.get("KIND") != KIND:
        raise ValueError(f"its header should say KIND = {KIND!r}, got {header.get('KIND')!r}")

    def array(name: str) -> npt.NDArray[np.float32]:
        return np.ascontiguousarray(units[name].data, dtype=np.float32)

    arrays = {attribute: array(name) for name, attribute, _, _ in _EXTENSIONS if name != _MAY_LACK or name in units}
    return Calibration(
        noll=tuple(int(index) for index in str(header["NOLL"]).split()),
        shape=(int(header["ROWS"]), int(header["COLUMNS"])),
        grid=(int(header["MIRROWS"]), int(header["MIRCOLS"])),
        flux_dn=float(header["FLUX"]),
        saturation_dn=float(header["SATURATE"]),
        estimator=str(header["ESTIMATE"]),
        wavelength_nm=float(header["WAVELEN"]),
        operator_hash=str(header["OPERATOR"]),
        id=str(header["CALID"]),
        **arrays,
    )
