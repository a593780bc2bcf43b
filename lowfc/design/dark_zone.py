"""The dark zone of a shaped pupil's image: one quadrant, since the others are mirror images; lengths in lambda / D."""

import numpy as np

from lowfc.arrays import Array, Mask
from lowfc.optics.chain.coronagraph import Wedge

FINE_STEP = 0.1
"""Spacing of the points at which the contrast of a mask is checked."""


def fine_grid(zone: Wedge) -> tuple[Array, Mask]:
    """Coordinates (n,) from the star outward, and a mask (n, n), [row = y, column = x], of the points in the zone."""
    axis = _axis(FINE_STEP, zone.outer)
    return axis, _inside(zone, axis)


def first_points(zone: Wedge, step: float) -> Array:
    """Points (n, 2), x and y, where the first linear program limits the field: a square grid, and the edges."""
    axis = _axis(step, zone.outer)
    y, x = np.nonzero(_inside(zone, axis))
    points = np.concatenate([np.column_stack([axis[x], axis[y]]), edge_points(zone, step)])
    return np.unique(np.round(points, 9), axis=0)


def edge_points(zone: Wedge, step: float) -> Array:
    """Points (n, 2), x and y, along the zone's edges: the inner arc, the ray, and the outer arc back."""
    opening = float(np.deg2rad(zone.half_opening_deg))
    upward = np.linspace(0.0, opening, int(np.ceil(zone.inner * opening / step)) + 1)
    ray = np.linspace(zone.inner, zone.outer, int(np.ceil((zone.outer - zone.inner) / step)) + 1)
    downward = np.linspace(opening, 0.0, int(np.ceil(zone.outer * opening / step)) + 1)
    radii = np.concatenate([np.full(upward.size, zone.inner), ray, np.full(downward.size, zone.outer)])
    angles = np.concatenate([upward, np.full(ray.size, opening), downward])
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])


def _axis(step: float, outer: float) -> Array:
    return np.arange(int(np.floor(outer / step + 1e-9)) + 1, dtype=np.float64) * step


def _inside(zone: Wedge, axis: Array) -> Mask:
    x, y, rounding = axis, axis[:, None], 1e-9
    radius, angle_deg = np.hypot(x, y), np.rad2deg(np.arctan2(y, x))
    within = (radius >= zone.inner - rounding) & (radius <= zone.outer + rounding)
    return np.asarray(within & (angle_deg <= zone.half_opening_deg + rounding))
