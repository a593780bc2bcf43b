"""The optics at one wavelength as a real matrix, from products of functions on the pupil to coefficients on the sensor.

The focal-plane mask is symmetric about both axes, so that focal samples may be paired into cosines and sines and the
operator from pupil to relay pupil is real. On the sensor the prolate functions of either parity turn the last kernel
into a real matrix times 1 (even) or -i (odd), so that the whole operator is a real matrix with known phases.
"""

from collections.abc import Callable

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from lowfc.optics.grid import OPEN_AREA, image_axis, pupil_axis
from lowfc.optics.sensor import Sensor

Float = NDArray[np.float64]


def prolates(sensor: Sensor, half_band: float, count: int) -> Float:
    """Discrete prolate sequences (samples, count) on the sensor's axis, even and odd in turn, orthonormal.

    Args:
        sensor: The optics.
        half_band: Half of the band, in cycles per lambda0 / D.
        count: How many, the best concentrated first.
    """
    samples = sensor.pixels * sensor.binning
    index = np.arange(samples)
    diagonal = ((samples - 1) / 2.0 - index) ** 2 * np.cos(2.0 * np.pi * half_band / sensor.samples_per)
    off_diagonal = index[1:] * (samples - index[1:]) / 2.0
    if count > samples:
        raise ValueError(f"{count} prolate functions were asked for, the sensor has {samples} samples")
    _, vectors = scipy.linalg.eigh_tridiagonal(
        diagonal, off_diagonal, select="i", select_range=(samples - count, samples - 1)
    )
    signs = np.sign(vectors[samples // 2])  # LAPACK leaves the sign open; the same functions must come from each
    return np.ascontiguousarray((vectors * signs)[:, ::-1])


def field_operator(
    sensor: Sensor,
    scale: float,
    functions: Float,
    y_factors: Float,
    x_factors: Float,
    wanted: NDArray[np.intp],
    advance: Callable[[], None] = lambda: None,
) -> Float:
    """Real matrix (functions squared, wanted) from amplitudes of separable functions in the pupil to the sensor.

    A sum over rows of the focal plane. Each row c is a cosine or a sine along y, each column d one along x; with the
    relay mask M and the pupil A the contribution is (to_sensor_c M to_sensor_d') mask[c, d] (to_focal_c A to_focal_d').

    Args:
        sensor: The optics.
        scale: lambda0 / lambda.
        functions: (sensor samples, functions) from `prolates`.
        y_factors: (n, p) the functions' factors along y at the pupil's samples.
        x_factors: (n, q) along x.
        wanted: Indices of the wanted products in the flattened (p, q).
        advance: Called after each of the k / 2 steps, k the samples across the focal-plane mask.

    Returns:
        The field at the sensor is F Y F', F the functions with the odd ones times -i and Y this matrix times the
        amplitudes, in the units of an image's square root.
    """
    samples = sensor.pupil.shape[0]
    u = pupil_axis(samples)
    half = sensor.focal_mask.shape[0] // 2
    quarter = sensor.focal_mask[half:, half:]
    # Both parities of every sample on the positive half axis; 2 stands for the pair of samples that each replaces.
    angles = 2.0 * np.pi * scale * np.outer(image_axis(2 * half, sensor.samples_per)[half:], u)
    waves = np.sqrt(2.0) * np.stack([np.cos(angles), np.sin(angles)])  # (parity, half, samples)
    count = functions.shape[1]
    sensor_angles = 2.0 * np.pi * scale * np.outer(image_axis(len(functions), sensor.samples_per), u)
    kernels = functions.T @ np.cos(sensor_angles)
    kernels[1::2] = (functions.T @ np.sin(sensor_angles))[1::2]
    relayed = (kernels[:, None, None] * waves).transpose(3, 1, 2, 0).reshape(samples, -1)  # columns (parity, d, k)
    entering = (x_factors.T[:, None, None] * waves).transpose(3, 1, 2, 0).reshape(samples, -1)
    total = np.zeros((count**2, wanted.size))
    p, q = y_factors.shape[1], x_factors.shape[1]
    for c in range(half):
        columns = np.flatnonzero(quarter[c])
        for wave in waves[:, c]:
            left = ((kernels * wave) @ sensor.relay_mask @ relayed).reshape(count, 2, half, count)
            right = ((y_factors.T * wave) @ sensor.pupil @ entering).reshape(p, 2, half, q)
            outer = left[:, :, columns].transpose(0, 3, 1, 2) * quarter[c, columns]
            inner = right[:, :, columns].transpose(1, 2, 0, 3).reshape(2 * columns.size, p * q)[:, wanted]
            total += outer.reshape(count**2, -1) @ inner
        advance()
    unit = scale**3 / (samples**4 * sensor.samples_per**3 * np.sqrt(OPEN_AREA))
    return np.asarray(total * unit)
