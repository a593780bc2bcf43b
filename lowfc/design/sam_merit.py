"""Performance of a sparse aperture mask, predicted fast enough to search for the best one.

The fields in the relay pupil, after the focal-plane mask, do not depend on the holes: the field of the flat wavefront
and the first-order field of each mode are propagated once (`build_optics`). Each hole adds a small product of matrices
to every field at the sensor (`hole_fields`), so that a search that moves one hole recomputes only that hole. I0 and H
(the paper's eqs. (8) and (12)) follow from the fields (`SamCandidate`); `lowfc.design.merit` computes the performance.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Complex, SingleComplex
from lowfc.design.merit import BAND, WAVELENGTH_NM, PupilForms, Signal
from lowfc.optics.chain.focal_mask import bowtie, disk
from lowfc.optics.chain.fourier import kernel, to_image, to_pupil
from lowfc.optics.chain.grid import OPEN_AREA, pupil_axis
from lowfc.optics.chain.zernike import NOLLS_20, zernikes

Hole = tuple[float, float, float]
"""Centre x, y and diameter of a hole, in pupil diameters."""

FOCAL_MASKS: dict[str, Callable[[int], Array]] = {"disk": disk, "bowtie": bowtie}

IMAGE_WIDTH = 20
"""Width of the sensor's image, in lambda0 / D (Table 1 of the paper)."""
PIXELS_PER = 4
"""Pixels per lambda0 / D (Table 1)."""
FOCAL_SAMPLES_PER = 8
"""Samples on the focal-plane mask per lambda0 / D (Sect. 3)."""
_PIXEL = 1.0 / (PIXELS_PER**2 * OPEN_AREA)
"""Fraction of the open circle's light on a pixel at which the field is 1."""

TABLE3_NONLINEARITY_WAVES = {14: 2.1e-4, 20: 3.1e-4}
"""Residual of the plain pseudo-inverse without noise, by number of modes: the second-order error for wavefronts matched
to the paper's input, which adds to the noise in quadrature. A constant, so that a search does not compute it.

Four sets of 60 or 100 wavefronts, with each packaged layout behind the disk and two behind the bowtie, gave means of
1.6e-4 to 2.1e-4 waves with 14 modes and 3.0e-4 to 3.8e-4 with 20, root mean squares of 2.0e-4 to 2.6e-4 and 3.4e-4 to
4.4e-4, and up to 1.2e-3 for a single wavefront. All means are within 25 % of the constants, and the root mean squares
at most 42 % above them."""

RELAY_SAMPLES = 128
"""Samples across the relay pupil."""
SAMPLES_PER = 2
"""Samples at the sensor per lambda0 / D: half as many as pixels, but enough to sample the image completely."""
_PIXELS_PER_SAMPLE = (PIXELS_PER / SAMPLES_PER) ** 2


@dataclass(frozen=True, eq=False)
class RelayFields:
    """Fields in the relay pupil at one wavelength.

    Attributes:
        relay: (fields, n, n) fields in the relay pupil.
        kernel: (samples, n) kernel from the relay pupil to the sensor, along one axis; conserves energy.
    """

    relay: SingleComplex
    kernel: SingleComplex


@dataclass(frozen=True, eq=False)
class Optics:
    """The optics before the sparse aperture mask.

    Attributes:
        focal_masks: Names of the focal-plane masks in Table 3. Table 4 is predicted for the first.
        groups: Fields at the central wavelength (flat wavefront and 20 modes, for each focal-plane mask), then at the
            other wavelengths of the band (flat wavefront and `band_modes` modes, for the first focal-plane mask).
        band_modes: Number of modes, tilts first, that can be fitted in Table 4.
        forms: Quadratic forms of the shaped pupil.
        at_pixels: (pixels, samples) interpolation of a field from its samples to the pixel centres, along one axis.
    """

    focal_masks: tuple[str, ...]
    groups: tuple[RelayFields, ...]
    band_modes: int
    forms: PupilForms
    at_pixels: SingleComplex


def build_optics(pupil: Array, focal_masks: tuple[str, ...] = ("disk",), band_modes: int = 2) -> Optics:
    """Propagate the flat wavefront and the modes to the relay pupil, eq. (4).

    With `RELAY_SAMPLES` and `SAMPLES_PER` every predicted value of a mask is within 3 % of that with the paper's
    sampling (Table 1), but the share of the quantum limit is up to 8 % too large: pixels lose information near the
    zeros of the image.

    Args:
        pupil: (n, n) amplitude transmission of the shaped pupil.
        focal_masks: Names in `FOCAL_MASKS`.
        band_modes: Number of modes, tilts first, that can be fitted in Table 4; a search needs the two tilts.
    """
    u = 2.0 * pupil_axis(len(pupil))
    modes = zernikes(NOLLS_20, u, u[:, None])
    amplitudes = [pupil.astype(np.complex128), *(pupil * modes).astype(np.complex128)]
    samples = IMAGE_WIDTH * SAMPLES_PER

    def group(scale: float, names: tuple[str, ...], count: int) -> RelayFields:
        masks = [FOCAL_MASKS[name](FOCAL_SAMPLES_PER) for name in names]
        relay = [_relay(field, mask, scale) for mask in masks for field in amplitudes[:count]]
        to_sensor = kernel(samples, SAMPLES_PER, RELAY_SAMPLES, scale)
        return RelayFields(
            np.stack(relay).astype(np.complex64), (to_sensor * scale**0.5 / RELAY_SAMPLES).astype(np.complex64)
        )

    others = [nm for nm in BAND.wavelengths_nm if nm != WAVELENGTH_NM]
    groups = [group(1.0, focal_masks, 1 + len(modes))]
    groups += [group(WAVELENGTH_NM / nm, focal_masks[:1], 1 + band_modes) for nm in others]
    at_samples = kernel(samples, SAMPLES_PER, RELAY_SAMPLES, 1.0)
    at_centres = kernel(IMAGE_WIDTH * PIXELS_PER, PIXELS_PER, RELAY_SAMPLES, 1.0)
    return Optics(
        focal_masks,
        tuple(groups),
        band_modes,
        PupilForms.of(pupil, modes),
        (at_centres @ np.linalg.pinv(at_samples, rcond=1e-3)).astype(np.complex64),
    )


