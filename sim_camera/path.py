"""Position of the simulated mirror at any time, from the times of its commands and its settling."""

from collections import deque

import numpy as np

from lowfc.arrays import Array, Single


class MirrorPath:
    """Shapes of the mirror in the order in which they came into force; times are in frame periods."""

    def __init__(self, flat_nm: Single, delay: float = 0.0, settling: float = 0.0) -> None:
        """Begin with a shape (rows, columns), nm of surface.

        Args:
            flat_nm: the first shape, in force since ever.
            delay: by which each shape comes into force later than it was applied.
            settling: time constant of the mirror's first-order response; 0 where a shape is reached at once.
        """
        self._moves: deque[tuple[float, Single]] = deque([(-np.inf, flat_nm)])
        self._delay = delay
        self._settling = settling

    def applied(self, moment: float, shape_nm: Single, latest: float = np.inf) -> None:
        """A shape (rows, columns) was applied, by the `latest` moment; not before the last one."""
        self._moves.append((max(min(moment, latest) + self._delay, self._moves[-1][0]), shape_nm))

    def over(self, start: float, instants: Array) -> tuple[list[Single], Single]:
        """Shapes (rows, columns) in force from `start` on, and how much of each (instants, shapes) is there.

        `instants` (instants,) are after the start. What came into force before is forgotten, but for the last.
        """
        while len(self._moves) > 1 and self._moves[1][0] + 20 * self._settling <= start:
            self._moves.popleft()
        moves = [move for move in self._moves if move[0] < start + 1]
        weights = np.zeros((len(instants), len(moves)), np.float32)
        weights[:, 0] = 1
        ends = [moment for moment, _ in moves[2:]] + [np.inf]
        for row, ((moment, _), end) in enumerate(zip(moves[1:], ends, strict=False), 1):
            since = np.minimum(start + instants, end) - moment
            left = np.exp(-since / self._settling) if self._settling else np.zeros(len(instants))
            left = np.where(start + instants < moment, 1.0, left)
            weights *= left[:, None].astype(np.float32)
            weights[:, row] = 1 - left
        return [shape for _, shape in moves], weights
