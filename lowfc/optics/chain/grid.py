"""Sample grids, and the conventions of all optics modules.

The conventions::

    arrays      [row = y, column = x]; y grows with the row index
    pupils      coordinates u in pupil diameters, u_i = (i + 1/2) / n - 1/2
    images      coordinates x in lambda0 / D, x_i = (i - (n - 1) / 2) / samples_per; lambda0 is the central wavelength
    kernels     pupil to focal plane exp(-2 pi i x u lambda0 / lambda), focal plane to relay pupil its conjugate (so the
                relay pupil is upright), relay pupil to sensor the same as pupil to focal plane
    phase       2 pi OPD / lambda; wavefronts are optical path differences in nm
    intensity   the light on a pixel divided by the light that enters the open circular pupil, before any mask

Numbers of samples are even: samples lie at half-integer offsets from the optical axis, and none is at zero. Focal-plane
mask and pixels are hardware: their size in lambda0 / D does not change with the wavelength. "The paper" is Subedi et
al. 2015 (doi 10.1117/1.JATIS.1.3.039001); sections, tables and equations without another source are the paper's.
"""

import numpy as np

from lowfc.arrays import Array

SAMPLES = 512
"""Samples across a pupil, as in Table 1 of the paper."""

OPEN_AREA = np.pi / 4.0
"""Area of the open circular pupil, in squared pupil diameters."""


def pupil_axis(samples: int) -> Array:
    """Coordinates (samples,) across a pupil, in pupil diameters."""
    return (np.arange(samples) + 0.5) / samples - 0.5


def image_axis(samples: int, samples_per: float) -> Array:
    """Coordinates (samples,) across a focal plane, in lambda0 / D, with `samples_per` samples per lambda0 / D."""
    return np.asarray((np.arange(samples) - (samples - 1) / 2.0) / samples_per)
