"""The regular grid of pupil nodes on which the twin represents a wavefront, and interpolation from it."""

import numpy as np

from lowfc.arrays import Array
from lowfc.optics.chain.grid import pupil_axis


def node_axis(nodes: int, order: int) -> Array:
    """Coordinates (nodes + order,) along an axis, pupil diameters: `nodes` in the pupil, order / 2 guards on each side.

    Args:
        nodes: Number of nodes across the diameter; the spacing is 1 / nodes.
        order: Number of points of the interpolation stencil: even, so that every stencil is centred.

    Raises:
        ValueError: The order is odd or below 2.
    """
    if order < 2 or order % 2:
        raise ValueError(f"the interpolation order must be even and at least 2, got {order}")
    guards = order // 2
    return (np.arange(-guards, nodes + guards) + 0.5) / nodes - 0.5


def interpolation(samples: int, nodes: int, order: int) -> Array:
    """Lagrange weights (samples, nodes + order) from the nodes of an axis to the samples of a pupil."""
    u = pupil_axis(samples)
    axis = node_axis(nodes, order)
    first = np.floor((u - axis[0]) * nodes).astype(int) - order // 2 + 1
    t = (u - axis[first]) * nodes  # position within the stencil, whose points are 0 ... order - 1
    weights = np.zeros((samples, axis.size))
    for k in range(order):
        others = [j for j in range(order) if j != k]
        lagrange = np.prod([(t - j) / (k - j) for j in others], axis=0)
        weights[np.arange(samples), first + k] = lagrange
    return weights
