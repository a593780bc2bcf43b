"""A deformable mirror with separable Gaussian influence functions, and its modes-to-actuators matrix."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Mask
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.zernike import zernikes

_TIKHONOV = 1e-4
"""Regularisation, relative to the mean diagonal element of the normal matrix. With 1e-6 the mean error of the fit would
be the same, 1.2 %, but the largest command of an actuator, at the edge, would be up to three times as large."""


@dataclass(frozen=True)
class Mirror:
    """A square-grid deformable mirror, centred on the pupil.

    Attributes:
        rows: Actuators along y.
        columns: Actuators along x.
        pitches_per_pupil: Actuator pitches across the pupil's diameter.
        coupling: Surface at the neighbour of a poked actuator divided by the surface at the poked actuator.
        shift_pitches: Shift of the actuators relative to the pupil, in pitches, equal along x and y.
    """

    rows: int = 34
    columns: int = 34
    pitches_per_pupil: float = 31.0
    coupling: float = 0.15
    shift_pitches: float = 0.0

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1 or not self.pitches_per_pupil > 0:
            raise ValueError(
                f"a mirror needs at least one actuator per axis and a positive pitch, got {self.rows} x {self.columns} "
                f"at {self.pitches_per_pupil} pitches per pupil"
            )
        if not 0.0 < self.coupling < 1.0:
            raise ValueError(f"the coupling must lie between 0 and 1, got {self.coupling}")


def actuator_axis(mirror: Mirror, actuators: int) -> Array:
    """Positions (actuators,) along one axis in pupil diameters; `actuators` is the mirror's rows or columns."""
    return np.asarray((np.arange(actuators) - (actuators - 1) / 2.0 + mirror.shift_pitches) / mirror.pitches_per_pupil)


def influence_factors(mirror: Mirror, coordinates: Array, actuators: int) -> Array:
    """One axis of the influence functions, (points, actuators); surface = y_factors @ actuators @ x_factors.T.

    The spacing of the points must be below half a pitch, or the print-through of the actuators aliases to low
    frequencies; `twin_mirror` corrects this on the nodes of a twin.

    Args:
        mirror: The mirror.
        coordinates: (points,) in pupil diameters.
        actuators: The mirror's rows for y, columns for x.
    """
    distance = coordinates[:, None] - actuator_axis(mirror, actuators)
    width = 1.0 / (mirror.pitches_per_pupil * np.sqrt(-np.log(mirror.coupling)))
    return np.asarray(np.exp(-((distance / width) ** 2)))


def active_actuators(mirror: Mirror) -> Mask:
    """Mask (rows, columns) of the actuators that are driven: those in the pupil and one ring around it."""
    y = actuator_axis(mirror, mirror.rows)
    x = actuator_axis(mirror, mirror.columns)
    return np.asarray(np.hypot(y[:, None], x) <= 0.5 + 1.5 / mirror.pitches_per_pupil)


def modes_to_actuators(mirror: Mirror, nolls: Sequence[int], usable: Mask | None = None) -> Array:
    """Modes-to-actuators matrix (M2C) of Zernike modes: nm of surface at the actuators per nm rms of wavefront.

    It is a regularised least-squares fit over the circle. It includes the factor 1/2 of reflection: the wavefront is
    twice the surface.

    Args:
        mirror: The mirror.
        nolls: Noll indices.
        usable: (rows, columns) mask of actuators that may be commanded; all when None. The other actuators stay at
            zero, and their neighbours compensate as far as possible.

    Returns:
        (rows times columns, modes); inactive actuators are exactly zero.

    Raises:
        ValueError: Fewer usable actuators than modes.
    """
    u = pupil_axis(int(np.ceil(4.0 * mirror.pitches_per_pupil)))
    inside = (np.hypot(u[:, None], u) <= 0.5).astype(np.float64)
    y_factors = influence_factors(mirror, u, mirror.rows)
    x_factors = influence_factors(mirror, u, mirror.columns)
    # Sums over the circle of products of two influence functions: along x for each row of points, then along y.
    along_x = inside @ _products(x_factors)
    sums = (_products(y_factors).T @ along_x).reshape(mirror.rows, mirror.rows, mirror.columns, mirror.columns)
    actuators = mirror.rows * mirror.columns
    normal = sums.transpose(0, 2, 1, 3).reshape(actuators, actuators)
    surfaces = 0.5 * inside * zernikes(nolls, 2.0 * u, 2.0 * u[:, None])
    projected = (y_factors.T @ surfaces @ x_factors).reshape(len(nolls), actuators)
    driven = active_actuators(mirror) if usable is None else active_actuators(mirror) & usable
    active = np.flatnonzero(driven)
    if active.size < len(nolls):
        raise ValueError(f"{active.size} active actuators in the pupil cannot make {len(nolls)} modes")
    normal = normal[np.ix_(active, active)]
    normal.flat[:: active.size + 1] += _TIKHONOV * np.trace(normal) / active.size
    commands = np.zeros((actuators, len(nolls)))
    commands[active] = np.linalg.solve(normal, projected[:, active].T)
    return commands


def _products(factors: Array) -> Array:
    """Products (points, actuators squared) of every pair of factors at each point."""
    return np.asarray((factors[:, :, None] * factors[:, None, :]).reshape(len(factors), -1))
