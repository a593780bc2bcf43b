"""The digital twin: the optics compressed to a few small matrices, and their evaluation.

At each wavelength the field at the sensor is linear in exp(i phi) at the pupil nodes, and both ends are band-limited:

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
    """Degree of compression; the default is accurate to 1e-4 of the image for every named sensor.

    For other combinations of pupil, focal-plane mask and relay, errors of up to 2e-3 were found.

    Attributes:
        nodes: Pupil nodes across the diameter.
        order: Points of the interpolation from the nodes, even.
        rank: Retained modes of the operator for a focal-plane mask with the area of a disk of radius 4 lambda0 / D and
            an aperture mask. `build` increases it for a larger mask, for a bright pupil, and without an aperture mask.
        guards: Prolate functions along each axis in addition to the field's bandwidth times the sensor's width.
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
        modes: (rows, rank) orthonormal modes, in the rows of `field_operator`.
        to_modes: (rank, used) real matrix from exp(i phi) at the used nodes to amplitudes of the modes. It includes the
            units of the image.
        to_coefficients: (functions squared, rank) matrix to coefficients; real with an aperture mask, else complex.
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
        axis: Coordinates of the nodes along one axis, with guards, in pupil diameters.
        used: Flat indices of the used nodes in the square grid of the axis (rows = y, columns = x).
        area_weights: (used,) weights of sum 1 for means over the open pupil: its samples (transmission above 0.5) count
            equally.
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
    """Projections (projections, used) of the image's slope per nm of wavefront at each node.

    They are `projections @ response(twin, eye)`, computed from the pixels back to the nodes: the cost depends on the
    number of projections, not on that of nodes.

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
    """Computes images with a twin in float32; each thread needs its own, as its buffers are overwritten.

    Rounding leaves values down to about -1e-7 of the brightest pixel in dark pixels.
    """

    def __init__(self, twin: Twin) -> None:
        self._used = twin.used.size
        self._stages = [_Stage(operator) for operator in twin.operators]
        pixels, points = twin.to_pixels.shape
        self._to_pixels = twin.to_pixels.astype(np.float32)
        self._to_pixels_transposed = np.ascontiguousarray(self._to_pixels.T)
        self._phase = np.empty(self._used, np.float32)
        self._phasor = np.empty((self._used, 2), np.float32)
        self._intensity = np.empty((points, points), np.float32)
        self._half = np.empty((pixels, points), np.float32)
        self._image = np.empty((pixels, pixels), np.float32)

    def image(self, opd_nm: Single) -> Single:
        """Image (pixels, pixels) for a wavefront (used,) in nm, as fractions of the open circle's light.

        The array is overwritten by the next call.

        Raises:
            ValueError: The wavefront does not have one value per used node.
        """
        if opd_nm.shape != (self._used,):
            raise ValueError(f"a wavefront must have one value for each of {self._used} nodes, got {opd_nm.shape}")
        self._intensity.fill(0.0)
        for stage in self._stages:
            np.multiply(opd_nm, stage.wavenumber, out=self._phase)
            # The flat wavefront's field is added later, computed in float64: smaller rounding errors in the sums.
            np.cos(self._phase, out=self._phasor[:, 0])
            np.subtract(self._phasor[:, 0], 1.0, out=self._phasor[:, 0])
            np.sin(self._phase, out=self._phasor[:, 1])
            stage.add_intensity(self._phasor, self._intensity)
        np.matmul(self._to_pixels, self._intensity, out=self._half)
        return np.matmul(self._half, self._to_pixels_transposed, out=self._image)


class _Stage:
    """One wavelength's matrices and buffers in single precision."""

    def __init__(self, operator: Operator) -> None:
        points, functions = operator.basis.shape
        self.wavenumber = np.float32(2.0 * np.pi / operator.wavelength_nm)
        to_modes = np.sqrt(operator.weight) * operator.to_modes
        self._to_modes = to_modes.astype(np.float32)
        self._flat_modes = to_modes.sum(axis=1).astype(np.float32)
        # A real matrix multiplies the columns of real and imaginary parts, a complex one the complex numbers.
        self._unit = np.dtype(np.complex64 if np.iscomplexobj(operator.to_coefficients) else np.float32)
        self._to_coefficients = np.ascontiguousarray(operator.to_coefficients, self._unit)
        self._modes = np.empty((len(self._to_modes), 2), np.float32)
        self._pairs = np.empty((functions**2, 2), np.float32)
        basis, phases = _real_basis(operator.basis)
        factors = np.outer(phases, phases).ravel()
        # Multiplication by a power of i swaps the parts of a coefficient, changes their signs, or both.
        places = np.arange(2 * functions**2).reshape(-1, 2)
        self._places = np.where(np.abs(factors.imag) > 0.5, places.T[::-1], places.T)
        signs = np.where(np.abs(factors.imag) > 0.5, (-factors.imag, factors.imag), factors.real)
        self._signs = signs.astype(np.float32)
        self._coefficients = np.empty(self._signs.shape, np.float32)
        self._basis = basis.astype(np.float32)
        self._basis_transposed = np.ascontiguousarray(self._basis.T)
        self._half = np.empty((2 * functions, points), np.float32)
        self._field = np.empty((2, points, points), np.float32)

    def add_intensity(self, phasor: Single, intensity: Single) -> None:
        """Add `|E|^2` at the points, for real and imaginary parts (used, 2) of exp(i phi) - 1."""
        np.matmul(self._to_modes, phasor, out=self._modes)
        self._modes[:, 0] += self._flat_modes
        np.matmul(self._to_coefficients, self._modes.view(self._unit), out=self._pairs.view(self._unit))
        np.take(self._pairs, self._places, out=self._coefficients, mode="clip")
        self._coefficients *= self._signs
        # The functions are real: multiply real and imaginary parts side by side.
        functions, points = self._basis_transposed.shape
        np.matmul(self._coefficients.reshape(-1, functions), self._basis_transposed, out=self._half)
        np.matmul(self._basis, self._half.reshape(2, functions, points), out=self._field)
        np.multiply(self._field, self._field, out=self._field)
        for part in self._field:
            np.add(intensity, part, out=intensity)


def _real_basis(basis: Complex) -> tuple[Array, Complex]:
    """Split a basis (points, functions) into real functions and their phases (functions,), powers of i."""
    largest = basis[np.abs(basis).argmax(axis=0), np.arange(basis.shape[1])]
    phases = np.where(np.abs(largest.imag) > np.abs(largest.real), 1j, 1.0 + 0j)
    return np.asarray((basis / phases).real), phases
