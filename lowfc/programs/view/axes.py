"""A plot with axes of its own, in a view that has none: rerun's plots have no logarithmic axis, and forget."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import rerun as rr

from lowfc.programs.view.marks import words

LABEL = 5.0
"""By which the viewer sets a label below its place, for a box 90 high."""

Double = npt.NDArray[np.float64]
Ticks = Sequence[tuple[float, str]]
"""Values and their labels."""


class Axes:
    """A box of some width and height, whose axes are linear in what is given; the grid is drawn where it changes."""

    def __init__(self, path: str, width: float, height: float) -> None:
        self.path = path
        self._width, self._height = width, height
        self._x, self._y = (0.0, 1.0), (0.0, 1.0)
        self._drawn: object = None

    def fit(
        self,
        stream: rr.RecordingStream,
        x: tuple[float, float],
        y: tuple[float, float],
        x_ticks: Ticks,
        y_ticks: Ticks,
    ) -> None:
        """Span from the first to the second value of each."""
        wanted = x, y, tuple(x_ticks), tuple(y_ticks)
        if wanted != self._drawn:
            self._x, self._y, self._drawn = x, y, wanted
            self._draw_grid(stream, x_ticks, y_ticks)

    def places(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Double:
        """Where values are (points, 2) on the view; upwards is downwards there."""
        share_x = (np.asarray(x, np.float64) - self._x[0]) / (self._x[1] - self._x[0])
        share_y = (np.asarray(y, np.float64) - self._y[0]) / (self._y[1] - self._y[0])
        return np.stack([self._width * share_x, self._height * (1 - share_y)], axis=1)

    def _draw_grid(self, stream: rr.RecordingStream, x_ticks: Ticks, y_ticks: Ticks) -> None:
        width, height = self._width, self._height
        columns = [float(self.places([value], [self._y[0]])[0, 0]) for value, _ in x_ticks]
        rows = [float(self.places([self._x[0]], [value])[0, 1]) for value, _ in y_ticks]
        box = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]])
        lines = [box, *(np.array([[at_x, 0], [at_x, height]]) for at_x in columns)]
        lines += [np.array([[0, at_y], [width, at_y]]) for at_y in rows]
        grid = rr.LineStrips2D(lines, colors=[(70, 72, 80)], radii=rr.Radius.ui_points(0.5), draw_order=-1.0)
        stream.log(f"{self.path}/grid", grid)
        places = [(at_x, height + 1) for at_x in columns] + [(-11.0, at_y - LABEL) for at_y in rows]
        stream.log(f"{self.path}/ticks", words(places, [label for _, label in (*x_ticks, *y_ticks)]))
