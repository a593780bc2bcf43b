"""Options of the search for a sparse aperture mask."""

from dataclasses import dataclass, replace
from functools import cached_property

from lowfc.design.goal import Goal
from lowfc.design.sam_merit import FOCAL_MASKS
from lowfc.design.sam_search import UNIT, Bounds
from lowfc.programs.design.options import span


@dataclass(frozen=True)
class Search:
    """The options of `lowfc design sam`, which with the shaped pupil determine the result.

    Attributes:
        merit: Figure of merit to optimise: paper, table3, table4, condition, throughput, pareto or contrast.
        estimator: pinv, or weighted for the Cramer-Rao bound. Default: weighted; pinv for the merit paper.
        modes: Modes in Table 3 and the condition number: 14 or 20.
        weight: Weight w, 0 to 1. The merit pareto is table3^(1 - w) table4^w. The merit paper is the largest ratio of a
            prediction to the paper's value; ratios in Table 3 have the exponent 2 w, that in Table 4 has 2 (1 - w).
            Default: 0.5; with pareto, each chain has its own weight, from 0 to 1 along a front.
        focal_mask: disk, bowtie or both. Default: disk; both for the merit paper.
        holes: Number of holes, or FEWEST:MOST.
        diameter: Diameter of the holes, or SMALLEST:LARGEST, in pupil diameters.
        gap: Least distance between the rims of two holes, in pupil diameters.
        edge: Least distance from a hole's rim to the pupil's edge, in pupil diameters.
        symmetry: none, or the axis of a mirror symmetry: x or y.
        seed: Seed of all random numbers.
        chains: Number of independent searches: the best is used; along a front, each has its own weight.
        steps: Steps of each chain.
        name: Name of the layout.
    """

    merit: str = "paper"
    estimator: str | None = None
    modes: int = 14
    weight: float | None = None
    focal_mask: str | None = None
    holes: str = "27"
    diameter: str = "0.07"
    gap: float = 0.01
    edge: float = 0.0
    symmetry: str = "none"
    seed: int = 1
    chains: int = 4
    steps: int = 20_000
    name: str = "sam"

    def __post_init__(self) -> None:
        for_paper = self.merit == "paper"
        object.__setattr__(self, "estimator", self.estimator or ("pinv" if for_paper else "weighted"))
        object.__setattr__(self, "focal_mask", self.focal_mask or ("both" if for_paper else "disk"))
        if self.focal_mask not in (*FOCAL_MASKS, "both"):
            raise ValueError(f"--focal-mask must be {', '.join(FOCAL_MASKS)} or both, got {self.focal_mask!r}")
        if not self.name or not all(letter.isalnum() or letter in "_-" for letter in self.name):
            raise ValueError(f"--name must consist of letters, digits, _ and -, got {self.name!r}")
        for option, value in {"chains": self.chains, "steps": self.steps}.items():
            if value < 1:
                raise ValueError(f"--{option} must be at least 1, got {value}")
        if self.seed < 0:
            raise ValueError(f"--seed must not be negative, got {self.seed}")
        _ = self.goal, self.bounds  # validated here
        if len(self.focal_masks) > 1 and not for_paper:
            raise ValueError(f"the merit {self.merit!r} uses one focal-plane mask; only 'paper' uses both")
        if self.has_front and self.chains < 2:
            raise ValueError("a front needs at least 2 chains, one for each weight; or set --weight")

    @cached_property
    def goal(self) -> Goal:
        """The figure of merit to minimise."""
        return Goal(self.merit, str(self.estimator), self.modes, self.weight)

    @cached_property
    def focal_masks(self) -> tuple[str, ...]:
        """Focal-plane masks of Table 3; the first is also used for Table 4."""
        return tuple(FOCAL_MASKS) if self.focal_mask == "both" else (str(self.focal_mask),)

    @cached_property
    def bounds(self) -> Bounds:
        """Constraints on every layout."""
        (gap, _), (edge, _) = _span("--gap", str(self.gap), UNIT), _span("--edge", str(self.edge), UNIT)
        holes, diameter = _span("--holes", self.holes, 1), _span("--diameter", self.diameter, UNIT)
        return Bounds(holes, diameter, gap, edge, self.symmetry)

    @property
    def has_front(self) -> bool:
        """Whether the chains have different weights and search for a front."""
        return self.merit == "pareto" and self.weight is None

    def goal_of(self, index: int) -> Goal:
        """The goal of chain `index`; along a front each chain has its own weight."""
        return replace(self.goal, weight=index / (self.chains - 1)) if self.has_front else self.goal


def _span(option: str, text: str, scale: int) -> tuple[int, int]:
    """Parse LOW:HIGH, or one value for both, in units of 1 / scale."""
    first, last = (value * scale for value in span(option, text))
    low, high = round(first), round(last)
    if abs(low - first) > 1e-6 or abs(high - last) > 1e-6:
        raise ValueError(f"{option} must be in steps of {1 / scale:g}, got {text!r}")
    return low, high