def hole_fields(optics: Optics, hole: Hole) -> SingleComplex:
    """Fields (fields, samples, samples) that a hole (x, y, diameter) adds at the sensor, eqs. (2), (6) and (7).

    Samples on the rim are weighted by the fraction that the hole covers.
    """
    x, y, diameter = hole
    n = optics.groups[0].relay.shape[1]
    u = pupil_axis(n)
    rows, columns = _covered(n, y, diameter), _covered(n, x, diameter)
    radius = np.sqrt(max(diameter**2 / 4.0 - 1.0 / (12.0 * n**2), 0.0))  # smaller, as the soft rim adds to the area
    open_part = np.clip((radius - np.hypot(u[rows, None] - y, u[columns] - x)) * n + 0.5, 0.0, 1.0)
    open_part = open_part.astype(np.float32)
    parts = []
    for group in optics.groups:
        patch = group.relay[:, rows, columns] * open_part
        parts.append(group.kernel[:, rows] @ (patch @ group.kernel[:, columns].T))
    return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class SamCandidate:
    """A sparse aperture mask as a `Candidate`.

    Attributes:
        optics: The optics before the mask.
        fields: (fields, samples, samples) sum of `hole_fields` over the holes of the mask.
    """

    optics: Optics
    fields: SingleComplex
    paper_tilt = "sam"

    @property
    def forms(self) -> PupilForms:
        """Quadratic forms of the shaped pupil."""
        return self.optics.forms

    @property
    def paper_rows(self) -> tuple[str, ...]:
        """Names of the focal-plane masks."""
        return self.optics.focal_masks

    def central(self, row: str) -> Signal:
        """I0 and H at the central wavelength with one focal-plane mask, for Table 3."""
        count, to_pixels = 1 + len(NOLLS_20), self.optics.at_pixels
        first = count * self.optics.focal_masks.index(row)
        I0, H = _image_and_response(self.fields[first : first + count], WAVELENGTH_NM)
        flat = to_pixels @ self.fields[first] @ to_pixels.T
        peak = float(np.max(flat.real**2 + flat.imag**2)) * _PIXEL
        return Signal(I0, H, _PIXELS_PER_SAMPLE, peak)

    @property
    def in_band(self) -> Signal:
        """I0 and H in the band with the first focal-plane mask."""
        optics, fields = self.optics, self.fields
        count = 1 + optics.band_modes
        other_starts = iter(range((1 + len(NOLLS_20)) * len(optics.focal_masks), len(fields), count))
        I0: Array = np.zeros(fields[0].size)
        H: Array = np.zeros((fields[0].size, optics.band_modes))
        for wavelength_nm, weight in zip(BAND.wavelengths_nm, BAND.weights, strict=True):
            start = 0 if wavelength_nm == WAVELENGTH_NM else next(other_starts)
            image, response = _image_and_response(fields[start : start + count], wavelength_nm)
            I0, H = I0 + weight * image, H + weight * response
        return Signal(I0, H, _PIXELS_PER_SAMPLE, float(I0.max()))

    def nonlinearity_waves(self, modes: int) -> float:
        """A constant, the same for all masks."""
        return TABLE3_NONLINEARITY_WAVES[modes]


def _relay(amplitude: Complex, mask: Array, scale: float) -> Complex:
    focal = to_image(amplitude, len(mask), FOCAL_SAMPLES_PER, scale)
    return to_pupil(focal * mask, RELAY_SAMPLES, FOCAL_SAMPLES_PER, scale)


def _covered(samples: int, centre: float, diameter: float) -> slice:
    """Slice of the samples along one axis that a hole may cover."""
    first = int(np.floor((centre - diameter / 2.0 + 0.5) * samples)) - 1
    last = int(np.ceil((centre + diameter / 2.0 + 0.5) * samples)) + 1
    return slice(max(first, 0), min(last, samples))


def _image_and_response(fields: SingleComplex, wavelength_nm: float) -> tuple[Array, Array]:
    """Image (samples,) per pixel, and its derivative (samples, modes) per nm, (4 pi / lambda) Im{E0 conj(Ek)}."""
    flat, modes = fields[0], fields[1:]
    I0 = (flat.real**2 + flat.imag**2).ravel().astype(np.float64)
    slopes = (flat.imag * modes.real - flat.real * modes.imag).reshape(len(modes), -1).astype(np.float64)
    return I0 * _PIXEL, slopes.T * (_PIXEL * 4.0 * np.pi / wavelength_nm)
