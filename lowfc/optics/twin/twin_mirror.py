"""The wavefront of a deformable mirror on the twin's nodes, computed in microseconds.

The nodes are too coarse for the print-through of the actuators: sampled there, it would alias to low orders. In the
full optics, the shaped pupil's fine structure mixes some of the print-through into low orders. The nodes therefore
carry a least-squares fit of the surface. A small correction makes the field at the sensor, to first order, that of the
full surface.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lowfc.arrays import Integers, Single
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.mirror import Mirror, influence_factors
from lowfc.optics.chain.sensor import Sensor
from lowfc.optics.twin.field_operator import field_operator, sensor_functions
from lowfc.optics.twin.nodes import interpolation
from lowfc.optics.twin.twin import Twin

_FIT_RCOND = 0.01  # smallest relative singular value of the fit; excludes guard nodes that hardly affect the pupil
_MIN_SINGULAR_VALUE = 0.01  # relative to the largest; smaller ones do not make the correction more accurate


@dataclass(frozen=True, eq=False)
class TwinMirror:
    """Matrices from actuators to the used nodes of a twin.

    Attributes:
        used: The twin's used nodes.
        y_factors: (axis, rows) influence functions along y, fitted at the nodes.
        x_factors: (axis, columns) influence functions along x, fitted at the nodes.
        reduce: (significant, rows times columns) matrix from actuators to the effect, at the sensor, of the part of the
            surface that the fit omits.
        expand: (used, significant) matrix from this effect to a smooth surface that has the same effect.
    """

    used: Integers
    y_factors: Single
    x_factors: Single
    reduce: Single
    expand: Single


def twin_mirror(sensor: Sensor, twin: Twin, mirror: Mirror) -> TwinMirror:
    """Fit a mirror to a twin; the correction is computed at the middle wavelength of the band.

    Args:
        sensor: The optics that the twin was built from.
        twin: The twin.
        mirror: The mirror.
    """
    operator = twin.operators[len(twin.operators) // 2]
    scale = sensor.wavelength_nm / operator.wavelength_nm
    u = pupil_axis(sensor.pupil.shape[0])
    actuators = np.arange(mirror.rows * mirror.columns)
    functions = sensor_functions(sensor, scale, twin.spec.guards)
    y_full = influence_factors(mirror, u, mirror.rows)
    x_full = influence_factors(mirror, u, mirror.columns)
    to_field = operator.modes.T @ field_operator(sensor, scale, functions, y_full, x_full, actuators)
    fit = np.linalg.pinv(interpolation(u.size, twin.spec.nodes, twin.spec.order), _FIT_RCOND)
    y_factors, x_factors = fit @ y_full, fit @ x_full
    sampled = _at_nodes(twin.used, y_factors, x_factors)
    left, values, right = np.linalg.svd(operator.to_modes, full_matrices=False)
    significant = values > _MIN_SINGULAR_VALUE * values[0]
    missing = left[:, significant].T @ (to_field - operator.to_modes @ sampled) / values[significant, None]
    return TwinMirror(
        used=twin.used,
        y_factors=y_factors.astype(np.float32),
        x_factors=x_factors.astype(np.float32),
        reduce=missing.astype(np.float32),
        expand=right[significant].astype(np.float32).T,  # column-major: products take 2/3 of the row-major time
    )


def wavefront_nm(mirror: TwinMirror, actuators_nm: NDArray[np.floating]) -> Single:
    """Wavefront (used,) at the twin's nodes: twice the surface.

    Args:
        mirror: Matrices of `twin_mirror`.
        actuators_nm: (rows, columns) nm of surface.
    """
    twice = np.multiply(actuators_nm, np.float32(2.0), dtype=np.float32)
    wavefront = (mirror.y_factors @ twice @ mirror.x_factors.T).take(mirror.used)
    wavefront += mirror.expand @ (mirror.reduce @ twice.ravel())
    return np.asarray(wavefront)


def poke_wavefronts_nm(mirror: TwinMirror) -> Single:
    """Wavefronts (used, actuators) at the twin's nodes of a poke of each actuator by 1 nm of surface."""
    surfaces = _at_nodes(mirror.used, mirror.y_factors, mirror.x_factors) + mirror.expand @ mirror.reduce
    return np.asarray(2 * surfaces)


def _at_nodes(used: Integers, y_factors: NDArray[np.floating], x_factors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Influence functions (used, actuators) at the nodes of a square grid, from their factors along y and x."""
    rows, columns = np.divmod(used, len(y_factors))
    return (y_factors[rows][:, :, None] * x_factors[columns][:, None, :]).reshape(used.size, -1)
