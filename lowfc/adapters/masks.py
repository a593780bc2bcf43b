"""Pupils from files, and a sensor built from the names of its masks."""

import logging
from collections.abc import Callable
from importlib import resources
from importlib.resources.abc import Traversable

import numpy as np
from numpy.typing import NDArray

from lowfc.adapters.layouts import DEFAULT_SAM, layout_warnings, load_layout
from lowfc.contract.errors import ConfigurationError, DataFileError, nearest
from lowfc.optics import focal_mask as focal_masks
from lowfc.optics import sam as sams
from lowfc.optics.pupil import from_quarter
from lowfc.optics.sensor import Sensor

_DATA = resources.files("lowfc") / "data"
_log = logging.getLogger(__name__)


def load_pupil(samples: int = 512, file: Traversable = _DATA / "spc_quarter128.npz") -> NDArray[np.float64]:
    """The shaped pupil (samples, samples): 1e-9 between 4 and 20 lambda/D within 42.5 degrees of the x axis.

    Args:
        samples: Across the diameter, a multiple of 256.
        file: An npz file whose array `quarter` is the quadrant x >= 0, y >= 0.

    Raises:
        DataFileError: The file is missing, damaged or holds no such quadrant.
        ConfigurationError: The quadrant does not divide `samples`.
    """
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            quarter = np.asarray(arrays["quarter"], dtype=np.float64)
    except FileNotFoundError:
        raise DataFileError(f"there is no pupil file {file}") from None
    except Exception as error:  # zipfile, zlib and numpy each raise their own on a damaged file
        raise DataFileError(f"{file} is damaged, or not a pupil file with an array `quarter`: {error}") from error
    try:
        from_quarter(quarter, 2 * len(quarter))
    except ValueError as error:
        raise DataFileError(f"{file}: {error}") from error
    try:
        return from_quarter(quarter, samples)
    except ValueError as error:
        raise ConfigurationError(f"pupil sampling: {error}") from error


def sensor_from(
    sam: str = DEFAULT_SAM,
    focal_mask: str = "disk",
    wavelength_nm: float = 550.0,
    warn: Callable[[str], None] = _log.warning,
) -> Sensor:
    """The paper's sensor (Table 1) with the shipped shaped pupil.

    Args:
        sam: See `load_layout`.
        focal_mask: "disk" of 4 lambda/D, or "bowtie" (Fig. 3).
        wavelength_nm: The central wavelength.
        warn: Called with each of `layout_warnings`.

    Raises:
        ConfigurationError: A name is not known, or the wavelength is not positive.
        DataFileError: A file is missing or damaged, or a layout is impossible.
    """
    makers = {"disk": focal_masks.disk, "bowtie": focal_masks.bowtie}
    if focal_mask not in makers:
        raise ConfigurationError(
            f"no focal-plane mask is called {focal_mask!r}{nearest(focal_mask, makers)}; {', '.join(makers)}"
        )
    layout = load_layout(sam)
    for text in layout_warnings(layout):
        warn(text)
    pupil = load_pupil()
    try:
        return Sensor(pupil, makers[focal_mask](), sams.transmission(layout, len(pupil)), wavelength_nm)
    except ValueError as error:
        raise ConfigurationError(f"sensor: {error}") from error
