"""The figure of merit that a search for a better sensor minimises."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lowfc.control.calibration.calibration import ESTIMATORS
from lowfc.design.merit import (
    CONTROLLED,
    Candidate,
    condition,
    contrast_noise,
    exposure_nm2,
    quantum_share,
    table3_noise_waves,
    table3_waves,
    table4_mas,
    throughput,
)
from lowfc.design.paper import MODES, TABLE3_WAVES, TABLE4_MAS, TABLE4_MODES

MERITS = ("paper", "table3", "table4", "condition", "throughput", "pareto", "contrast")
WEIGHTED = ("paper", "pareto")  # merits with a weight between Tables 3 and 4


@dataclass(frozen=True)
class Goal:
    """The figure of merit to minimise.

    Attributes:
        merit: One of `MERITS`. "paper": the largest of `paper_ratios`, where the ratios of Table 3 are raised to the
            power 2 x weight, and the ratio of Table 4 to the power 2 x (1 - weight).
            "pareto": table3^(1 - weight) table4^weight.
            "contrast": contrast added to the dark zone by the noise of 14 modes in one exposure of Table 4's star.
        estimator: "pinv", or "weighted", whose noise is the Cramer-Rao bound.
        modes: Number of modes in "table3", "pareto" and "condition".
        weight: The weight, 0 to 1: in "paper" that of Table 3, in "pareto" that of Table 4; None for 1/2.
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
        if self.weight is not None and not (self.merit in WEIGHTED and 0.0 <= self.weight <= 1.0):
            raise ValueError(
                f"a weight, 0 to 1, belongs to the merits {' and '.join(WEIGHTED)}; got {self.weight} with "
                f"{self.merit!r}"
            )


def merit(candidate: Candidate, goal: Goal) -> float:
    """The figure of merit to minimise, above 0; infinite if a mode has no signal."""
    try:
        value = _merit(candidate, goal)
    except np.linalg.LinAlgError:
        return float("inf")
    return value if np.isfinite(value) and value > 0 else float("inf")


def paper_ratios(candidate: Candidate, estimator: str = "pinv") -> dict[str, float]:
    """Ratios of predicted values to the paper's, in Table 3 and for a tilt of 1 mas in Table 4; below 1 is better."""
    ratios = {}
    for name in candidate.paper_rows:
        for modes in MODES:
            residual = table3_waves(candidate, name, modes, estimator)
            ratios[f"table3 {name} {modes} modes"] = residual / TABLE3_WAVES[name][modes][0]
    ratios["table4"] = _tilt_mas(candidate, estimator) / TABLE4_MAS[candidate.paper_tilt][1]
    return ratios


def _merit(candidate: Candidate, goal: Goal) -> float:
    first, weight = candidate.paper_rows[0], 0.5 if goal.weight is None else goal.weight
    match goal.merit:
        case "paper":
            ratios = paper_ratios(candidate, goal.estimator)
            tilt = ratios.pop("table4")
            return float(max(max(ratios.values()) ** (2.0 * weight), tilt ** (2.0 * (1.0 - weight))))
        case "table4":
            return _tilt_mas(candidate, goal.estimator)
        case "condition":
            return condition(candidate.central(first), goal.modes)
        case "throughput":
            return 1.0 / throughput(candidate.central(first))
        case "contrast":
            return contrast_noise(candidate.forms, candidate.central(first), goal.estimator)
    residual = table3_waves(candidate, first, goal.modes, goal.estimator)
    if goal.merit == "table3":
        return residual
    return float(residual ** (1.0 - weight) * _tilt_mas(candidate, goal.estimator) ** weight)


def _tilt_mas(candidate: Candidate, estimator: str) -> float:
    return max(table4_mas(candidate.in_band, TABLE4_MODES, estimator))


def predictions(candidate: Candidate) -> dict[str, Any]:
    """Predicted values of Tables 3 (the first of `paper_rows`) and 4, throughput, condition, noise and contrast.

    "bound" is the Cramer-Rao bound of Table 3, without second-order errors; in Table 4 "weighted" attains the bound.
    """
    first, in_band = candidate.paper_rows[0], candidate.in_band
    central, forms = candidate.central(first), candidate.forms
    table3 = {name: {str(m): table3_waves(candidate, first, m, name) for m in MODES} for name in ESTIMATORS}
    table3["bound"] = {str(m): table3_noise_waves(forms, central, m, "weighted") for m in MODES}
    fitted = (TABLE4_MODES, in_band.H.shape[1])
    return {
        "throughput": throughput(central),
        "condition": {str(m): condition(central, m) for m in MODES},
        "table3_waves": table3,
        "table4_mas": {name: {str(m): table4_mas(in_band, m, name) for m in fitted} for name in ESTIMATORS},
        "noise_nm": float(np.sqrt(np.trace(exposure_nm2(central, CONTROLLED, "weighted")))),
        "contrast_noise": contrast_noise(forms, central, "weighted"),
        "quantum_share": quantum_share(forms, central),
    }
