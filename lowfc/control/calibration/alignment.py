"""How a real sensor's image is placed relative to the computed one: scale, centre, rotation, parity.

The image of a flat wavefront through a pupil without phase is the same turned by half a turn, so that the reference
image alone cannot tell a rotation from one by 180 degrees more; there every mode answers with the opposite sign. One
poke tells.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter
from scipy.optimize import least_squares

from lowfc.arrays import Array

_ANGLES = 72
"""First guesses of the rotation over half a turn."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """Position of a point of the computed image on the real sensor.

    Attributes:
        scale: Real pixels per pixel of the computed image.
        row: Real row of the computed image's centre.
        column: Real column of it.
        rotation_deg: Counter-clockwise, from the column axis towards the row axis, after the reflection.
        parity: 1, or -1 where the real image is reflected (columns reversed).
    """

    scale: float
    row: float
    column: float
    rotation_deg: float
    parity: int

    def turned(self) -> "Geometry":
        """The other one of the two that the reference image cannot tell apart."""
        return replace(self, rotation_deg=self.rotation_deg - 180 if self.rotation_deg > 0 else self.rotation_deg + 180)


@dataclass(frozen=True, slots=True)
class Alignment:
    """A fit: the geometry, the light and the uniform background of the real image, and the residual.

    Attributes:
        geometry: The better one of both parities; its rotation may be half a turn off.
        flux: Light of the real image, in its unit.
        background: In each real pixel.
        residual: Rms of real less fitted over the rms of the real image.
        other_parity: The same residual with the other parity.
    """

    geometry: Geometry
    flux: float
    background: float
    residual: float
    other_parity: float


def onto(image: Array, geometry: Geometry, shape: tuple[int, int]) -> Array:
    """A computed image (rows, columns), or images (rows, columns, many), as the real sensor's pixels see it.

    Light is kept: a value is per pixel. Between pixels it is a cubic spline; outside it is zero.

    Args:
        image: On the computed sensor.
        geometry: Of the real one.
        shape: Real rows and columns.
    """
    if image.ndim == 3:
        return np.stack([onto(image[..., k], geometry, shape) for k in range(image.shape[2])], axis=2)
    return _sample(spline_filter(np.asarray(image, np.float64)), geometry, shape)


def align(real: Array, computed: Array) -> Alignment:
    """Fit the geometry of a real reference image to the computed one.

    Args:
        real: (rows, columns) dark subtracted, any unit.
        computed: (rows, columns) I0.

    Raises:
        ValueError: there is no light in the image, or nothing in it is like the computed one.
    """
    real = np.asarray(real, np.float64)
    spline = spline_filter(np.asarray(computed, np.float64))
    background = float(np.median(np.concatenate([real[0], real[-1], real[:, 0], real[:, -1]])))
    light = real - background
    if not light.sum() > 0:
        raise ValueError("the reference image has no light above its edge")
    scales = {_size(light) / _size(np.asarray(computed, np.float64)), 1.0}  # a region may cut the image's wings off
    fits = []
    for parity in (1, -1):
        guesses = []
        for scale, angle in product(scales, np.arange(_ANGLES) * 180.0 / _ANGLES):
            guess = _placed(spline, Geometry(scale, 0.0, 0.0, float(angle), parity), light)
            guesses.append((_left(_sample(spline, guess, real.shape), real)[0], guess))
        guesses.sort(key=lambda each: each[0])
        fits.append(min((_refine(spline, guess, real) for _, guess in guesses[:3]), key=lambda each: each[0]))
    fits.sort(key=lambda each: each[0])
    (left, best), (other, _) = fits
    if left > 0.5:
        raise ValueError(
            f"nothing in the image is like the computed reference: {left:.0%} of it is left after the best fit; is "
            "this the sensor and the mask of the configuration?"
        )
    _, flux, background = _left(_sample(spline, best, real.shape), real)
    rotation = (best.rotation_deg + 90) % 180 - 90
    return Alignment(replace(best, rotation_deg=rotation), flux, background, left, other)


def _placed(spline: Array, geometry: Geometry, light: Array) -> Geometry:
    """The geometry centred where the model best matches the light, to a pixel."""
    rows, columns = light.shape
    middle = replace(geometry, row=rows // 2, column=columns // 2)
    model = _sample(spline, middle, (2 * rows, 2 * columns))  # so that it is not cut off on the other side
    likeness = np.fft.irfft2(np.fft.rfft2(light, model.shape) * np.fft.rfft2(model).conj(), model.shape)
    row, column = np.unravel_index(int(likeness.argmax()), model.shape)
    down, across = (int(row) + rows) % (2 * rows) - rows, (int(column) + columns) % (2 * columns) - columns
    return replace(middle, row=float(middle.row + down), column=float(middle.column + across))


def _sample(spline: Array, geometry: Geometry, shape: tuple[int, ...]) -> Array:
    angle = np.deg2rad(geometry.rotation_deg)
    rows, columns = np.indices(shape, dtype=np.float64)
    down, across = (rows - geometry.row) / geometry.scale, (columns - geometry.column) / geometry.scale
    x = geometry.parity * (np.cos(angle) * across + np.sin(angle) * down)
    y = np.cos(angle) * down - np.sin(angle) * across
    at = np.array([y + (spline.shape[0] - 1) / 2, x + (spline.shape[1] - 1) / 2])
    sampled = map_coordinates(spline, at, order=3, mode="constant", cval=0.0, prefilter=False)
    return np.asarray(sampled / geometry.scale**2)


def _left(model: Array, real: Array) -> tuple[float, float, float]:
    """Relative residual after the best light and background, and these two."""
    columns = np.stack([model.ravel(), np.ones(model.size)], axis=1)
    (flux, background), *_ = np.linalg.lstsq(columns, real.ravel(), rcond=None)
    rest = real.ravel() - columns @ (flux, background)
    return float(np.sqrt(np.mean(rest**2)) / real.std()), float(flux), float(background)


def _refine(spline: Array, guess: Geometry, real: Array) -> tuple[float, Geometry]:
    def geometry(values: Array) -> Geometry:
        return Geometry(
            float(values[0]) * guess.scale, float(values[1]), float(values[2]), float(values[3]), guess.parity
        )

    def rest(values: Array) -> Array:
        model = _sample(spline, geometry(values), real.shape)
        _, flux, background = _left(model, real)
        return np.asarray(((real - flux * model - background) / real.std()).ravel())

    start = np.array([1.0, guess.row, guess.column, guess.rotation_deg])
    fit = least_squares(rest, start, x_scale=np.array([0.01, 0.3, 0.3, 1.0]), diff_step=[1e-5])
    best = geometry(fit.x)
    return float(np.sqrt(np.mean(fit.fun**2))), best


def _size(light: Array) -> float:
    """Rms size of an image in pixels; faint pixels, mostly noise, are left out."""
    bright = np.where(light > 0.05 * light.max(), light, 0.0)
    rows, columns = np.indices(light.shape, dtype=np.float64)
    total = bright.sum()
    row, column = (bright * rows).sum() / total, (bright * columns).sum() / total
    return float(np.sqrt((bright * ((rows - row) ** 2 + (columns - column) ** 2)).sum() / total))
