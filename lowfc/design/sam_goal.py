"""What a search for a sparse aperture mask minimises."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lowfc.control.calibration.calibration import ESTIMATORS
from lowfc.design.paper import MODES, TABLE3_WAVES, TABLE4_MAS, TABLE4_MODES
from lowfc.design.sam_merit import (
    Optics,
    Single,
    band_signal,
    condition,
    signal,
    table3_noise_waves,
    table3_waves,
    table4_mas,
    throughput,
)

MERITS = ("paper", "table3", "table4", "condition", "throughput", "pareto")
_WEIGHTED = ("paper", "pareto")


@dataclass(frozen=True)
class Goal:
    """What is minimised, for the focal-plane masks of the optics.

    Attributes:
        merit: Of `MERITS`; "paper" is the largest ratio of a predicted figure to the paper's, over its rows of Table 3
            and Table 4, those of Table 3 to the power of 2 weight, that of Table 4 to 2 (1 - weight); "pareto" is
            table3^(1 - weight) table4^weight.
        estimator: "pinv", or "weighted" for the Cramer-Rao bound.
        modes: Number of modes in Table 3 and in the condition number.
        weight: Of Table 4 in "pareto" and "paper", 0 to 1; None for 1/2 in "paper", and for a weight of its own for
            each chain in a "pareto" search.
    """

    merit: str = "paper"
    estimator: str = "pinv"
    modes: int = 14
    weight: float | None = None

    def __post_init__(self) -> None:
        if self.merit not in MERITS:
            raise ValueError(f"merit must be one of {', '.join(MERITS)}, got {self.merit!r}")
        if self.modes not in MODES:
            raise ValueError(f"modes must be 14 or 20 (radial degrees up to 4 or 5), got {self.modes}")
        if self.estimator not in ESTIMATORS:
            raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {self.estimator!r}")
        if self.weight is not None and not (self.merit in _WEIGHTED and 0.0 <= self.weight <= 1.0):
            raise ValueError(
                f"a weight, 0 to 1, belongs to the merits {' and '.join(_WEIGHTED)}; got {self.weight} with "
                f"{self.merit!r}"
            )


def merit(optics: Optics, goal: Goal, fields: Single) -> float:
    """The figure to be made small, above 0, of a mask's fields, shapes as in `hole_fields`.

    Inf where a mode has no signal.
    """
    try:
        value = _merit(optics, goal, fields)
    except np.linalg.LinAlgError:
        return float("inf")
    return value if np.isfinite(value) and value > 0 else float("inf")


def paper_ratios(optics: Optics, fields: Single, estimator: str = "pinv") -> dict[str, float]:
    """Predicted over paper's figure, of each row of Tables 3 and 4, of fields with shapes as in `hole_fields`."""
    ratios = {}
    for name in optics.focal_masks:
        seen = signal(optics, fields, name)
        for modes in MODES:
            noise = table3_waves(optics, seen, modes, estimator)
            ratios[f"table3 {name} {modes} modes"] = noise / TABLE3_WAVES[name][modes][0]
    ratios["table4"] = _tilt_mas(optics, fields, estimator) / TABLE4_MAS["sam"][1]
    return ratios


def _merit(optics: Optics, goal: Goal, fields: Single) -> float:
    if goal.merit == "paper":
        weight = 0.5 if goal.weight is None else goal.weight
        ratios = paper_ratios(optics, fields, goal.estimator)
        tilt = ratios.pop("table4")
        return float(max(max(ratios.values()) ** (2.0 * weight), tilt ** (2.0 * (1.0 - weight))))
    if goal.merit == "table4":
        return _tilt_mas(optics, fields, goal.estimator)
    seen = signal(optics, fields, optics.focal_masks[0])
    if goal.merit == "condition":
        return condition(seen, goal.modes)
    if goal.merit == "throughput":
        return 1.0 / throughput(seen)
    residual = table3_waves(optics, seen, goal.modes, goal.estimator)
    if goal.merit == "table3":
        return residual
    if goal.weight is None:
        raise ValueError("a point of the front needs a weight")
    tilt = _tilt_mas(optics, fields, goal.estimator)
    return float(residual ** (1.0 - goal.weight) * tilt**goal.weight)


def _tilt_mas(optics: Optics, fields: Single, estimator: str) -> float:
    return max(table4_mas(band_signal(optics, fields), TABLE4_MODES, estimator))


def figures(optics: Optics, fields: Single) -> dict[str, Any]:
    """What the first focal-plane mask's rows would show, as plain values; fields have shapes as in `hole_fields`.

    "bound" is the Cramer-Rao bound of Table 3, which knows no second order; in Table 4 "weighted" attains it.
    """
    seen, in_band = signal(optics, fields, optics.focal_masks[0]), band_signal(optics, fields)
    table3 = {name: {str(m): table3_waves(optics, seen, m, name) for m in MODES} for name in ESTIMATORS}
    table3["bound"] = {str(m): table3_noise_waves(optics, seen, m, "weighted") for m in MODES}
    fitted = (TABLE4_MODES, optics.band_modes)
    return {
        "throughput": throughput(seen),
        "condition": {str(m): condition(seen, m) for m in MODES},
        "table3_waves": table3,
        "table4_mas": {name: {str(m): table4_mas(in_band, m, name) for m in fitted} for name in ESTIMATORS},
    }
