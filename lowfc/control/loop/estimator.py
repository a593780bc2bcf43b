"""Modal errors of a frame: dark, flux normalisation, reference, reconstructor."""

from typing import NamedTuple

import numpy as np

from lowfc.arrays import Pixels, Single, aligned
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.kernel.tables import NUMPY, Estimate, Kernel, Tables


class Estimator(NamedTuple):
    """R times the `difference` of a frame, in the fastest order of operations: one product gives R (I - dark) and flux.

    Rounding adds about 1e-5 nm to a mode of the paper's sensor.

    Attributes:
        rows: (modes + 1, pixels) R, and below it the good pixels.
        reference_nm: (modes,) R I0.
        dark: (pixels,) DN.
        scratch: (pixels,) overwritten by every frame, so that no array of a frame's size is allocated; it carries no
            data from one call to the next.
        kernel: implementation for normal frames.
        tables: arrays of its compiled functions; None if it has none.
    """

    rows: Single
    reference_nm: Single
    dark: Single
    scratch: Single
    kernel: Kernel
    tables: Tables | None

    @classmethod
    def of(cls, calibration: Calibration, kernel: Kernel = NUMPY) -> "Estimator":
        """The estimator of a calibration."""
        R, I0 = calibration.reconstructor, calibration.reference
        reference_nm = (R.astype(np.float64) @ I0).astype(np.float32)
        tables = Tables.of(kernel, calibration, reference_nm)
        rows, dark = aligned(np.vstack([R, calibration.good])), aligned(calibration.dark)
        return cls(rows, reference_nm, dark, scratch=aligned(dark), kernel=kernel, tables=tables)

    def estimate(self, pixels: Pixels, min_flux_dn: float) -> Estimate | None:
        """Estimate of a frame (pixels,) by the numpy step; None if its flux is at most `min_flux_dn`."""
        np.copyto(self.scratch, pixels)  # a copy and a subtraction are faster than a subtraction of two types
        np.subtract(self.scratch, self.dark, out=self.scratch)
        sums = self.rows.dot(self.scratch)  # takes half a microsecond less than `@`
        flux_dn = float(sums[-1])
        if not flux_dn > min_flux_dn:
            return None
        return Estimate(sums[:-1] * np.float32(1 / flux_dn) - self.reference_nm, flux_dn)


def difference(calibration: Calibration, pixels: Pixels, min_flux_dn: float, out: Single) -> float | None:
    """Write (I - dark) / flux - I0 of a frame (pixels,) into `out` (pixels,), float32.

    Returns:
        The flux: the sum of the good pixels, dark subtracted, DN. None if it is at most `min_flux_dn`; `out` then
        holds I - dark.
    """
    np.subtract(pixels, calibration.dark, out=out)
    flux_dn = float(out @ calibration.good)
    if not flux_dn > min_flux_dn:
        return None
    out *= np.float32(1 / flux_dn)
    out -= calibration.reference
    return flux_dn


def fill_saturated(calibration: Calibration, pixels: Pixels) -> Pixels:
    """Replace the saturated pixels of a frame (pixels,) DN by dark plus I0, scaled to the flux of the other pixels.

    A pixel with a cosmic ray hit carries no wavefront information, but its charge would enter the modal errors.
    """
    full = pixels >= calibration.saturation_dn
    others = calibration.good * ~full
    light, share = float((pixels - calibration.dark) @ others), float(calibration.reference @ others)
    flux_dn = light / share if share > 0 else 0.0
    expected = np.clip(calibration.dark + calibration.reference * np.float32(flux_dn), 0, calibration.saturation_dn)
    return np.where(full, np.rint(expected), pixels).astype(np.uint16)


def saturated_pixels(calibration: Calibration, pixels: Pixels) -> int:
    """Number of good pixels of a frame (pixels,) DN at full well."""
    if pixels.item(pixels.argmax()) < calibration.saturation_dn:
        return 0
    return int(np.count_nonzero((pixels >= calibration.saturation_dn) & (calibration.good > 0)))
