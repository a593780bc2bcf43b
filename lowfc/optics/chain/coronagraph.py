"""The science image of a coronagraph: contrast for a given wavefront (Subedi et al. 2015, Fig. 1).

A shaped pupil is imaged directly; a Lyot coronagraph has an opaque mask and a stop in between. Contrast is
intensity divided by the peak of the star off the mask with a flat wavefront; angles are in lambda / D (see `grid`).
"""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Complex, Mask
from lowfc.optics.chain.fourier import kernel, to_image, to_pupil
from lowfc.optics.chain.grid import image_axis
from lowfc.optics.chain.pupil import aberrated

SAMPLES_PER = 4
"""Samples per lambda / D. Two represent the image, but not the sharp edge of a zone, on which the contrast added by
tilt depends: behind the shaped pupil, two samples give a tenth of the contrast that 32 samples give. Four samples are
within 20 % of the contrast with 32, for other modes too."""


@dataclass(frozen=True)
class Wedge:
    """Part of the focal plane on both sides of the star; the default is the dark zone of the package's shaped pupil.

    Attributes:
        inner: Inner radius, in lambda / D.
        outer: Outer radius, in lambda / D.
        half_opening_deg: Angle between the edges and the x axis.
    """

    inner: float = 4.0
    outer: float = 20.0
    half_opening_deg: float = 42.5

    def __post_init__(self) -> None:
        if not (0 <= self.inner < self.outer and 0 < self.half_opening_deg <= 90):
            raise ValueError(
                f"a wedge needs 0 <= inner < outer and an opening of at most 90 degrees to either side, got {self}"
            )

    @property
    def is_sampled(self) -> bool:
        """Whether the wedge holds a sample of an image with two samples per lambda / D."""
        side = 4 * int(np.ceil(self.outer))
        return bool(wedge_samples(self, side, side, 2).any())


DARK_ZONE = Wedge()


@dataclass(frozen=True, eq=False)
class LyotStop:
    """The elements of a Lyot coronagraph after its pupil: opaque focal-plane mask and Lyot stop.

    Attributes:
        opaque: (k, k) fraction of the amplitude that the focal-plane mask blocks, 0 to 1; the blocked light goes
            to the sensor.
        stop: (n, n) amplitude transmission of the Lyot stop in the pupil after the mask.
        samples_per: Samples of `opaque` per lambda / D.
    """

    opaque: Array
    stop: Array
    samples_per: int = 8

    def behind(self, field: Array | Complex) -> Complex:
        """Field (n, n) after the stop, for a pupil field before the mask; the blocked part is subtracted (Babinet)."""
        return np.asarray(self.stop * (field - self._blocked(field)))

    def transposed(self, field: Complex) -> Complex:
        """The transposed operator of `behind`, applied to a field (n, n) after the stop; `_blocked` is self-adjoint."""
        stopped = self.stop * field
        return np.asarray(stopped - self._blocked(stopped.conj()).conj())

    def _blocked(self, field: Array | Complex) -> Complex:
        """Field (n, n) in the stop's plane of the light that the mask blocks."""
        focal = to_image(field, len(self.opaque), self.samples_per, 1.0)
        return to_pupil(focal * self.opaque, len(field), self.samples_per, 1.0)


@dataclass(frozen=True, eq=False)
class Coronagraph:
    """The optics of the science image.

    Attributes:
        pupil: (n, n) amplitude transmission.
        dark_zone: Region in which contrast is evaluated.
        lyot: Mask and stop of a Lyot coronagraph; None for a shaped pupil alone.
    """

    pupil: Array
    dark_zone: Wedge = DARK_ZONE
    lyot: LyotStop | None = None

    @property
    def peak(self) -> float:
        """Amplitude at the centre of the star's image with a flat wavefront, as if the star were off the mask."""
        return float((self.pupil if self.lyot is None else self.pupil * self.lyot.stop).sum())

    def behind(self, field: Array | Complex) -> Array | Complex:
        """Field (n, n) in the last pupil before the science camera, for a field (n, n) after the pupil's mask."""
        return field if self.lyot is None else self.lyot.behind(field)


def contrast(
    coronagraph: Coronagraph,
    opd_nm: Array,
    wavelength_nm: float,
    columns: int,
    rows: int | None = None,
    samples_per: int = SAMPLES_PER,
) -> Array:
    """Contrast (rows, columns) around the star, sampled on `image_axis` in both directions.

    Args:
        coronagraph: The optics.
        opd_nm: Wavefront (n, n), sampled like the pupil.
        wavelength_nm: The wavelength.
        columns: Number of samples along x.
        rows: Number of samples along y; as many as columns when None.
        samples_per: Samples per lambda / D.

    Raises:
        ValueError: The wavefront is not sampled like the pupil.
    """
    pupil = coronagraph.pupil
    in_x = kernel(columns, samples_per, len(pupil), 1.0)
    in_y = kernel(columns if rows is None else rows, samples_per, len(pupil), 1.0)
    image = in_y @ coronagraph.behind(aberrated(pupil, opd_nm, wavelength_nm)) @ in_x.T
    return np.asarray((image.real**2 + image.imag**2) / coronagraph.peak**2)


def wedge_samples(wedge: Wedge, columns: int, rows: int, samples_per: int = SAMPLES_PER) -> Mask:
    """Mask (rows, columns) of the samples of an image that lie in the wedge."""
    x, y = image_axis(columns, samples_per), image_axis(rows, samples_per)[:, None]
    r = np.hypot(x, y)
    opening = np.abs(y) <= np.tan(np.deg2rad(wedge.half_opening_deg)) * np.abs(x)
    return np.asarray((r >= wedge.inner) & (r <= wedge.outer) & opening)


def mean_contrast(
    coronagraph: Coronagraph, opd_nm: Array, wavelength_nm: float, wedge: Wedge, samples_per: int = SAMPLES_PER
) -> float:
    """Mean contrast in a wedge; arguments and shapes as for `contrast`."""
    columns, rows = _extent(wedge, samples_per)
    image = contrast(coronagraph, opd_nm, wavelength_nm, columns, rows, samples_per)
    return float(image[wedge_samples(wedge, columns, rows, samples_per)].mean())


def contrast_curve(coronagraph: Coronagraph, opd_nm: Array, wavelength_nm: float, edges: Array) -> Array:
    """Contrast (rings,) averaged in azimuth within the opening of `DARK_ZONE`, Fig. 1(c); arguments as for `contrast`.

    `edges` (rings + 1,) are the radii of the rings' edges, in lambda / D. The first radius and the spacing must be at
    least the spacing of samples, 1 / `SAMPLES_PER`; a ring without a sample is NaN.
    """
    sector = Wedge(0.0, float(edges[-1]), DARK_ZONE.half_opening_deg)
    columns, rows = _extent(sector, SAMPLES_PER)
    inside = wedge_samples(sector, columns, rows)
    radius = np.hypot(image_axis(rows, SAMPLES_PER)[:, None], image_axis(columns, SAMPLES_PER))[inside]
    values = contrast(coronagraph, opd_nm, wavelength_nm, columns, rows)[inside]
    count, _ = np.histogram(radius, edges)
    total, _ = np.histogram(radius, edges, weights=values)
    return np.asarray(total / count)


def _extent(wedge: Wedge, samples_per: int) -> tuple[int, int]:
    """Columns and rows of the smallest image centred on the star that contains the wedge."""
    height = wedge.outer * np.sin(np.deg2rad(wedge.half_opening_deg))
    return 2 * int(np.ceil(wedge.outer * samples_per)), 2 * int(np.ceil(height * samples_per))
