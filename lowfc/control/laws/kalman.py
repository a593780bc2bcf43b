"""LQG: the Kalman filter of a mode's drift and lines, and the command that takes out what it foresees.

The filter sees pseudo-open-loop modes, so that its steady gain does not depend on the command. A delay of d frames, of
which w whole and f of a frame, makes exposure k + w see (1 - f) c[k] + f c[k-1]; c[k] is chosen so that the expected
squares of what is left, now and later, are least.
"""

from collections.abc import Sequence

import numpy as np

from lowfc.arrays import Array
from lowfc.control.laws.linear_law import Block, LinearLaw, of_blocks
from lowfc.control.laws.vibration import Model

_DOUBLINGS = 40
_STILLNESS = 1e-4
"""Weight of a command's move beside what is left of the wavefront: where f is 1/2, moves alone would be free."""


def lqg(models: Sequence[Model], noll: tuple[int, ...], delay_frames: float) -> LinearLaw:
    """The law of these modes, one model each.

    Raises:
        ValueError: another number of models than of modes, models of different rates, or a filter that has no limit.
    """
    rates = {model.rate_hz for model in models}
    if len(rates) != 1:
        raise ValueError(f"the models of a law have one frame rate, got {sorted(rates)}")
    blocks = [lqg_block(model, delay_frames) for model in models]
    return of_blocks(blocks, "pol", "lqg", noll, delay_frames, rates.pop())


def lqg_block(model: Model, delay_frames: float) -> Block:
    """The part of the law for one mode; where the delay has a fraction, its last state is the command before."""
    A, _, C = model.states()
    covariance = covariance_nm2(model)
    L = covariance @ C / (C @ covariance @ C + model.noise_nm2)
    whole = int(np.floor(delay_frames))
    fraction = delay_frames - whole
    foreseen = C @ np.linalg.matrix_power(A, whole)
    F = A - np.outer(L, C @ A)
    states = len(A)
    if fraction == 0:
        return Block(F, L, np.zeros(states), A, -foreseen)
    before, ahead = _steer(fraction, foreseen, A)
    larger = np.zeros((2, states + 1, states + 1))
    larger[0, :states, :states], larger[1, :states, :states] = F, A
    kept = np.zeros(states + 1)
    kept[-1] = 1.0
    return Block(larger[0], np.append(L, 0.0), kept, larger[1], -np.append(ahead, before))


def covariance_nm2(model: Model) -> Array:
    """Covariance (states, states) of what the steady filter does not know of the states before a frame.

    Raises:
        ValueError: the Riccati equation has no solution.
    """
    A, Q, C = model.states()
    return model.noise_nm2 * _riccati(A, Q / model.noise_nm2, C)


def _riccati(A: Array, Q: Array, C: Array) -> Array:
    """Covariance X = A (X - X C' C X / (1 + C X C')) A' + Q of the states before a frame, by doubling.

    Each turn doubles the number of frames that have been filtered, from a start that is certain. Lines that are all
    but undamped put poles next to the unit circle, which scipy's `solve_discrete_are` cannot tell apart.

    Raises:
        ValueError: it does not settle.
    """
    seen, passed, found = np.outer(C, C), A.T, Q
    identity = np.eye(len(A))
    for _ in range(_DOUBLINGS):
        inside = np.linalg.solve(identity + seen @ found, np.hstack([passed, seen]))
        ahead, more = inside[:, : len(A)], inside[:, len(A) :]
        grown = passed.T @ found @ ahead
        seen = seen + passed @ more @ passed.T
        passed = passed @ ahead
        found = found + (grown + grown.T) / 2
        seen = (seen + seen.T) / 2
        if np.abs(grown).max() <= 1e-12 * np.abs(found).max():
            return np.asarray(found)
    raise ValueError(f"no Kalman filter settles within {2**_DOUBLINGS} frames: of a line nothing is seen")


def _steer(fraction: float, foreseen: Array, A: Array) -> tuple[float, Array]:
    """Gains of c[k] = -(before c[k-1] + ahead x[k]) for what is seen, (1 - f) c[k] + f c[k-1], against foreseen x[k].

    The Riccati equation of one state, c[k-1], in closed form; weights: R of c[k]^2, Q of c[k-1]^2, N between.
    """
    R = (1 - fraction) ** 2 + _STILLNESS
    Q = fraction**2 + _STILLNESS
    N = fraction * (1 - fraction) - _STILLNESS
    P = ((Q - R) + np.sqrt((Q - R) ** 2 + 4 * (Q * R - N**2))) / 2
    before = N / (R + P)
    later = np.linalg.solve(
        (np.eye(len(A)) + before * A).T, (fraction - before * (1 - fraction)) * foreseen
    )  # of 2 c[k-1] x[k] in what remains to be paid
    return float(before), ((1 - fraction) * foreseen + later @ A) / (R + P)
