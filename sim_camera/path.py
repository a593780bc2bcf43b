"""Position of the simulated mirror at any time, from the times of its commands and its settling."""

from collections import deque

import numpy as np

from lowfc.arrays import Array, Single

MirrorMotion = tuple[list[Single], Single]
"""Shapes (rows, columns) of the mirror in a period, and weights (instants, shapes) of each at instants in it."""


class MirrorPath:
    """Shapes of the mirror in the order of their application; times are in frame periods."""

    def __init__(self, flat_nm: Single, delay: float = 0.0, settling: float = 0.0) -> None:
        """Start with a shape (rows, columns), nm of surface.

        Args:
            flat_nm: the first shape, in effect since the infinite past.
            delay: time from the application of a shape to its effect.
            settling: time constant of the mirror's first-order response; 0 for an instantaneous mirror.
        """
        self._moves: deque[tuple[float, Single]] = deque([(-np.inf, flat_nm)])
        self._delay = delay
        self._settling = settling

    def applied(self, moment: float, shape_nm: Single, latest: float = np.inf) -> None:
        """Add a shape (rows, columns) applied at `moment`, but not after `latest`, nor before the previous shape."""
        self._moves.append((max(min(moment, latest) + self._delay, self._moves[-1][0]), shape_nm))

    def motion(self, start: float, instants: Array) -> MirrorMotion:
        """Shapes (rows, columns) in effect in the period from `start`, and the weight of each (instants, shapes).

        `instants` (instants,) are relative to `start`. Earlier shapes are dropped once the mirror has settled; those of
        a slow mirror are replaced by its position at the last move before `start`.
        """
        while len(self._moves) > 1 and self._moves[1][0] + 20 * self._settling <= start:
            self._moves.popleft()
        while len(self._moves) > 2 and self._moves[2][0] <= start:
            (_, before_nm), (moment, target_nm) = self._moves.popleft(), self._moves.popleft()
            remaining = np.exp((moment - self._moves[0][0]) / self._settling)
            self._moves.appendleft((-np.inf, target_nm + np.float32(remaining) * (before_nm - target_nm)))
        moves = [move for move in self._moves if move[0] < start + 1]
        weights = np.zeros((len(instants), len(moves)), np.float32)
        weights[:, 0] = 1
        ends = [moment for moment, _ in moves[2:]] + [np.inf]
        for column, ((moment, _), end) in enumerate(zip(moves[1:], ends, strict=False), 1):
            since = np.maximum(np.minimum(start + instants, end) - moment, 0.0)
            remaining = np.exp(-since / self._settling) if self._settling else 1.0 * (start + instants < moment)
            weights *= remaining[:, None].astype(np.float32)
            weights[:, column] = 1 - remaining
        return [shape for _, shape in moves], weights
