"""Placement of a real sensor's image relative to the computed one: scale, centre, rotation, parity.

A rotation by 180 degrees does not change the image of a flat wavefront if the field in the pupil (behind its mask) is
symmetric about its centre or real, so the reference image alone leaves this ambiguity. In the wrong orientation, odd
modes such as tip and tilt have the opposite sign (all modes, if the field is real): a poke of an odd mode shows the
right orientation. If a reflection does not change the image either, as without a mask in the relay pupil, pokes of
both tip and tilt are needed. If the image is circular, only these pokes show the rotation.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from scipy.ndimage import affine_transform, spline_filter
from scipy.optimize import least_squares

from lowfc.arrays import Array, Complex, Mask

_TRIAL_ROTATIONS = 72
"""Number of rotations that are tried before the fit, spread over 180 degrees."""
_MAX_RESIDUAL_RATIO, _SMALL_RESIDUAL = 2.0, 0.01
"""The parity with the larger residual is possible, too, if this residual is below
`_MAX_RESIDUAL_RATIO` times the smaller one, or below `_SMALL_RESIDUAL`."""
_CIRCULAR_CHANGE = 0.05
"""An image counts as circular if rotations change it by less than this fraction; sampling changes a circle by 0.01."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """Placement of the computed image on the real sensor.

    Attributes:
        scale: Real pixels per computed pixel.
        row: Real row of the computed image's centre.
        column: Real column of the computed image's centre.
        rotation_deg: Counter-clockwise, from the column axis towards the row axis, after the reflection.
        parity: 1, or -1 if the real image is reflected (columns reversed).
    """

    scale: float
    row: float
    column: float
    rotation_deg: float
    parity: int

    def rotated(self, angle_deg: float) -> "Geometry":
        """The geometry rotated further by an angle; its rotation is between -180 and 180 degrees."""
        return replace(self, rotation_deg=(self.rotation_deg + angle_deg + 180) % 360 - 180)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Result of a fit: geometry and uniform background of the real image, and the residual.

    Attributes:
        geometry: Geometry of the better parity; its rotation may be off by 180 degrees.
        background: Background of each real pixel, in the unit of the image.
        residual: Rms of real minus fitted image, relative to the standard deviation of the real image.
        other_parity: Residual for the other parity, also relative.
        orientations: Geometries that the image does not distinguish.
        circular: Whether the image is the same at all rotations, so that the rotations in `orientations` are arbitrary.
    """

    geometry: Geometry
    background: float
    residual: float
    other_parity: float
    orientations: list[Geometry]
    circular: bool


def onto(image: Array, geometry: Geometry, shape: tuple[int, int]) -> Array:
    """Resample a computed image (rows, columns), or images (rows, columns, images), onto the real sensor's pixels.

    Flux is conserved. The image is a cubic spline between its pixels, and zero beyond them.

    Args:
        image: Image on the computed sensor, in any unit.
        geometry: Geometry of the real sensor.
        shape: Real rows and columns.
    """
    if image.ndim == 3:
        return np.stack([onto(image[..., k], geometry, shape) for k in range(image.shape[2])], axis=2)
    return _sample(spline_filter(np.asarray(image, np.float64)), geometry, shape)


def align(real: Array, computed: Array, good: Mask | None = None) -> Alignment:
    """Fit the geometry of a real reference image to the computed one.

    Args:
        real: (rows, columns) real image, dark subtracted, any unit.
        computed: (rows, columns) computed reference image, any unit.
        good: (rows, columns) whether each pixel is used; None for all.

    Raises:
        ValueError: the image has no light, or does not resemble the computed one.
    """
    real, used = np.asarray(real, np.float64), np.ones(real.shape, np.bool_) if good is None else good
    computed = np.asarray(computed, np.float64)
    spline = spline_filter(computed)
    background = float(np.median(np.concatenate([real[0], real[-1], real[:, 0], real[:, -1]])))
    light = np.where(used, real - background, 0.0)
    if not light.sum() > 0:
        raise ValueError("the reference image has no light above the level of its edge pixels")
    # Scale 1 is tried, too, as a detector region that cuts off the image's wings falsifies the ratio of sizes; rounding
    # avoids two almost equal scales.
    scales = {round(_size(light) / _size(computed), 2), 1.0}
    spectrum = np.fft.rfft2(light, _doubled(light.shape))
    fits = []
    for parity in (1, -1):
        guesses = []
        for scale, angle in product(scales, np.arange(_TRIAL_ROTATIONS) * 180.0 / _TRIAL_ROTATIONS):
            placed, guess = _placed(computed, Geometry(scale, 0.0, 0.0, float(angle), parity), real.shape, spectrum)
            guesses.append((_residual(placed[used], real[used])[0], guess))
        guesses.sort(key=lambda each: each[0])
        fits.append(min((_refine(spline, guess, real, used) for _, guess in guesses[:3]), key=lambda each: each[0]))
    fits.sort(key=lambda each: each[0])
    (residual, best), (other, reflected) = fits
    if residual > 0.5:
        raise ValueError(
            f"the image does not resemble the computed reference: {residual:.0%} of it remains after the best fit; is "
            "this the sensor and the mask of the configuration?"
        )
    _, _, background = _residual(_sample(spline, best, real.shape)[used], real[used])
    circular = _circular(spline, computed)
    possible = [best, reflected] if circular or other < max(_MAX_RESIDUAL_RATIO * residual, _SMALL_RESIDUAL) else [best]
    possible = [replace(each, rotation_deg=(each.rotation_deg + 90) % 180 - 90) for each in possible]
    orientations = [orientation for each in possible for orientation in (each, each.rotated(180))]
    return Alignment(possible[0], background, residual, other, orientations, circular)


