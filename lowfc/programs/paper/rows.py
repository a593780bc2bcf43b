"""What every table consists of: one figure of the paper, ours, the limit, and what had to be assumed."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
from typing import Any


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes:
        name: What was measured: a sensor, a mode, an element.
        quantity: Which figure of it.
        unit: Of all numbers; "" where they have none.
        measured: Ours.
        paper: The paper's; None where it has none.
        error: Standard error of `measured`, a mean or a scatter over trials; None where no chance is involved.
        predicted: What theory gives for `measured`; None where it was not asked.
        limit: The Cramer-Rao bound, or another limit that the assumption names; None where there is none.
        modes: Number of modes fitted; None where nothing is fitted.
        estimator: How; None where nothing is estimated.
        assumption: What the paper does not say, or contradicts; one to a line.
    """

    name: str
    quantity: str
    unit: str
    measured: float | str | None
    paper: float | str | None = None
    error: float | None = None
    predicted: float | None = None
    limit: float | None = None
    modes: int | None = None
    estimator: str | None = None
    assumption: str | None = None

    @property
    def key(self) -> tuple[str, int | None, str | None, str]:
        """What tells a row from the others of its table."""
        return self.name, self.modes, self.estimator, self.quantity


ORDER = (
    *("name", "modes", "estimator", "quantity", "unit"),
    *("paper", "measured", "error", "predicted", "limit", "assumption"),
)


def plain(row: Row) -> dict[str, Any]:
    """The row as JSON has it; figures have six digits."""
    values = asdict(row)
    return {key: _plain(values[key]) for key in ORDER}


def _plain(value: float | str | None) -> float | str | None:
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if isfinite(value) else str(value)  # JSON has no infinity


def assuming(rows: Sequence[Row], assumption: str) -> list[Row]:
    """The rows, each with an assumption more."""
    return [replace(each, assumption="\n".join(filter(None, (each.assumption, assumption)))) for each in rows]
