"""The shaped pupil by linear programming: the most open mask whose image has a dark zone.

The variables are the transmissions of the cells of one quadrant. A mask that is symmetric about both axes has a real
field, so that `|E| <= sqrt(contrast) E(0)` is two linear inequalities at every point. Less symmetry would gain nothing:
the mean of any mask and its mirror images is as open as the mask, and as dark if the zone is symmetric, too.

Between the points of a coarse grid the intensity is tens of times higher than at the points. `exchange` therefore adds
the maxima of the solution on a fine grid as points to the next program, until none exceeds the required contrast.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from lowfc.arrays import Array, Integers, Mask
from lowfc.design.dark_zone import FINE_STEP, edge_points, fine_grid, first_points
from lowfc.design.linear_program import maximise
from lowfc.optics.chain.coronagraph import Wedge
from lowfc.optics.chain.focal_mask import disk
from lowfc.optics.chain.fourier import to_image
from lowfc.optics.chain.grid import OPEN_AREA, SAMPLES, pupil_axis
from lowfc.optics.chain.pupil import circle, from_quarter

FOCAL_MASK_RADIUS = 4.0
"""Radius of the disk for which the fraction of the light is reported, in lambda / D."""

MIN_OPEN_AREA = 0.01
"""Open fraction of the circle below which a request counts as infeasible: a closed mask is dark everywhere."""

SYMMETRIES = ("quarter", "octant")

COARSEST_CELLS = 32
"""Cells in half the diameter in the first programs, which find most of the points quickly."""


@dataclass(frozen=True)
class Request:
    """Requirements on a shaped pupil: the options of `lowfc design spc`.

    Attributes:
        inner: Inner radius of the dark zone, in lambda/D.
        outer: Outer radius of the dark zone, in lambda/D.
        half_angle_deg: Angle of the dark zone's edges from the x axis, in degrees; 90 for a zone all around the star.
        contrast: Largest intensity in the dark zone, relative to the star's peak; checked every 0.1 lambda/D and on its
            edges.
        limit: Contrast in the linear programs, as a fraction of the required one; below 1 it saves rounds.
        cells: Cells in half the diameter: 8, 16, 32, 64, 128 or 256.
        step: Spacing of the first grid of points, in lambda/D.
        symmetry: quarter: about both axes; octant: mask and zone also about the diagonals, solved 3 to 9 times faster.
        rounds: Largest number of programs for each number of cells.
    """

    inner: float = 4.0
    outer: float = 20.0
    half_angle_deg: float = 42.5
    contrast: float = 1e-9
    limit: float = 0.95
    cells: int = 128
    step: float = 0.5
    symmetry: str = "quarter"
    rounds: int = 20

    def __post_init__(self) -> None:
        if self.cells < 8 or SAMPLES // 2 % self.cells:
            raise ValueError(f"cells must be 8, 16, 32, 64, 128 or 256 in half the diameter, got {self.cells}")
        if not 0 < self.inner <= _last_inner(self.outer) or self.outer > self.cells:
            raise ValueError(
                f"the dark zone must begin above 0, end at least {FINE_STEP:g} lambda/D further out, and end at most "
                f"at the number of cells in half the diameter, {self.cells} lambda/D; got {self.inner:g} to "
                f"{self.outer:g} lambda/D"
            )
        if not 0 < self.half_angle_deg <= 90:
            raise ValueError(f"the half-angle must be above 0 and at most 90 degrees, got {self.half_angle_deg:g}")
        if not 0 < self.contrast < 1 or not 0 < self.limit <= 1:
            raise ValueError(
                "contrast must lie between 0 and 1 and the limit above 0 and at most 1, got "
                f"{self.contrast:g} and {self.limit:g}"
            )
        if not FINE_STEP <= self.step <= 2:
            raise ValueError(f"the grid's step must lie between {FINE_STEP} and 2 lambda/D, got {self.step:g}")
        if self.symmetry not in SYMMETRIES:
            raise ValueError(f"the symmetry must be one of {', '.join(SYMMETRIES)}, got {self.symmetry!r}")
        if self.rounds < 1:
            raise ValueError(f"at least one round is needed, got {self.rounds}")

    @property
    def zone(self) -> Wedge:
        """The dark zone; with octant symmetry only its part within 45 degrees of the x axis."""
        most_deg = 45.0 if self.symmetry == "octant" else 90.0
        return Wedge(self.inner, self.outer, min(self.half_angle_deg, most_deg))


@dataclass(frozen=True, eq=False)
class Round:
    """A solved program.

    Attributes:
        number: Number of the round, from 1 for each number of cells.
        points: Number of points in the program, each with one sign of the field.
        quarter: (cells, cells) quadrant of the mask, [0, 0] next to the pupil's centre.
        open_area: Open fraction of the circle.
        bound: Dual bound on `open_area`: no mask that meets `limit` times the contrast at these points is more open. A
            mask that meets only the contrast itself may be.
        contrast: Largest contrast in the zone on the fine grid; infinite for a closed mask.
    """

    number: int
    points: int
    quarter: Array
    open_area: float
    bound: float
    contrast: float


@dataclass(frozen=True)
class MaskProperties:
    """Properties of a mask; contrasts are sampled every `FINE_STEP` in the dark zone.

    Attributes:
        open_area_fraction: Mean amplitude transmission over the circle.
        energy_fraction: Fraction of the open circle's light that passes.
        focal_mask_fraction: Fraction of the passing light that falls within `FOCAL_MASK_RADIUS`.
        max_contrast: Largest contrast, including the zone's edges.
        mean_contrast: Mean contrast.
        grey_cells_fraction: Fraction of the circle's cells that are neither open nor closed to a thousandth.
    """

    open_area_fraction: float
    energy_fraction: float
    focal_mask_fraction: float
    max_contrast: float
    mean_contrast: float
    grey_cells_fraction: float


def exchange(request: Request) -> Iterator[Round]:
    """Solve a series of programs, first with few cells; the last meets the contrast unless the rounds ran out.

    Each program starts at the multipliers of the previous one, with the points found so far. If only a closed mask is
    dark, the contrast of the last round is infinite.

    Raises:
        NotSolvedError: The solver failed.
    """
    points = first_points(request.zone, request.step)
    points, signs = np.concatenate([points, points]), np.repeat([1.0, -1.0], len(points))
    multipliers = np.zeros(len(points))
    level = np.sqrt(request.limit * request.contrast)
    for cells in _cell_numbers(request):
        y, x, weights = _variables(cells, request.symmetry)
        for number in range(1, request.rounds + 1):
            rows = _rows(points, signs, cells, request.symmetry) - level * weights
            values, multipliers, bound = maximise(rows, weights, multipliers)
            quarter = np.zeros((cells, cells))
            quarter[y, x] = values
            if request.symmetry == "octant":
                quarter[x, y] = values
            is_open = _open_area(quarter) >= MIN_OPEN_AREA
            contrast = largest_contrast(quarter, request) if is_open else np.inf
            bound_area = bound / (cells**2 * OPEN_AREA)
            yield Round(number, len(points), quarter, _open_area(quarter), bound_area, contrast)
            if not is_open or contrast <= request.contrast:
                break
            maxima, maxima_signs = _maxima(quarter, request, level * (1 + 1e-6))
            points, signs = np.concatenate([points, maxima]), np.concatenate([signs, maxima_signs])
            multipliers = np.concatenate([multipliers, np.zeros(len(maxima))])
        # Drop each point's limit for the opposite sign of the field, which hardly ever acts with more cells.
        if is_open:
            relevant = (signs * _field_at(quarter, points) > 0) | (multipliers > 0)
            points, signs, multipliers = points[relevant], signs[relevant], multipliers[relevant]


def relative_field(quarter: Array, axis: Array) -> Array:
    """Field E / E(0) of a mask at all pairs of coordinates, [row = y, column = x].

    Args:
        quarter: (cells, cells) quadrant of the mask.
        axis: (n,) coordinates in lambda / D.
    """
    waves = _waves(axis, len(quarter))
    return np.asarray(waves @ quarter @ waves.T / quarter.sum())


def largest_contrast(quarter: Array, request: Request) -> float:
    """Largest contrast of a mask (cells, cells), on the fine grid of the dark zone and on its edges."""
    axis, zone = fine_grid(request.zone)
    on_grid = relative_field(quarter, axis)[zone]
    on_edge = _field_at(quarter, edge_points(request.zone, FINE_STEP))
    return float(max(np.abs(on_grid).max(), np.abs(on_edge).max()) ** 2)


def properties(quarter: Array, request: Request) -> MaskProperties:
    """Properties of a mask, transmissions (cells, cells) of one quadrant, for the dark zone of a request."""
    axis, zone = fine_grid(request.zone)
    contrast = relative_field(quarter, axis)[zone] ** 2
    pupil = from_quarter(quarter, SAMPLES)
    samples_per = 8
    mask = disk(samples_per, FOCAL_MASK_RADIUS)
    image = np.abs(to_image(pupil.astype(np.complex128), len(mask), samples_per, 1.0)) ** 2
    cells = quarter[_circle_quarter(len(quarter))]
    return MaskProperties(
        open_area_fraction=_open_area(quarter),
        energy_fraction=float((pupil**2).mean() / OPEN_AREA),
        focal_mask_fraction=float((image * mask).sum() / samples_per**2 / (pupil**2).mean()),
        max_contrast=largest_contrast(quarter, request),
        mean_contrast=float(contrast.mean()),
        grey_cells_fraction=float(((cells > 1e-3) & (cells < 1 - 1e-3)).mean()),
    )


def in_shortest_type(quarter: Array, request: Request) -> NDArray[np.floating]:
    """The mask, transmissions (cells, cells), in the shortest floating-point type that meets the contrast."""
    for kind in (np.float16, np.float32):
        short: NDArray[np.floating] = quarter.astype(kind)
        if largest_contrast(short.astype(np.float64), request) <= request.contrast:
            return short
    return quarter


def nearest_feasible(request: Request) -> tuple[float | None, float | None]:
    """For an infeasible request, the nearest feasible inner radius (steps of 0.1) and contrast (steps of 26 %).

    They are found with the fewest cells that resolve the zone.

    Returns:
        Inner radius, lambda/D (at most twice as large), and contrast (at most 1e5 times as large), each with everything
        else unchanged; None if even the largest value is infeasible.
    """
    coarse = replace(request, cells=_cell_numbers(request)[0])
    inners = [round(v, 6) for v in request.inner + 0.1 * np.arange(1, round(10 * request.inner) + 1)]
    contrasts = [float(f"{request.contrast * 10 ** (k / 10):.1e}") for k in range(1, 51)]
    return (
        _first([v for v in inners if v <= _last_inner(request.outer)], lambda v: is_feasible(replace(coarse, inner=v))),
        _first([v for v in contrasts if v < 1], lambda v: is_feasible(replace(coarse, contrast=v))),
    )


def is_feasible(request: Request) -> bool:
    """Whether a mask that meets the contrast and is not closed is found within the rounds."""
    return [solved.contrast <= request.contrast for solved in exchange(request)][-1]


def _last_inner(outer: float) -> float:
    """Largest inner radius with which a zone has a point of the fine grid, in lambda/D; 1e-9 is for rounding."""
    return outer - FINE_STEP + 1e-9


def _first(candidates: Sequence[float], feasible: Callable[[float], bool]) -> float | None:
    """The first feasible candidate, by bisection; each must be easier than the one before."""
    place = bisect_left(candidates, True, key=feasible)
    return candidates[place] if place < len(candidates) else None


def _cell_numbers(request: Request) -> list[int]:
    """Numbers of cells of successive programs; the last is the requested one."""
    finest = request.cells
    coarser = [cells for cells in (COARSEST_CELLS, 64, 128) if request.outer <= cells < finest]
    return [*coarser, finest]


def _variables(cells: int, symmetry: str) -> tuple[Integers, Integers, Array]:
    """Indices y and x (n,) of the independent cells, and the number of cells that each represents by symmetry."""
    y, x = np.nonzero(_circle_quarter(cells))
    if symmetry == "quarter":
        return y, x, np.ones(y.size)
    below = y <= x
    y, x = y[below], x[below]
    return y, x, np.where(y == x, 1.0, 2.0)


def _rows(points: Array, signs: Array, cells: int, symmetry: str) -> Array:
    """Signed field (points, n) of each variable at the points; a cell adds 1 to E(0)."""
    y, x, weights = _variables(cells, symmetry)
    along_x, along_y = (_waves(points[:, k], cells) for k in (0, 1))
    rows = along_y[:, y] * along_x[:, x]
    if symmetry == "octant":
        rows = 0.5 * weights * (rows + along_y[:, x] * along_x[:, y])
    return np.asarray(signs[:, None] * rows)


def _waves(axis: Array, cells: int) -> Array:
    """Cosine kernel (n, cells) from the cells of half an axis of a symmetric pupil to the image; means over cells."""
    u = pupil_axis(SAMPLES)[SAMPLES // 2 :]
    return np.asarray(np.cos(2.0 * np.pi * np.outer(axis, u)).reshape(axis.size, cells, -1).mean(axis=2))


def _field_at(quarter: Array, points: Array) -> Array:
    """Field E / E(0) (n,) of a mask at points (n, 2)."""
    along_x, along_y = (_waves(points[:, k], len(quarter)) for k in (0, 1))
    return np.asarray(((along_y @ quarter) * along_x).sum(axis=1) / quarter.sum())


def _maxima(quarter: Array, request: Request, level: float) -> tuple[Array, Array]:
    """Maxima of the field's absolute value above a level: points (n, 2), and signs (n,) of the field there."""
    axis, zone = fine_grid(request.zone)
    field = np.where(zone, relative_field(quarter, axis), 0.0)
    edge = edge_points(request.zone, FINE_STEP)
    on_edge = _field_at(quarter, edge)
    y, x = np.nonzero(_peaks(field, level))
    peaks = _peaks(on_edge, level)
    points = np.concatenate([np.column_stack([axis[x], axis[y]]), edge[peaks]])
    return points, np.sign(np.concatenate([field[y, x], on_edge[peaks]]))


def _peaks(field: Array, level: float) -> Mask:
    size = np.abs(field)
    return np.asarray((size > level) & (size >= maximum_filter(size, 3)))


def _circle_quarter(cells: int) -> Mask:
    return circle(2 * cells)[cells:, cells:] > 0


def _open_area(quarter: Array) -> float:
    return float(quarter.mean() / OPEN_AREA)
