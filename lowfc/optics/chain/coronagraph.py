"""The science image of a shaped-pupil coronagraph: what a wavefront does to the contrast (Fig. 1).

Contrast is intensity over the peak of the star with a flat wavefront; angles are in lambda / D (conventions: `grid`).
"""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Mask
from lowfc.optics.chain.fourier import kernel
from lowfc.optics.chain.grid import image_axis


@dataclass(frozen=True)
class Wedge:
    """Part of the focal plane on both sides of the star; the default is the dark zone of the shipped pupil.

    Attributes:
        inner: Radius, in lambda / D.
        outer: Radius, in lambda / D.
        half_opening_deg: Angle between its edges and the x axis.
    """

    inner: float = 4.0
    outer: float = 20.0
    half_opening_deg: float = 42.5

    def __post_init__(self) -> None:
        if not (0 <= self.inner < self.outer and 0 < self.half_opening_deg <= 90):
            raise ValueError(
                f"a wedge needs 0 <= inner < outer and an opening of at most 90 degrees to either side, got {self}"
            )


DARK_ZONE = Wedge()


def contrast(
    pupil: Array, opd_nm: Array, wavelength_nm: float, columns: int, rows: int | None = None, samples_per: int = 4
) -> Array:
    """Contrast (rows, columns) in the middle of the science focal plane, on `image_axis` in either direction.

    Args:
        pupil: (n, n) amplitude transmission of the shaped pupil.
        opd_nm: Wavefront (n, n).
        wavelength_nm: The wavelength.
        columns: Samples along x.
        rows: Samples along y; as many as columns when None.
        samples_per: Samples per lambda / D; two are enough for means, for the intensity's band is 1 D to either side.

    Raises:
        ValueError: The wavefront is not sampled like the pupil.
    """
    if opd_nm.shape != pupil.shape:
        raise ValueError(f"a wavefront must be sampled like the pupil, {pupil.shape}, got {opd_nm.shape}")
    in_x = kernel(columns, samples_per, len(pupil), 1.0)
    in_y = kernel(columns if rows is None else rows, samples_per, len(pupil), 1.0)
    field = in_y @ (pupil * np.exp((2j * np.pi / wavelength_nm) * opd_nm)) @ in_x.T
    return np.asarray((field.real**2 + field.imag**2) / np.sum(pupil) ** 2)


def wedge_samples(wedge: Wedge, columns: int, rows: int, samples_per: int = 4) -> Mask:
    """Samples (rows, columns) of an image that lie in the wedge."""
    x, y = image_axis(columns, samples_per), image_axis(rows, samples_per)[:, None]
    r = np.hypot(x, y)
    opening = np.abs(y) <= np.tan(np.deg2rad(wedge.half_opening_deg)) * np.abs(x)
    return np.asarray((r >= wedge.inner) & (r <= wedge.outer) & opening)


def mean_contrast(pupil: Array, opd_nm: Array, wavelength_nm: float, wedge: Wedge, samples_per: int = 4) -> float:
    """Mean contrast in a wedge, from the samples around it alone; arguments and shapes as for `contrast`."""
    columns, rows = _extent(wedge, samples_per)
    image = contrast(pupil, opd_nm, wavelength_nm, columns, rows, samples_per)
    return float(image[wedge_samples(wedge, columns, rows, samples_per)].mean())


def contrast_curve(
    pupil: Array, opd_nm: Array, wavelength_nm: float, edges: Array, wedge: Wedge = DARK_ZONE, samples_per: int = 4
) -> Array:
    """Contrast (rings,) averaged in azimuth within a wedge's opening, Fig. 1(c); other arguments as for `contrast`.

    Args:
        pupil: The shaped pupil.
        opd_nm: Wavefront.
        wavelength_nm: The wavelength.
        edges: (rings + 1,) radii between the rings, in lambda / D, each at least a sample's distance from the next.
        wedge: Its opening alone counts.
        samples_per: Samples per lambda / D.
    """
    whole = Wedge(0.0, float(edges[-1]), wedge.half_opening_deg)
    columns, rows = _extent(whole, samples_per)
    inside = wedge_samples(whole, columns, rows, samples_per)
    radius = np.hypot(image_axis(rows, samples_per)[:, None], image_axis(columns, samples_per))[inside]
    values = contrast(pupil, opd_nm, wavelength_nm, columns, rows, samples_per)[inside]
    count, _ = np.histogram(radius, edges)
    total, _ = np.histogram(radius, edges, weights=values)
    return np.asarray(total / count)


def _extent(wedge: Wedge, samples_per: int) -> tuple[int, int]:
    """Columns and rows of the smallest image about the star that holds the wedge."""
    height = wedge.outer * np.sin(np.deg2rad(wedge.half_opening_deg))
    return 2 * int(np.ceil(wedge.outer * samples_per)), 2 * int(np.ceil(height * samples_per))
