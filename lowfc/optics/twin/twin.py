"""The digital twin: the optics compressed to a few small matrices, and their evaluation.

At each wavelength the field at the sensor is linear in exp(i phi) at the pupil nodes, and both are band-limited:

    exp(i phi) --to_modes--> modes --to_coefficients--> coefficients of prolate functions --basis--> field at points

The intensity is band-limited to twice the field's band, so it is evaluated at few points of each axis. Two small
products give the pixels: `image = to_pixels |E|^2 to_pixels'`. `twin_build` computes the matrices from a `Sensor`.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from lowfc.arrays import Array, Complex, Integers, Single


@dataclass(frozen=True)
class TwinSpec:
    """Degree of compression. By default, images of the named sensors have an rms error below 1e-4 of the image's rms.

    For other combinations of pupil, focal-plane mask and relay, rms errors of up to 2e-3 were found.

    Attributes:
        nodes: Pupil nodes across the diameter.
        order: Number of nodes from which a point is interpolated along an axis; even.
        rank: Retained singular modes of the operator, for an aperture mask and a focal-plane mask with the area of a
            disk of radius 4 lambda0 / D. `build` scales it with the mask's area, and increases it for a pupil
            whose mean transmission is above 0.5, and without an aperture mask.
        guards: Prolate functions along each axis beyond the product of the field's bandwidth and the sensor's width.
    """

    nodes: int = 32
    order: int = 6
    rank: int = 60
    guards: int = 8


FAST = TwinSpec()
ACCURATE = TwinSpec(nodes=64, order=6, rank=80, guards=10)


@dataclass(frozen=True, eq=False)
class Operator:
    """The optics at one wavelength.

    Attributes:
        wavelength_nm: The wavelength.
        weight: Weight of this wavelength in the image of the band.
        modes: (rows, rank) the first singular vectors, orthonormal, of the matrix that `field_operator` returns.
        to_modes: (rank, used) real matrix from exp(i phi) at the used nodes to amplitudes of the modes. It is
            scaled so that the squared field has the units of the image.
        to_coefficients: (functions squared, rank) matrix from amplitudes of the modes to coefficients of products of
            the functions; real with an aperture mask, else complex.
        basis: (points, functions) complex: prolate functions at the points, each times its phase, a power of i.
    """

    wavelength_nm: float
    weight: float
    modes: Array
    to_modes: Array
    to_coefficients: Array | Complex
    basis: Complex


@dataclass(frozen=True, eq=False)
class Twin:
    """A compressed sensor.

    Attributes:
        spec: Degree of compression.
        axis: Coordinates of the nodes along one axis, in pupil diameters; order / 2 nodes on each side are outside.
        used: Flat indices of the used nodes in the square grid of the axis (rows = y, columns = x).
        area_weights: (used,) weights of sum 1 for means over the open pupil, whose samples (transmission above 0.5)
            count equally.
        operators: One operator for each wavelength.
        to_pixels: (pixels, points) matrix from intensities at the points of an axis to pixels.
        operator_hash: Hexadecimal digest of all inputs of the build.
    """

    spec: TwinSpec
    axis: Array
    used: Integers
    area_weights: Array
    operators: tuple[Operator, ...]
    to_pixels: Array
    operator_hash: str


def node_radii(twin: Twin) -> tuple[Array, Array]:
    """Coordinates x, y (used,) of the used nodes in pupil radii, for Zernike polynomials and screens."""
    rows, columns = np.divmod(twin.used, twin.axis.size)
    return 2.0 * twin.axis[columns], 2.0 * twin.axis[rows]


def wavefront_rms_nm(twin: Twin, opd_nm: NDArray[np.floating]) -> float:
    """Rms of a wavefront (used,) over the open pupil, piston removed."""
    mean = float(twin.area_weights @ opd_nm)
    variance = float(twin.area_weights @ (opd_nm * opd_nm)) - mean**2
    return sqrt(max(variance, 0.0))  # guard nodes of the interpolation have weights below zero


def reference(twin: Twin, opd_nm: Array | None = None) -> Array:
    """I0 (pixels, pixels) in float64: the light on each pixel divided by the light entering the open circle.

    Args:
        twin: The twin.
        opd_nm: Reference wavefront (used,); flat when None.
    """
    images = [each.weight * np.abs(_field(each, _phasor(twin, each, opd_nm))) ** 2 for each in twin.operators]
    return np.asarray(twin.to_pixels @ np.sum(images, axis=0) @ twin.to_pixels.T)


def response(twin: Twin, basis: NDArray[np.floating], opd_nm: Array | None = None) -> Array:
    """H = dI/da (pixels squared, modes) in float64, per nm, as `lowfc.optics.chain.sensor.response`.

    For a reference wavefront of phase phi, the pupil fields are multiplied by exp(i phi).

    Args:
        twin: The twin.
        basis: Modes (modes, used) at the used nodes; of unit rms if the coefficients a are to be in nm rms.
        opd_nm: Reference wavefront (used,); flat when None.

    Raises:
        ValueError: The modes are not at the used nodes.
    """
    if basis.ndim != 2 or basis.shape[1] != twin.used.size:
        raise ValueError(f"modes must be (modes, {twin.used.size}) values at the used nodes, got {basis.shape}")
    H = np.zeros((twin.to_pixels.shape[0] ** 2, len(basis)))
    for operator in twin.operators:
        phasor = _phasor(twin, operator, opd_nm)
        E0 = _field(operator, phasor)
        for k, mode in enumerate(basis):
            slope = (
                operator.weight
                * (4.0 * np.pi / operator.wavelength_nm)
                * (E0 * np.conj(1j * _field(operator, phasor * mode))).real
            )
            H[:, k] += (twin.to_pixels @ slope @ twin.to_pixels.T).ravel()
    return H


def projected_response(twin: Twin, projections: Array, opd_nm: Array | None = None) -> Array:
    """Projections (projections, used) of the image's change per nm of wavefront at each node.

    They are `projections @ response(twin, eye)`, computed from the pixels back to the nodes: the cost depends on the
    number of projections, not on the number of nodes.

    Args:
        twin: The twin.
        projections: (projections, pixels squared) weights of the pixels, such as a reconstructor.
        opd_nm: Reference wavefront (used,); flat when None.
    """
    pixels = twin.to_pixels.shape[0]
    products = np.zeros((len(projections), twin.used.size))
    for operator in twin.operators:
        phasor = _phasor(twin, operator, opd_nm)
        scale = operator.weight * 4.0 * np.pi / operator.wavelength_nm
        slope = 1j * scale * np.conj(_field(operator, phasor))
        for k, projection in enumerate(projections):
            at_points = slope * (twin.to_pixels.T @ projection.reshape(pixels, pixels) @ twin.to_pixels)
            coefficients = (operator.basis.T @ at_points @ operator.basis).ravel()
            products[k] += ((coefficients @ operator.to_coefficients @ operator.to_modes) * phasor).real
    return products


def _phasor(twin: Twin, operator: Operator, opd_nm: Array | None) -> Array | Complex:
    """exp(i phi) (used,) of a wavefront in nm; all 1, and real, when None."""
    if opd_nm is None:
        return np.ones(twin.used.size)
    return np.asarray(np.exp((2j * np.pi / operator.wavelength_nm) * opd_nm))


def _field(operator: Operator, nodes: Array | Complex) -> Complex:
    """Field (points, points) for values (used,) at the nodes."""
    functions = operator.basis.shape[1]
    coefficients = (operator.to_coefficients @ (operator.to_modes @ nodes)).reshape(functions, functions)
    return np.asarray(operator.basis @ coefficients @ operator.basis.T)


class Evaluator:
    """Computes images with a twin in float32; rounding leaves values down to about -1e-7 of the brightest pixel."""

    def __init__(self, twin: Twin) -> None:
        self._used = twin.used.size
        self._stages = [_Stage(operator) for operator in twin.operators]
        self._to_pixels = twin.to_pixels.astype(np.float32)
        self._to_pixels_transposed = np.ascontiguousarray(self._to_pixels.T)

    def image(self, opds_nm: Single, weights: Single | None = None) -> Single:
        """Image (pixels, pixels) for wavefronts in nm, as fractions of the open circle's light.

        Args:
            opds_nm: One wavefront (used,), or several (wavefronts, used), whose images are added.
            weights: (wavefronts,) weight of each image, at least 0; all 1 when None.

        Raises:
            ValueError: A wavefront does not have one value per used node.
        """
        if opds_nm.shape[-1:] != (self._used,):
            raise ValueError(f"a wavefront must have one value for each of {self._used} nodes, got {opds_nm.shape}")
        several = np.atleast_2d(opds_nm)
        weights = np.ones(len(several), np.float32) if weights is None else weights
        intensity = self._stages[0].intensity(several, weights)
        for stage in self._stages[1:]:
            intensity += stage.intensity(several, weights)
        return np.asarray(self._to_pixels @ intensity @ self._to_pixels_transposed)


class _Stage:
    """One wavelength's matrices in single precision."""

    def __init__(self, operator: Operator) -> None:
        self._wavenumber = np.float32(2.0 * np.pi / operator.wavelength_nm)
        to_modes = np.sqrt(operator.weight) * operator.to_modes
        self._to_modes = to_modes.astype(np.float32)
        self._flat_modes = to_modes.sum(axis=1).astype(np.float32)[:, None]
        # A real matrix multiplies columns of real and of imaginary parts; a complex one, columns of complex numbers.
        self._unit = np.dtype(np.complex64 if np.iscomplexobj(operator.to_coefficients) else np.float32)
        self._to_coefficients = np.ascontiguousarray(operator.to_coefficients, self._unit)
        basis, phases = _real_basis(operator.basis)
        self._factors = np.outer(phases, phases).reshape(-1, 1).astype(np.complex64)
        self._basis = basis.astype(np.float32)
        self._basis_transposed = np.ascontiguousarray(self._basis.T)

    def intensity(self, opds_nm: Single, weights: Single) -> Single:
        """The weighted sum of `|E|^2` (points, points) for wavefronts (wavefronts, used)."""
        phase = self._wavenumber * opds_nm
        # The flat wavefront's field is added later, computed in float64, for smaller rounding errors in the sums.
        phasor = np.empty((*phase.T.shape, 2), np.float32)
        np.subtract(np.cos(phase).T, np.float32(1), out=phasor[..., 0])
        phasor[..., 1] = np.sin(phase).T
        modes = self._to_modes @ phasor.reshape(len(phasor), -1)
        modes[:, ::2] += self._flat_modes
        coefficients = (self._to_coefficients @ modes.view(self._unit)).view(np.complex64)
        coefficients *= self._factors
        # The functions are real: multiply real and imaginary parts side by side.
        functions, points = self._basis_transposed.shape
        parts = np.ascontiguousarray(coefficients.view(np.float32).T)
        half = parts.reshape(-1, functions) @ self._basis_transposed
        field = self._basis @ half.reshape(-1, functions, points)
        field *= field
        return np.asarray(weights.repeat(2) @ field.reshape(len(field), -1)).reshape(points, points)


def _real_basis(basis: Complex) -> tuple[Array, Complex]:
    """Split a basis (points, functions) into real functions and their phases (functions,), powers of i."""
    largest = basis[np.abs(basis).argmax(axis=0), np.arange(basis.shape[1])]
    phases = np.where(np.abs(largest.imag) > np.abs(largest.real), 1j, 1.0 + 0j)
    return np.asarray((basis / phases).real), phases
