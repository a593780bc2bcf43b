"""The coronagraph's focal-plane mask: the part that reflects starlight to the sensor."""

import numpy as np

from lowfc.arrays import Array, Complex
from lowfc.optics.chain.grid import image_axis

_FINE = 16  # subsamples across a sample, for the fraction of it that the phase spot covers


def disk(samples_per: int = 8, radius: float = 4.0, inner_radius: float = 0.0) -> Array:
    """Reflecting disk (Sect. 2.1 of the paper) or annulus (Sect. 2.4), on the smallest square grid that contains it.

    Args:
        samples_per: Samples per lambda0 / D.
        radius: Radius, in lambda0 / D.
        inner_radius: Radius of a central hole, in lambda0 / D; 0 for a disk.
    """
    r, _ = _polar(samples_per, radius)
    return np.asarray((r <= radius) & (r >= inner_radius), dtype=np.float64)


def phase_spot(samples_per: int = 8, radius: float = 4.0, spot_diameter: float = 1.06) -> Complex:
    """The disk with a central spot that delays the light by a quarter of a wave, as in a Zernike sensor.

    Samples on the spot's edge are area-weighted means of spot and disk, as the spot is only 8.5 samples wide by
    default. The delay is a quarter of a wave at every wavelength, and the physical size of the spot is fixed.

    Args:
        samples_per: Samples per lambda0 / D.
        radius: Radius of the disk, in lambda0 / D.
        spot_diameter: Diameter of the spot, in lambda0 / D.
    """
    mask = disk(samples_per, radius)
    size = len(mask)
    x = image_axis(size * _FINE, samples_per * _FINE)
    inside = np.hypot(x[:, None], x) <= spot_diameter / 2.0
    covered = inside.reshape(size, _FINE, size, _FINE).mean(axis=(1, 3))
    return np.asarray(mask * (1.0 + (1j - 1.0) * covered))


def bowtie(samples_per: int = 8, radius: float = 4.0, outer_radius: float = 10.0, opening_deg: float = 95.0) -> Array:
    """The disk, and wedges above and below it out to the outer radius (Fig. 3 of the paper); radii in lambda0 / D."""
    r, from_vertical = _polar(samples_per, outer_radius)
    wedge = (r <= outer_radius) & (from_vertical <= np.deg2rad(opening_deg) / 2.0)
    return np.asarray((r <= radius) | wedge, dtype=np.float64)


def _polar(samples_per: int, radius: float) -> tuple[Array, Array]:
    """Radius, in lambda0 / D, and angle from the y axis, 0 to pi / 2, of samples (k, k) for a mask of this radius."""
    x = image_axis(2 * int(np.ceil(radius * samples_per)), samples_per)
    return np.hypot(x[:, None], x), np.arctan2(np.abs(x), np.abs(x)[:, None])
