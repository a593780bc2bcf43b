"""The coronagraph's focal-plane mask: the part that reflects star light to the sensor."""

import numpy as np
from numpy.typing import NDArray

from lowfc.optics.grid import image_axis

FOCAL_MASKS = ("disk", "bowtie")


def disk(samples_per: int = 8, radius: float = 4.0) -> NDArray[np.float64]:
    """Reflecting disk of a radius in lambda0 / D (Sect. 2.1), on the smallest square grid that holds it."""
    r, _ = _polar(samples_per, radius)
    return np.asarray(r <= radius, dtype=np.float64)


def bowtie(
    samples_per: int = 8, radius: float = 4.0, outer_radius: float = 10.0, opening_deg: float = 95.0
) -> NDArray[np.float64]:
    """The disk and a wedge above and below it out to the outer radius (Fig. 3); radii in lambda0 / D."""
    r, from_vertical = _polar(samples_per, outer_radius)
    wedge = (r <= outer_radius) & (from_vertical <= np.deg2rad(opening_deg) / 2.0)
    return np.asarray((r <= radius) | wedge, dtype=np.float64)


def _polar(samples_per: int, radius: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x = image_axis(2 * int(np.ceil(radius * samples_per)), samples_per)
    return np.hypot(x[:, None], x), np.arctan2(np.abs(x), np.abs(x)[:, None])
