"""Compression of a sensor's optics to a twin, in float64."""

import itertools
from collections.abc import Callable

import numpy as np

from lowfc.arrays import Array, Integers, Mask
from lowfc.optics.chain.band import Band, monochromatic
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.chain.sensor import Sensor
from lowfc.optics.twin.field_operator import field_operator, intensity_functions, on_sensor, phases, sensor_functions
from lowfc.optics.twin.nodes import interpolation, node_axis
from lowfc.optics.twin.twin import Operator, Twin, TwinSpec

_DISK_AREA = np.pi * 4.0**2  # area of the focal-plane mask to which `TwinSpec.rank` refers, (lambda0 / D)^2


def build(
    sensor: Sensor,
    spec: TwinSpec,
    band: Band | None = None,
    operator_hash: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> Twin:
    """Compress a sensor.

    Args:
        sensor: The optics; the focal-plane mask must be symmetric about both axes.
        spec: Degree of compression.
        band: The passband; the central wavelength alone when None.
        operator_hash: Digest of sensor, spec and band, see `lowfc.adapters.files.twin_cache`.
        progress: Called with the number of steps done and the total.

    Raises:
        ValueError: The focal-plane mask is not symmetric, or complex with an aperture mask; or `spec` has an
            odd order, a rank below 1, or a rank or number of functions that the optics do not have.
    """
    mask = sensor.focal_mask
    if mask.shape[0] % 2 or not (np.array_equal(mask, mask[::-1]) and np.array_equal(mask, mask[:, ::-1])):
        raise ValueError("the twin needs a focal-plane mask of an even number of samples, symmetric about both axes")
    if isinstance(sensor.relay, ApertureMask) and np.iscomplexobj(mask):
        raise ValueError("the twin of an aperture mask needs a real focal-plane mask, got a complex one")
    band = monochromatic(sensor.wavelength_nm) if band is None else band
    scales = [sensor.wavelength_nm / wavelength_nm for wavelength_nm in band.wavelengths_nm]
    axis = node_axis(spec.nodes, spec.order)
    to_samples = interpolation(sensor.pupil.shape[0], spec.nodes, spec.order)
    used = np.flatnonzero(_adjoint(np.abs(to_samples), sensor.pupil != 0))
    area_weights = _adjoint(to_samples, sensor.pupil > 0.5).ravel()[used]
    points, to_pixels = _intensity_sampling(sensor, spec, max(scales))
    area = np.count_nonzero(mask) / sensor.samples_per**2
    # Two thirds of the singular modes are degrees of freedom of the light, proportional to the mask's area; a third is
    # for the mask's edge. An aperture mask blurs the contribution of the faintest ones; without one, a third more are
    # needed. A pupil that is bright up to its edge excites the faintest ones and needs a tenth more.
    needed = spec.rank if isinstance(sensor.relay, ApertureMask) else 4 * spec.rank / 3
    if sensor.pupil.mean() > 0.5:
        needed *= 1.1
    rank = round(needed * (2.0 * float(area / _DISK_AREA) + 1.0) / 3.0)
    steps = len(scales) * mask.shape[0] // 2
    done = itertools.count(1)

    def advance() -> None:
        if progress is not None:
            progress(next(done), steps)

    operators = []
    for scale, weight in zip(scales, band.weights, strict=True):
        functions = sensor_functions(sensor, scale, spec.guards)
        rows = functions.shape[1] ** 2 if isinstance(sensor.relay, ApertureMask) else np.count_nonzero(mask)
        if not 0 < rank <= min(rows, used.size):
            raise ValueError(f"the rank must lie between 1 and {min(rows, used.size)}, got {rank}")
        matrix = field_operator(sensor, scale, functions, to_samples, to_samples, used, advance)
        modes = _leading_modes(matrix, rank)
        operators.append(
            Operator(
                wavelength_nm=sensor.wavelength_nm / scale,
                weight=weight,
                modes=modes,
                to_modes=modes.T @ matrix,
                to_coefficients=on_sensor(sensor, scale, functions, modes),
                basis=functions[points] * phases(sensor, functions.shape[1]),
            )
        )
    return Twin(spec, axis, used, area_weights / area_weights.sum(), tuple(operators), to_pixels, operator_hash)


def _adjoint(to_samples: Array, weights: Mask) -> Array:
    """Weights of the nodes for which their weighted sum is that of the values interpolated at the pupil's samples."""
    return np.asarray(to_samples.T @ weights.astype(np.float64) @ to_samples)


def _intensity_sampling(sensor: Sensor, spec: TwinSpec, scale: float) -> tuple[Integers, Array]:
    """Choose the sensor samples at which intensities are evaluated, and compute the matrix from them to pixels.

    Intensities have twice the field's bandwidth; a pivoted QR of that band's prolate functions selects the samples.
    """
    import scipy.linalg  # slow to import, and most processes load a stored result

    functions = intensity_functions(sensor, scale, spec.guards)
    _, _, pivots = scipy.linalg.qr(functions.T, mode="economic", pivoting=True)
    points = np.sort(pivots[: functions.shape[1]]).astype(np.intp)
    pixels = functions.reshape(sensor.pixels, sensor.binning, -1).sum(axis=1)
    return points, np.ascontiguousarray(np.linalg.solve(functions[points].T, pixels.T).T)


def _leading_modes(matrix: Array, rank: int) -> Array:
    """Left singular vectors (rows, rank) of the largest singular values.

    They are computed from eigenvectors of the smaller of M M' and M' M, which loses precision only below 1e-8 of the
    largest value.
    """
    import scipy.linalg

    size = min(matrix.shape)
    subset = (size - rank, size - 1)
    if len(matrix) == size:
        _, vectors = scipy.linalg.eigh(matrix @ matrix.T, subset_by_index=subset)
        return np.ascontiguousarray(vectors[:, ::-1])
    _, vectors = scipy.linalg.eigh(matrix.T @ matrix, subset_by_index=subset)
    return np.ascontiguousarray(np.linalg.qr(matrix @ vectors[:, ::-1])[0])
