"""The sparse aperture mask: circular holes in the relay pupil, eqs. (1) and (2)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lowfc.optics.grid import pupil_axis


@dataclass(frozen=True)
class Layout:
    """Where the holes of a sparse aperture mask are.

    Attributes:
        name: What users call it.
        purpose: One line on what it was designed for.
        hole_diameter: In pupil diameters.
        holes: Centres (x, y) from the pupil's centre, in pupil diameters.
    """

    name: str
    purpose: str
    hole_diameter: float
    holes: tuple[tuple[float, float], ...]


def check(layout: Layout) -> None:
    """Raise ValueError unless every hole lies inside the pupil and none overlaps another."""
    if not layout.holes:
        raise ValueError(f"{layout.name}: a sparse aperture mask needs at least one hole")
    centres = np.array(layout.holes, dtype=np.float64)
    if centres.ndim != 2 or centres.shape[1] != 2 or not np.isfinite(centres).all():
        raise ValueError(f"{layout.name}: every hole is a pair of finite numbers x, y in pupil diameters")
    if not 0.0 < layout.hole_diameter <= 1.0:
        raise ValueError(
            f"{layout.name}: the hole diameter must lie between 0 and 1 pupil diameter, got {layout.hole_diameter}"
        )
    tolerance = 1e-9  # holes may touch each other and the edge
    reach = np.hypot(*centres.T) + layout.hole_diameter / 2.0
    outside = np.flatnonzero(reach > 0.5 + tolerance)
    if outside.size:
        worst = int(outside[np.argmax(reach[outside])])
        raise ValueError(
            f"{layout.name}: {outside.size} hole(s) reach outside the pupil, the worst is hole {worst} at "
            f"{layout.holes[worst]}, which reaches {reach[worst]:.4f} D from the centre; the edge is at 0.5 D"
        )
    distances = np.hypot(*(centres[:, None] - centres).transpose(2, 0, 1))
    np.fill_diagonal(distances, np.inf)
    first, second = np.unravel_index(np.argmin(distances), distances.shape)
    if distances[first, second] < layout.hole_diameter - tolerance:
        raise ValueError(
            f"{layout.name}: holes {first} at {layout.holes[first]} and {second} at {layout.holes[second]} overlap: "
            f"their centres are {distances[first, second]:.4f} D apart, less than a hole diameter of "
            f"{layout.hole_diameter} D"
        )


def is_even_symmetric(layout: Layout) -> bool:
    """Whether every hole has its mirror image through the centre; such a mask cannot sense focus or astigmatism."""
    centres = np.array(layout.holes, dtype=np.float64)
    distances = np.hypot(*(centres[:, None] + centres).transpose(2, 0, 1))
    return bool((distances.min(axis=1) < 1e-6).all())


def transmission(layout: Layout, samples: int) -> NDArray[np.float64]:
    """The mask (samples, samples): 1 where the sample's centre is in a hole, else 0, eqs. (1) and (2)."""
    u = pupil_axis(samples)
    mask = np.zeros((samples, samples))
    for x, y in layout.holes:
        mask[np.hypot(u[:, None] - y, u - x) <= layout.hole_diameter / 2.0] = 1.0
    return mask
