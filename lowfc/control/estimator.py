"""From a frame to modal errors: dark, flux normalisation, reference, reconstructor."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.control.calibration import Calibration

Single = npt.NDArray[np.float32]


class Estimate(NamedTuple):
    """Modal errors of a frame (modes,), nm of wavefront rms, and what was seen of its light."""

    error_nm: Single
    flux_dn: float


def saturated_pixels(calibration: Calibration, pixels: npt.NDArray[np.uint16]) -> int:
    """How many good pixels of a frame (pixels,) are at full well."""
    if pixels.max() < calibration.saturation_dn:
        return 0
    return int(np.count_nonzero((pixels >= calibration.saturation_dn) & (calibration.good > 0)))


def difference(
    calibration: Calibration, pixels: npt.NDArray[np.uint16], least_flux_dn: float, out: Single
) -> float | None:
    """Put (I - dark) / flux - I0 of a frame (pixels,) into `out` (pixels,), float32.

    Returns:
        The flux: the sum of the good pixels, dark subtracted, DN. None where it is at most `least_flux_dn`; `out` then
        holds I - dark.
    """
    np.subtract(pixels, calibration.dark, out=out)
    flux_dn = float(out @ calibration.good)
    if not flux_dn > least_flux_dn:
        return None
    out *= np.float32(1 / flux_dn)
    out -= calibration.reference
    return flux_dn


def estimate(
    calibration: Calibration, pixels: npt.NDArray[np.uint16], least_flux_dn: float, scratch: Single
) -> Estimate | None:
    """Modal error R ((I - dark) / flux - I0) of a frame (pixels,); None where the flux is at most `least_flux_dn`.

    `scratch` (pixels,) float32 is overwritten, so that nothing the size of a frame is allocated.
    """
    flux_dn = difference(calibration, pixels, least_flux_dn, scratch)
    return None if flux_dn is None else Estimate(calibration.reconstructor @ scratch, flux_dn)
