"""The optics at one wavelength as a real matrix, from separable functions in the pupil to sensor or focal plane.

The focal-plane mask is symmetric about both axes, so that pairs of focal samples become cosines and sines. With an
aperture mask in the relay pupil, the operator from pupil to relay pupil is then real. On the sensor, prolate functions
of even or odd parity turn the last kernel into a real matrix times 1 (even) or -i (odd). The whole operator is then a
real matrix times these phases. Without an aperture mask, the relay is lossless and separable: the real operator ends
at the focal plane, and the rest of the path is applied only to the retained modes.
"""

from collections.abc import Callable, Iterator

import numpy as np

from lowfc.arrays import Array, Complex, Integers
from lowfc.optics.chain.grid import OPEN_AREA, image_axis, pupil_axis
from lowfc.optics.chain.relay import ApertureMask, direct_kernel, half_band
from lowfc.optics.chain.sensor import Sensor

Matrix = Array | Complex

_WIDEST = 0.49  # largest half bandwidth, cycles per sample; the Nyquist frequency is 0.5


def prolates(samples: int, half_band: float, count: int) -> Array:
    """Discrete prolate sequences (samples, count), even and odd in turn, orthonormal; ValueError if count > samples.

    Args:
        samples: Samples of the axis.
        half_band: Half of the bandwidth, in cycles per sample.
        count: Number of functions, the best concentrated first.
    """
    import scipy.linalg  # slow to import, and most processes load a stored result

    index = np.arange(samples)
    diagonal = ((samples - 1) / 2.0 - index) ** 2 * np.cos(2.0 * np.pi * half_band)
    off_diagonal = index[1:] * (samples - index[1:]) / 2.0
    if count > samples:
        raise ValueError(f"{count} prolate functions need as many sensor samples, got {samples}")
    _, vectors = scipy.linalg.eigh_tridiagonal(
        diagonal, off_diagonal, select="i", select_range=(samples - count, samples - 1)
    )
    signs = np.sign(vectors[samples // 2])  # LAPACK does not define the sign; fix it for reproducible functions
    return np.ascontiguousarray((vectors * signs)[:, ::-1])


def sensor_functions(sensor: Sensor, scale: float, guards: int) -> Array:
    """Prolate functions (sensor samples, functions) that represent the field at a wavelength.

    Args:
        sensor: The optics.
        scale: lambda0 / lambda.
        guards: Number of functions beyond the product of the bandwidth and the width of the sensor.
    """
    band = _half_band(sensor, scale)
    return prolates(sensor.samples, band, min(int(np.ceil(2.0 * band * sensor.samples)) + guards, sensor.samples))


def intensity_functions(sensor: Sensor, scale: float, guards: int) -> Array:
    """Prolate functions (sensor samples, functions) that represent the intensity, whose band is twice the field's."""
    band = min(2.0 * _half_band(sensor, scale), _WIDEST)
    count = 2 * (int(np.ceil(band * sensor.samples)) + guards)
    return prolates(sensor.samples, band, min(count, sensor.samples))


def phases(sensor: Sensor, count: int) -> Complex:
    """Phase factor of each function on the sensor: -i for odd functions behind an aperture mask, otherwise 1."""
    odd = -1j if isinstance(sensor.relay, ApertureMask) else 1.0
    return np.resize(np.array([1.0, odd], dtype=np.complex128), count)


def field_operator(
    sensor: Sensor,
    scale: float,
    functions: Array,
    y_factors: Array,
    x_factors: Array,
    products: Integers,
    advance: Callable[[], None] = lambda: None,
) -> Array:
    """Real matrix (rows, products) from amplitudes of separable functions in the pupil.

    With an aperture mask, the rows are coefficients of the functions on the sensor. Without one, they are the cosine
    and sine amplitudes in the focal plane, within its mask. `on_sensor` turns either into coefficients on the sensor.

    Args:
        sensor: The optics.
        scale: lambda0 / lambda.
        functions: (sensor samples, functions) from `sensor_functions`.
        y_factors: (n, p) factors of the functions along y at the pupil's samples.
        x_factors: (n, q) factors of the functions along x.
        products: Flat indices into (p, q) of the products to compute.
        advance: Called after each of k / 2 steps, where k is the number of samples across the focal-plane mask.
    """
    samples = sensor.pupil.shape[0]
    unit = scale * sensor.pitch / (samples**2 * np.sqrt(OPEN_AREA))
    waves = _waves(sensor, scale)
    rows = _focal_rows(sensor, waves, y_factors, x_factors, products, advance)
    if not isinstance(sensor.relay, ApertureMask):
        return np.asarray(unit * np.vstack([amplitudes for *_, amplitudes in rows]))
    half, count = waves.shape[1], functions.shape[1]
    quarter = sensor.focal_mask[half:, half:].real
    kernels = _kernels(sensor, scale, functions)
    # Columns (parity, focal column, function).
    relayed = (kernels[:, None, None] * waves).transpose(3, 1, 2, 0).reshape(samples, -1)
    total = np.zeros((count**2, products.size))
    for parity, c, columns, amplitudes in rows:
        left = ((kernels * waves[parity, c]) @ sensor.relay.transmission @ relayed).reshape(count, 2, half, count)
        outer = left[:, :, columns].transpose(0, 3, 1, 2) * quarter[c, columns]
        total += outer.reshape(count**2, -1) @ amplitudes
    return np.asarray(unit * total)


def _focal_rows(
    sensor: Sensor, waves: Array, y_factors: Array, x_factors: Array, products: Integers, advance: Callable[[], None]
) -> Iterator[tuple[int, int, Integers, Array]]:
    """Focal-plane amplitudes row by row, for amplitudes in the pupil; arguments as for `field_operator`.

    Yields:
        Parity and index of the row, the columns within the mask, and the amplitudes (2 columns, products) there: first
        those even along x, then the odd ones.
    """
    samples, half = sensor.pupil.shape[0], waves.shape[1]
    entering = (x_factors.T[:, None, None] * waves).transpose(3, 1, 2, 0).reshape(samples, -1)
    p, q = y_factors.shape[1], x_factors.shape[1]
    for c in range(half):
        columns = np.flatnonzero(sensor.focal_mask[half + c, half:])
        for parity in (0, 1):
            right = ((y_factors.T * waves[parity, c]) @ sensor.pupil @ entering).reshape(p, 2, half, q)
            amplitudes = right[:, :, columns].transpose(1, 2, 0, 3).reshape(2 * columns.size, p * q)[:, products]
            yield parity, c, columns, amplitudes
        advance()


def on_sensor(sensor: Sensor, scale: float, functions: Array, modes: Array) -> Matrix:
    """Coefficients (functions squared, modes) on the sensor for modes (rows, modes); rows as in `field_operator`.

    The field at the sensor is F Y F', where F is the functions times `phases` and Y these coefficients. Its squared
    amplitude is in the units of an image.
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
            reflected = (
                modes[row : row + 2 * columns.size].reshape(2, columns.size, modes.shape[1]) * quarter[c, columns, None]
            )
            along_x = np.einsum("pfd,pdm->fm", pairs[:, :, columns], reflected)
            coefficients += (pairs[parity, :, c, None, None] * along_x).reshape(len(coefficients), -1)
            row += 2 * columns.size
    return coefficients


def _waves(sensor: Sensor, scale: float) -> Array:
    """Cosines and sines (parity, k / 2, n) of the focal samples on the positive half axis.

    Each is scaled by sqrt(2), as it stands for a pair of samples.
    """
    half = sensor.focal_mask.shape[0] // 2
    x = image_axis(2 * half, sensor.samples_per)[half:]
    angles = 2.0 * np.pi * scale * np.outer(x, pupil_axis(sensor.pupil.shape[0]))
    return np.asarray(np.sqrt(2.0) * np.stack([np.cos(angles), np.sin(angles)]))


def _kernels(sensor: Sensor, scale: float, functions: Array) -> Array:
    """Kernel (functions, n) from the relay pupil to the functions on the sensor, scaled for one axis."""
    samples = sensor.pupil.shape[0]
    angles = 2.0 * np.pi * scale * np.outer(image_axis(sensor.samples, sensor.samples_per), pupil_axis(samples))
    kernels = functions.T @ np.cos(angles)
    kernels[1::2] = (functions.T @ np.sin(angles))[1::2]
    return np.asarray(kernels * (scale / (samples * sensor.samples_per)))


def _half_band(sensor: Sensor, scale: float) -> float:
    """Half of the bandwidth of the field, in cycles per sample of the sensor."""
    radius = sensor.focal_mask.shape[0] / (2.0 * sensor.samples_per)
    band = half_band(sensor.relay, sensor.samples * sensor.pitch, radius, scale)
    return min(band * sensor.pitch, _WIDEST)
