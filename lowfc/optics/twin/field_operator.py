"""The optics at one wavelength as a real matrix, from products of functions on the pupil to where modes are chosen.

The focal-plane mask is symmetric about both axes, so that focal samples may be paired into cosines and sines. With an
aperture mask in the relay pupil, the operator from pupil to relay pupil is then real; on the sensor the prolate
functions of either parity turn the last kernel into a real matrix times 1 (even) or -i (odd), so that the whole
operator is a real matrix with known phases. Without one, the relay loses nothing and is a product of two axes: the real
operator ends at the focal plane, and what is left of the way is applied to the few modes that are kept.
"""

from collections.abc import Callable, Iterator

import numpy as np

from lowfc.arrays import Array, Complex, Whole
from lowfc.optics.chain.grid import OPEN_AREA, image_axis, pupil_axis
from lowfc.optics.chain.relay import ApertureMask, direct_kernel, half_band
from lowfc.optics.chain.sensor import Sensor

Matrix = Array | Complex

_WIDEST = 0.49  # cycles per sample: the samples hold no more than half


def prolates(samples: int, half_band: float, count: int) -> Array:
    """Discrete prolate sequences (samples, count), even and odd in turn, orthonormal.

    Args:
        samples: Of the axis.
        half_band: Half of the band, in cycles per sample.
        count: How many, the best concentrated first.
    """
    import scipy.linalg  # takes its time, and most processes load what was built

    index = np.arange(samples)
    diagonal = ((samples - 1) / 2.0 - index) ** 2 * np.cos(2.0 * np.pi * half_band)
    off_diagonal = index[1:] * (samples - index[1:]) / 2.0
    if count > samples:
        raise ValueError(f"{count} prolate functions were asked for, the sensor has {samples} samples")
    _, vectors = scipy.linalg.eigh_tridiagonal(
        diagonal, off_diagonal, select="i", select_range=(samples - count, samples - 1)
    )
    signs = np.sign(vectors[samples // 2])  # LAPACK leaves the sign open; the same functions must come from each
    return np.ascontiguousarray((vectors * signs)[:, ::-1])


def sensor_functions(sensor: Sensor, scale: float, guards: int) -> Array:
    """Prolate functions (sensor samples, functions) that hold the field at a wavelength.

    Args:
        sensor: The optics.
        scale: lambda0 / lambda.
        guards: Functions beyond the number that the field's band and the sensor's width call for.
    """
    band = _half_band(sensor, scale)
    return prolates(sensor.samples, band, min(int(np.ceil(2.0 * band * sensor.samples)) + guards, sensor.samples))


def intensity_functions(sensor: Sensor, scale: float, guards: int) -> Array:
    """Prolate functions (sensor samples, functions) that hold the intensity, whose band is twice the field's."""
    band = min(2.0 * _half_band(sensor, scale), _WIDEST)
    count = 2 * (int(np.ceil(band * sensor.samples)) + guards)
    return prolates(sensor.samples, band, min(count, sensor.samples))


def phases(sensor: Sensor, count: int) -> Complex:
    """Factor of each of the functions on the sensor: an aperture mask multiplies the odd ones by -i."""
    odd = -1j if isinstance(sensor.relay, ApertureMask) else 1.0
    return np.resize(np.array([1.0, odd], dtype=np.complex128), count)


def field_operator(
    sensor: Sensor,
    scale: float,
    functions: Array,
    y_factors: Array,
    x_factors: Array,
    wanted: Whole,
    advance: Callable[[], None] = lambda: None,
) -> Array:
    """Real matrix (rows, wanted) from amplitudes of separable functions in the pupil.

    Its rows are coefficients of the functions on the sensor where there is an aperture mask, and samples of the focal
    plane within its mask, in cosines and sines, where there is none; `on_sensor` takes either to the sensor.

    Args:
        sensor: The optics.
        scale: lambda0 / lambda.
        functions: (sensor samples, functions) from `sensor_functions`.
        y_factors: (n, p) the functions' factors along y at the pupil's samples.
        x_factors: (n, q) along x.
        wanted: Indices of the wanted products in the flattened (p, q).
        advance: Called after each of the k / 2 steps, k the samples across the focal-plane mask.
    """
    samples = sensor.pupil.shape[0]
    unit = scale * sensor.pitch / (samples**2 * np.sqrt(OPEN_AREA))
    waves = _waves(sensor, scale)
    rows = _focal_rows(sensor, waves, y_factors, x_factors, wanted, advance)
    if not isinstance(sensor.relay, ApertureMask):
        return np.asarray(unit * np.vstack([amplitudes for *_, amplitudes in rows]))
    half, count = waves.shape[1], functions.shape[1]
    quarter = sensor.focal_mask[half:, half:].real
    kernels = _kernels(sensor, scale, functions)
    relayed = (kernels[:, None, None] * waves).transpose(3, 1, 2, 0).reshape(samples, -1)  # columns (parity, d, k)
    total = np.zeros((count**2, wanted.size))
    for parity, c, columns, amplitudes in rows:
        left = ((kernels * waves[parity, c]) @ sensor.relay.transmission @ relayed).reshape(count, 2, half, count)
        outer = left[:, :, columns].transpose(0, 3, 1, 2) * quarter[c, columns]
        total += outer.reshape(count**2, -1) @ amplitudes
    return np.asarray(unit * total)


def _focal_rows(
    sensor: Sensor,
    waves: Array,
    y_factors: Array,
    x_factors: Array,
    wanted: Whole,
    advance: Callable[[], None],
) -> Iterator[tuple[int, int, Whole, Array]]:
    """Amplitudes on the focal plane row by row, from amplitudes in the pupil; arguments as for `field_operator`.

    Yields:
        Parity and index of the row, the columns within the mask, and the amplitudes (2 columns, wanted) there, of
        either parity along x.
    """
    samples, half = sensor.pupil.shape[0], waves.shape[1]
    entering = (x_factors.T[:, None, None] * waves).transpose(3, 1, 2, 0).reshape(samples, -1)
    p, q = y_factors.shape[1], x_factors.shape[1]
    for c in range(half):
        columns = np.flatnonzero(sensor.focal_mask[half + c, half:])
        for parity in (0, 1):
            right = ((y_factors.T * waves[parity, c]) @ sensor.pupil @ entering).reshape(p, 2, half, q)
            amplitudes = right[:, :, columns].transpose(1, 2, 0, 3).reshape(2 * columns.size, p * q)[:, wanted]
            yield parity, c, columns, amplitudes
        advance()


def on_sensor(sensor: Sensor, scale: float, functions: Array, modes: Array) -> Matrix:
    """Coefficients (functions squared, modes) on the sensor of modes (rows, modes), rows as `field_operator` has them.

    The field at the sensor is F Y F', F the functions times `phases` and Y these coefficients, in the units of an
    image's square root.
    """
    if isinstance(sensor.relay, ApertureMask):
        return modes
    half = sensor.focal_mask.shape[0] // 2
    quarter = sensor.focal_mask[half:, half:]
    matrix = direct_kernel(sensor.relay, sensor.samples, 2 * half, sensor.samples_per, scale)
    both = functions.T @ matrix
    right, left = both[:, half:], both[:, :half][:, ::-1]
    pairs = np.stack([right + left, -1j * (right - left)]) / np.sqrt(2.0)  # (parity, functions, half)
    coefficients = np.zeros((functions.shape[1] ** 2, modes.shape[1]), np.complex128)
    row = 0
    for c in range(half):
        columns = np.flatnonzero(quarter[c])
        for parity in (0, 1):
            few = modes[row : row + 2 * columns.size].reshape(2, columns.size, -1) * quarter[c, columns, None]
            along_x = np.einsum("pfd,pdm->fm", pairs[:, :, columns], few)
            coefficients += (pairs[parity, :, c, None, None] * along_x).reshape(len(coefficients), -1)
            row += 2 * columns.size
    return coefficients


def _waves(sensor: Sensor, scale: float) -> Array:
    """Cosines and sines (parity, k / 2, n) of the focal samples on the positive half axis.

    The root of 2 makes each stand for the pair of samples that it replaces.
    """
    half = sensor.focal_mask.shape[0] // 2
    x = image_axis(2 * half, sensor.samples_per)[half:]
    angles = 2.0 * np.pi * scale * np.outer(x, pupil_axis(sensor.pupil.shape[0]))
    return np.asarray(np.sqrt(2.0) * np.stack([np.cos(angles), np.sin(angles)]))


def _kernels(sensor: Sensor, scale: float, functions: Array) -> Array:
    """From the relay pupil to the functions on the sensor (functions, n), with half of both transforms' factors."""
    samples = sensor.pupil.shape[0]
    angles = 2.0 * np.pi * scale * np.outer(image_axis(sensor.samples, sensor.samples_per), pupil_axis(samples))
    kernels = functions.T @ np.cos(angles)
    kernels[1::2] = (functions.T @ np.sin(angles))[1::2]
    return np.asarray(kernels * (scale / (samples * sensor.samples_per)))


def _half_band(sensor: Sensor, scale: float) -> float:
    """Half of the band of the field, in cycles per sample of the sensor."""
    radius = sensor.focal_mask.shape[0] / (2.0 * sensor.samples_per)
    band = half_band(sensor.relay, sensor.samples * sensor.pitch, radius, scale)
    return min(band * sensor.pitch, _WIDEST)
