"""Options of the searches for the size of a sensor without a relay mask."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

from lowfc.design.goal import Goal
from lowfc.programs.design.options import span

Kind = Literal["zwfs", "clowfs"]


class Sizes(NamedTuple):
    """Sizes to search: kind of sensor, smallest and largest size in the unit of its key, and other keys of [sensor]."""

    kind: Kind
    low: float
    high: float
    others: dict[str, float]


@dataclass(frozen=True)
class _Request(ABC):
    """Options common to the searches.

    Attributes:
        merit: Figure of merit to optimise: paper, table3, table4, condition, throughput, pareto or contrast.
        estimator: pinv, or weighted for the Cramer-Rao bound.
        modes: Modes in Table 3 and the condition number: 14 or 20.
        weight: Weight w, 0 to 1. The merit pareto is table3^(1 - w) table4^w. The merit paper is the largest ratio of a
            prediction to the paper's value; ratios in Table 3 have the exponent 2 w, that in Table 4 has 2 (1 - w).
            Default: 0.5.
    """

    merit: str = "contrast"
    estimator: str = "weighted"
    modes: int = 14
    weight: float | None = None

    def __post_init__(self) -> None:
        _ = self.goal  # validated here
        low, high = self.sizes.low, self.sizes.high
        if low > high:
            raise ValueError(
                f"the sizes must be in order, SMALLEST:LARGEST, got {low:g}:{high:g}; use {high:g}:{low:g}"
            )

    @cached_property
    def goal(self) -> Goal:
        """The figure of merit to minimise."""
        return Goal(self.merit, self.estimator, self.modes, self.weight)

    @property
    @abstractmethod
    def sizes(self) -> Sizes:
        """The sizes to search."""


@dataclass(frozen=True)
class Spot(_Request):
    """The options of `lowfc design zwfs`.

    Attributes:
        spot: SMALLEST:LARGEST spot diameter, lambda/D.
    """

    spot: str = "0.5:3"

    @property
    def sizes(self) -> Sizes:
        """The spot diameters to search."""
        return Sizes("zwfs", *span("--spot", self.spot), {})


@dataclass(frozen=True)
class Defocus(_Request):
    """The options of `lowfc design clowfs`.

    Attributes:
        defocus: SMALLEST:LARGEST defocus, mm.
        inner_radius: Inner radius of the reflecting annulus, lambda/D.
    """

    defocus: str = "1.5:8"
    inner_radius: float = 0.0

    @property
    def sizes(self) -> Sizes:
        """The defocus distances to search."""
        return Sizes("clowfs", *span("--defocus", self.defocus), {"inner_radius": self.inner_radius})
