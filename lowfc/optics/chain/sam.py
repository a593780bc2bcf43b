"""The sparse aperture mask: circular holes in the relay pupil, eqs. (1) and (2) of Subedi et al. 2015."""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array
from lowfc.optics.chain.grid import pupil_axis


@dataclass(frozen=True)
class Layout:
    """Holes of a sparse aperture mask.

    Attributes:
        name: Name of the layout.
        purpose: Purpose of the design, in one line.
        holes: (x, y, diameter) of each hole, in pupil diameters; (x, y) is its centre, relative to the pupil's centre.
    """

    name: str
    purpose: str
    holes: tuple[tuple[float, float, float], ...]


def check(layout: Layout) -> None:
    """Raise ValueError without holes, or if a hole has an impossible size, leaves the pupil or overlaps another."""
    if not layout.holes:
        raise ValueError(f"{layout.name}: a sparse aperture mask needs at least one hole")
    holes = np.array(layout.holes, dtype=np.float64)
    if holes.ndim != 2 or holes.shape[1] != 3 or not np.isfinite(holes).all():
        raise ValueError(f"{layout.name}: every hole is three finite numbers x, y, diameter in pupil diameters")
    centres, diameters = holes[:, :2], holes[:, 2]
    if not (diameters.min() > 0.0 and diameters.max() <= 1.0):
        raise ValueError(
            f"{layout.name}: hole diameters must lie between 0 and 1 pupil diameter, got {diameters.min()} to "
            f"{diameters.max()}"
        )
    tolerance = 1e-9  # holes may touch each other and the edge
    reach = np.hypot(*centres.T) + diameters / 2.0
    outside = np.flatnonzero(reach > 0.5 + tolerance)
    if outside.size:
        worst = int(outside[np.argmax(reach[outside])])
        raise ValueError(
            f"{layout.name}: {outside.size} hole(s) reach outside the pupil, the worst is hole {worst} at "
            f"{layout.holes[worst][:2]}, which reaches {reach[worst]:.4f} D from the centre; the edge is at 0.5 D"
        )
    distances = np.hypot(*(centres[:, None] - centres).transpose(2, 0, 1))
    gaps = distances - (diameters[:, None] + diameters) / 2.0
    np.fill_diagonal(gaps, np.inf)
    first, second = np.unravel_index(np.argmin(gaps), gaps.shape)
    if gaps[first, second] < -tolerance:
        raise ValueError(
            f"{layout.name}: holes {first} at {layout.holes[first][:2]} and {second} at {layout.holes[second][:2]} "
            f"overlap by {-gaps[first, second]:.4f} D"
        )


def is_even_symmetric(layout: Layout) -> bool:
    """Whether every hole has an equal one opposite the centre; such a mask cannot sense focus or astigmatism."""
    holes = np.array(layout.holes, dtype=np.float64)
    mirrored = holes * np.array([-1.0, -1.0, 1.0])
    distances = np.linalg.norm(holes[:, None] - mirrored, axis=2)
    return bool((distances.min(axis=1) < 1e-6).all())


def transmission(layout: Layout, samples: int, points: int = 1) -> Array:
    """The mask (samples, samples), eqs. (1) and (2): open fraction of each sample.

    Args:
        layout: The holes.
        samples: Samples across the pupil.
        points: Number of points evaluated across a sample in each direction; 1 for the sample's centre only.

    Raises:
        ValueError: A hole is so small that no evaluated point lies in it.
    """
    u = pupil_axis(samples * points)
    mask = np.zeros((samples * points, samples * points), np.bool_)
    for x, y, diameter in layout.holes:
        box = np.ix_(*(np.flatnonzero(np.abs(u - centre) <= diameter / 2.0) for centre in (y, x)))
        inside = np.hypot(u[box[0]] - y, u[box[1]] - x) <= diameter / 2.0
        if not inside.any():
            raise ValueError(
                f"{layout.name}: the hole at ({x}, {y}) is lost between points {1 / u.size:.2g} D apart: its "
                f"diameter is {diameter:g} D; give lengths in pupil diameters, or raise sensor.hole_samples"
            )
        mask[box] += inside
    return np.asarray(mask.reshape(samples, points, samples, points).mean(axis=(1, 3)))
