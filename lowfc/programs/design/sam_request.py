"""What a search for a sparse aperture mask is asked for, and the command line that asks for it."""

import shlex
from dataclasses import dataclass, replace

from lowfc.contract.errors import ConfigurationError
from lowfc.design.sam_goal import Goal
from lowfc.design.sam_merit import FOCAL_MASKS
from lowfc.design.sam_search import UNIT, Bounds

SEARCH_OPTIONS = (
    *("merit", "estimator", "modes", "weight", "focal_mask", "holes", "diameter", "gap", "edge", "symmetry"),
    *("seed", "chains", "steps", "name"),
)
"""Options on which the result depends: the arguments of `request`."""


@dataclass(frozen=True)
class Search:
    """All that the result depends on, besides the shaped pupil.

    Attributes:
        goal: What is minimised.
        focal_masks: Of Table 3; the first also of Table 4.
        bounds: What every layout keeps to.
        seed: Chain i draws from generators made of (seed, i).
        chains: Independent searches; a Pareto search without a weight gives each its own.
        steps: Of each chain.
        name: Of the layout that is written.
    """

    goal: Goal
    focal_masks: tuple[str, ...]
    bounds: Bounds
    seed: int
    chains: int
    steps: int
    name: str

    def __post_init__(self) -> None:
        for what, value in {"chains": self.chains, "steps": self.steps}.items():
            if value < 1:
                raise ValueError(f"{what} must be at least 1, got {value}")
        if self.seed < 0:
            raise ValueError(f"the seed must not be negative, got {self.seed}")
        if len(self.focal_masks) > 1 and self.goal.merit != "paper":
            raise ValueError(f"the merit {self.goal.merit!r} is of one focal-plane mask; only 'paper' takes both")
        if self.sweeps and self.chains < 2:
            raise ValueError("a front needs at least 2 chains, one for each weight; or give one weight")

    @property
    def sweeps(self) -> bool:
        """Whether the chains go along a front."""
        return self.goal.merit == "pareto" and self.goal.weight is None


def goal_of(search: Search, index: int) -> Goal:
    """What chain `index` minimises: along a front each has a weight of its own."""
    return replace(search.goal, weight=index / (search.chains - 1)) if search.sweeps else search.goal


def request(
    *,
    merit: str,
    estimator: str | None,
    modes: int,
    weight: float | None,
    focal_mask: str | None,
    holes: str,
    diameter: str,
    gap: float,
    edge: float,
    symmetry: str,
    seed: int,
    chains: int,
    steps: int,
    name: str,
) -> Search:
    """A search from the options of `lowfc design sam`; None takes the default that belongs to the merit.

    Raises:
        ConfigurationError: An option, or a combination of options, is wrong.
    """
    for_paper = merit == "paper"
    focal_mask = focal_mask or ("both" if for_paper else "disk")
    if focal_mask not in (*FOCAL_MASKS, "both"):
        raise ConfigurationError(f"--focal-mask must be {', '.join(FOCAL_MASKS)} or both, got {focal_mask!r}")
    if not name or not all(letter.isalnum() or letter in "_-" for letter in name):
        raise ConfigurationError(f"--name must be of letters, digits, _ and -, got {name!r}")
    (fewest, most), (smallest, largest) = _span("--holes", holes, 1), _span("--diameter", diameter, UNIT)
    gap_units, edge_units = (
        _span(f"--{key}", str(value), UNIT)[0] for key, value in {"gap": gap, "edge": edge}.items()
    )
    try:
        return Search(
            Goal(merit, estimator or ("pinv" if for_paper else "weighted"), modes, weight),
            tuple(FOCAL_MASKS) if focal_mask == "both" else (focal_mask,),
            Bounds((fewest, most), (smallest, largest), gap_units, edge_units, symmetry),
            seed,
            chains,
            steps,
            name,
        )
    except ValueError as error:
        raise ConfigurationError(str(error)) from error


def command_of(search: Search) -> str:
    """The command line that finds the same layout again."""
    goal, bounds = search.goal, search.bounds

    def span(low: float, high: float) -> str:
        return f"{low:g}" if low == high else f"{low:g}:{high:g}"

    options = {
        "merit": goal.merit,
        "estimator": goal.estimator,
        "modes": goal.modes,
        "weight": goal.weight,
        "focal-mask": "both" if len(search.focal_masks) > 1 else search.focal_masks[0],
        "holes": span(*bounds.count),
        "diameter": span(bounds.diameter[0] / UNIT, bounds.diameter[1] / UNIT),
        "gap": f"{bounds.gap / UNIT:g}",
        "edge": f"{bounds.edge / UNIT:g}",
        "symmetry": bounds.symmetry,
        "seed": search.seed,
        "chains": search.chains,
        "steps": search.steps,
        "name": search.name,
    }
    given = [word for key, value in options.items() if value is not None for word in (f"--{key}", str(value))]
    return shlex.join(["lowfc", "design", "sam", *given])


def _span(option: str, text: str, scale: int) -> tuple[int, int]:
    """LOW:HIGH, or one value for both, in units of 1 / scale."""
    low, _, high = text.partition(":")
    try:
        first, last = (float(value) * scale for value in (low, high or low))
        span = round(first), round(last)
    except (ValueError, OverflowError):
        raise ConfigurationError(f"{option} must be a number or LOW:HIGH, got {text!r}") from None
    if abs(span[0] - first) > 1e-6 or abs(span[1] - last) > 1e-6:
        raise ConfigurationError(f"{option} must be in steps of {1 / scale:g}, got {text!r}")
    return span