def _circular(spline: Array, computed: Array) -> bool:
    """Whether a computed image (rows, columns) is the same at all rotations, within the circle that fits into it."""
    rows, columns = computed.shape
    centre = Geometry(1.0, (rows - 1) / 2, (columns - 1) / 2, 0.0, 1)
    down, across = np.ogrid[:rows, :columns]
    inside = np.hypot(down - centre.row, across - centre.column) < min(rows, columns) / 2 - 1
    turned = (_sample(spline, replace(centre, rotation_deg=angle), computed.shape) for angle in (15.0, 40.0))
    return all(_residual(image[inside], computed[inside])[0] < _CIRCULAR_CHANGE for image in turned)


def _doubled(shape: tuple[int, ...]) -> tuple[int, int]:
    """Twice the rows and columns: large enough for a correlation at any offset."""
    return 2 * shape[0], 2 * shape[1]


def _placed(computed: Array, geometry: Geometry, shape: tuple[int, ...], spectrum: Complex) -> tuple[Array, Geometry]:
    """The computed image, centred on the pixel where it best matches the real image, and its geometry there.

    Args:
        computed: The computed image, to be interpolated linearly.
        geometry: Scale, rotation and parity.
        shape: Rows and columns of the real image.
        spectrum: Fourier transform of the real image, padded to twice its rows and columns.
    """
    rows, columns = shape
    model = _sample(computed, replace(geometry, row=rows, column=columns), _doubled(shape), order=1)
    correlation = np.fft.irfft2(spectrum * np.fft.rfft2(model).conj(), model.shape)[rows:, columns:]
    row, column = map(int, np.unravel_index(correlation.argmax(), correlation.shape))
    placed = model[rows - row : 2 * rows - row, columns - column : 2 * columns - column]
    return placed, replace(geometry, row=float(row), column=float(column))


def _sample(spline: Array, geometry: Geometry, shape: tuple[int, ...], order: Literal[1, 3] = 3) -> Array:
    """Sample an image, given by its spline (rows, columns), at the real pixels (`shape`); flux is conserved."""
    angle, parity = np.deg2rad(geometry.rotation_deg), geometry.parity
    turn = np.array([[np.cos(angle), -np.sin(angle)], [parity * np.sin(angle), parity * np.cos(angle)]])
    turn /= geometry.scale
    offset = (np.array(spline.shape) - 1) / 2 - turn @ [geometry.row, geometry.column]
    return np.asarray(affine_transform(spline, turn, offset, shape, order=order, prefilter=False)) / geometry.scale**2


def _residual(model: Array, real: Array) -> tuple[float, float, float]:
    """Relative residual after a fit of flux and background, and the fitted flux and background."""
    model_change, real_change = model - model.mean(), real - real.mean()
    square = float(np.vdot(model_change, model_change))
    flux = float(np.vdot(model_change, real_change)) / square if square else 0.0
    residual = real_change - flux * model_change
    return float(np.sqrt(np.mean(residual**2)) / real.std()), flux, float(real.mean() - flux * model.mean())


def _refine(spline: Array, guess: Geometry, real: Array, used: Mask) -> tuple[float, Geometry]:
    """Relative residual and geometry of the least-squares fit that starts at a guess."""

    def geometry(values: Array) -> Geometry:
        scale, row, column, rotation_deg = values.tolist()
        return Geometry(scale * guess.scale, row, column, rotation_deg, guess.parity)

    def residuals(values: Array) -> Array:
        model = _sample(spline, geometry(values), real.shape)[used]
        _, flux, background = _residual(model, image)
        return np.asarray((image - flux * model - background) / image_std)

    image = real[used]
    image_std = image.std()
    start = np.array([1.0, guess.row, guess.column, guess.rotation_deg])
    fit = least_squares(residuals, start, ftol=1e-5, x_scale=np.array([0.01, 0.3, 0.3, 1.0]), diff_step=[1e-5])
    best = geometry(fit.x)
    return float(np.sqrt(np.mean(fit.fun**2))), best


def _size(light: Array) -> float:
    """Rms size of an image in pixels; faint pixels, which are mostly noise, are ignored."""
    bright = np.where(light > 0.05 * light.max(), light, 0.0)
    rows, columns = np.indices(light.shape, dtype=np.float64)
    total = bright.sum()
    row, column = (bright * rows).sum() / total, (bright * columns).sum() / total
    return float(np.sqrt((bright * ((rows - row) ** 2 + (columns - column) ** 2)).sum() / total))
