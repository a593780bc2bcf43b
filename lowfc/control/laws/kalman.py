"""LQG: a Kalman filter of a mode's drift and lines, and the command that removes the predicted disturbance.

The filter's input is pseudo-open-loop modes, so its steady gain does not depend on the command. The command nulls the
mean prediction over the period in which it is in force: not at an instant, and not over the next exposure.
"""

from collections.abc import Sequence

import numpy as np

from lowfc.arrays import Array
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.linear_law import Block, LinearLaw, law_from_blocks
from lowfc.control.laws.vibration import Model

_DOUBLINGS = 40  # largest number of iterations, each of which doubles the number of filtered frames


def lqg(models: Sequence[Model], noll: tuple[int, ...], timing: Timing) -> LinearLaw:
    """The law from one model for each mode, for frames that measure the mean of each mode over the exposure.

    Raises:
        ValueError: the numbers of models and modes differ, models have different rates, or a filter does not converge.
    """
    rates = {model.rate_hz for model in models}
    if len(rates) != 1:
        raise ValueError(f"the models of a law have one frame rate, got {sorted(rates)}")
    blocks = [lqg_block(model, timing) for model in models]
    return law_from_blocks(blocks, "pol", "lqg", noll, timing.delay, rates.pop())


def lqg_block(model: Model, timing: Timing) -> Block:
    """The part of the law for one mode."""
    A, _, C = model.states()
    covariance = covariance_nm2(model)
    L = covariance @ C / (C @ covariance @ C + model.noise_nm2)
    # Matrix from the mean over an exposure to the mean over the period in which the command is in force.
    foreseen = model.mean_over(timing.applied, timing.held) @ np.linalg.inv(model.mean_over(0.0, timing.exposure))
    return Block(A - np.outer(L, C @ A), L, np.zeros(len(A)), A, -C @ foreseen)


def covariance_nm2(model: Model) -> Array:
    """Covariance (states, states) of the steady filter's prediction error before a frame.

    It is n X, with the noise variance n and X = A (X - X C' C X / (1 + C X C')) A' + Q / n, solved by doubling: each
    iteration of this structure-preserving algorithm doubles the number of filtered frames, from zero covariance. Nearly
    undamped lines put poles next to the unit circle, which scipy's `solve_discrete_are` cannot separate.

    Raises:
        ValueError: the iteration does not converge.
    """
    A, Q, C = model.states()
    seen, passed, X = np.outer(C, C), A.T, Q / model.noise_nm2
    identity = np.eye(len(A))
    for _ in range(_DOUBLINGS):
        inside = np.linalg.solve(identity + seen @ X, np.hstack([passed, seen]))
        solved_passed, solved_seen = inside[:, : len(A)], inside[:, len(A) :]
        grown = passed.T @ X @ solved_passed
        seen = seen + passed @ solved_seen @ passed.T
        passed = passed @ solved_passed
        X = X + (grown + grown.T) / 2
        seen = (seen + seen.T) / 2
        if np.abs(grown).max() <= 1e-12 * np.abs(X).max():
            return model.noise_nm2 * np.asarray(X)
    raise ValueError(
        f"no Kalman filter settles within {2**_DOUBLINGS} frames: drift or lines far below the noise, or zero noise"
    )
