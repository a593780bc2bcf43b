"""Calibrations as FITS files: one named extension per array, with its unit in the header."""

from pathlib import Path
from typing import Any

from astropy.io import fits

from lowfc.adapters.files import fits_file
from lowfc.adapters.files.whole_file import write_whole
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.camera import CameraSettings

KIND = "lowfc calibration 1"

# Name of the extension, attribute of Calibration, unit, description.
_EXTENSIONS = (
    ("REFERENCE", "reference", "", "reference image I0, fraction of the flux"),
    ("RESPONSE", "response", "nm-1", "response matrix H, fraction of the flux per nm rms of wavefront"),
    ("RECONSTRUCTOR", "reconstructor", "nm", "reconstructor R, nm rms of wavefront per fraction of the flux"),
    ("MASK", "good", "", "1 where a pixel is used"),
    ("DARK", "dark", "adu", "frame without light"),
    ("MODES2ACT", "modes_to_actuators", "", "nm of surface per nm rms of wavefront"),
    ("ACT2MODES", "actuators_to_modes", "", "nm rms of wavefront that R measures per nm of surface"),
)
_OPTIONAL = "ACT2MODES"
_CAMERA = (
    ("CAMBIAS", "bias_dn", "[adu] bias of the camera when this was made"),
    ("CAMFULL", "saturation_dn", "[adu] highest pixel value of the camera"),
    ("CAMGAIN", "gain_e_per_dn", "[e-/adu] conversion gain of the camera"),
    ("CAMEM", "em_gain", "electron-multiplying gain of the camera"),
    ("CAMNOISE", "read_noise_e", "[e-] read noise of the camera"),
)


def to_bytes(calibration: Calibration) -> bytes:
    """Encode a calibration as a FITS file."""
    primary = fits_file.primary_hdu(KIND)
    header = primary.header
    header["CALID"] = calibration.id
    header["OPERATOR"] = calibration.operator_hash
    header["ESTIMATE"] = (calibration.estimator, "how R was made")
    header["NOLL"] = (" ".join(map(str, calibration.noll)), "Noll index of each mode")
    header.append(fits_file.number("WAVELEN", calibration.wavelength_nm, "[nm] wavelength"))
    header["ROWS"] = (calibration.shape[0], "rows of the frame")
    header["COLUMNS"] = (calibration.shape[1], "columns of the frame")
    header["MIRROWS"] = (calibration.grid[0], "rows of the mirror")
    header["MIRCOLS"] = (calibration.grid[1], "columns of the mirror")
    header.append(fits_file.number("FLUX", calibration.flux_dn, "[adu] expected sum of the good pixels"))
    header.append(fits_file.number("SATURATE", calibration.saturation_dn, "[adu] highest value of a pixel"))
    if (camera := calibration.camera) is not None:
        for card, attribute, description in _CAMERA:
            header.append(fits_file.number(card, getattr(camera, attribute), description))
        header["CAMROW"] = (camera.region[0], "first row read")
        header["CAMCOL"] = (camera.region[1], "first column read")
    arrays = {name: getattr(calibration, attribute) for name, attribute, _, _ in _EXTENSIONS}
    return fits_file.to_bytes(
        primary,
        [
            fits_file.extension(name, arrays[name], description, unit)
            for name, _, unit, description in _EXTENSIONS
            if name != _OPTIONAL or arrays[name].size
        ],
    )


def save(calibration: Calibration, path: Path) -> None:
    """Write a calibration to a FITS file; DataFileError if that fails."""
    write_whole(path, to_bytes(calibration))


def load(path: Path, content: bytes | None = None) -> Calibration:
    """Read a calibration from a FITS file, or from its `content` (`path` is then for errors); check its identity.

    Raises:
        DataFileError: the file is missing or damaged, or is of another kind.
    """
    calibration = fits_file.load(path, (KIND,), "calibration file", _read, content=content)
    fits_file.require_identity(path, calibration.identity(), calibration.id)
    return calibration


def _read(hdus: fits.HDUList) -> Calibration:
    header = hdus[0].header
    arrays = {
        attribute: fits_file.single(hdus, name)
        for name, attribute, _, _ in _EXTENSIONS
        if name != _OPTIONAL or name in hdus
    }
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
        camera=_camera(header) if "CAMBIAS" in header else None,
        **arrays,
    )


def _camera(header: fits.Header) -> CameraSettings:
    values: dict[str, Any] = {attribute: float(header[card]) for card, attribute, _ in _CAMERA}
    shape = int(header["ROWS"]), int(header["COLUMNS"])
    return CameraSettings(0, shape, region=(int(header["CAMROW"]), int(header["CAMCOL"])), **values)
