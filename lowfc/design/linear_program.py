"""Linear programs of the kind that a shaped pupil is, each begun where a similar one ended."""

import numpy as np
from scipy.optimize import linprog

from lowfc.arrays import Array


class NotSolvedError(ValueError):
    """The solver gave up."""


def maximise(rows: Array, weights: Array, multipliers: Array) -> tuple[Array, Array, float]:
    """The x in [0, 1] of the largest weights @ x with rows @ x <= 0, by HiGHS' dual simplex.

    scipy takes no starting basis. A row with a multiplier is therefore given a slack of its own, and is added to the
    objective with its multiplier: at the optimum that belongs to the multipliers nothing is left to be gained, and the
    simplex, which begins there, needs a sixth to two thirds of the steps. Presolving would undo it.

    Args:
        rows: (m, n).
        weights: (n,).
        multipliers: (m,) of a similar program, zero where not known.

    Returns:
        x (n,), the multipliers (m,), and the dual bound on the objective, which proves the optimum.

    Raises:
        NotSolvedError: HiGHS gave up.
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
    found = multipliers.copy()
    found[tight] -= result.eqlin.marginals
    found[~tight] -= result.ineqlin.marginals
    found = np.where(found > 1e-12, found, 0.0)
    bound = float(np.maximum(weights - found @ rows, 0.0).sum())
    return np.clip(result.x[: rows.shape[1]], 0.0, 1.0), found, bound
