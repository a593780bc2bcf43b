"""Linear programs of shaped pupils, warm-started from the multipliers of a similar program."""

import numpy as np
from scipy.optimize import linprog

from lowfc.arrays import Array


class NotSolvedError(ValueError):
    """The solver failed."""


def maximise(rows: Array, weights: Array, multipliers: Array) -> tuple[Array, Array, float]:
    """Maximise weights @ x over x in [0, 1] with rows @ x <= 0, by HiGHS' dual simplex.

    scipy accepts no starting basis. Therefore each row with a multiplier gets its own slack variable and is added to
    the objective with its multiplier. The simplex then starts at the optimum that belongs to the multipliers, and needs
    a sixth to three quarters of the steps of a cold start. Presolving would change this starting point.

    Args:
        rows: (m, n) constraints.
        weights: (n,) objective.
        multipliers: (m,) multipliers of a similar program; zero for a row without one.

    Returns:
        x (n,), the multipliers (m,), and the dual bound on the objective, which proves the optimum.

    Raises:
        NotSolvedError: HiGHS failed.
    """
    tight = multipliers > 0
    count = int(np.count_nonzero(tight))
    result = linprog(
        np.concatenate([multipliers @ rows - weights, multipliers[tight]]),
        A_eq=np.hstack([rows[tight], np.eye(count)]),
        b_eq=np.zeros(count),
        A_ub=np.hstack([rows[~tight], np.zeros((len(rows) - count, count))]),
        b_ub=np.zeros(len(rows) - count),
        bounds=[(0.0, 1.0)] * rows.shape[1] + [(0.0, np.inf)] * count,
        method="highs-ds",
        options={"presolve": False},
    )
    if result.status or result.x is None:
        raise NotSolvedError(f"the linear program was not solved: {result.message}")
    updated = multipliers.copy()
    updated[tight] -= result.eqlin.marginals
    updated[~tight] -= result.ineqlin.marginals
    updated = np.where(updated > 1e-12, updated, 0.0)
    bound = float(np.maximum(weights - updated @ rows, 0.0).sum())
    return np.clip(result.x[: rows.shape[1]], 0.0, 1.0), updated, bound
