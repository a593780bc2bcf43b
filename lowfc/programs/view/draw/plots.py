"""Plots on a rerun stream, all on one timeline: curves against time, and plots with custom axes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from rerun.components import AggregationPolicy

from lowfc.arrays import Array, Long
from lowfc.programs.view.draw.colours import WHITE, Colour

TIMELINE = "time"
BOX_HEIGHT = 90.0
"""Height of a plot with custom axes, in units of its view."""
LABEL = 5.0
"""Distance by which the viewer draws a label below its position, in a box of `BOX_HEIGHT`."""

Ticks = Sequence[tuple[float, str]]
"""Values and their labels."""


def at(stream: rr.RecordingStream, time_ns: int) -> None:
    """Set the time of the data logged next."""
    stream.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"))


def labels(positions: npt.ArrayLike, texts: Sequence[str], colours: Sequence[Colour] = (WHITE,)) -> rr.Points2D:
    """Labels at positions (labels, 2); the viewer draws them a little lower."""
    return rr.Points2D(positions, radii=0.0, colors=colours, labels=texts, show_labels=True)


@dataclass(frozen=True, slots=True)
class Plot:
    """Curves against time: `curves` has the name and colour of each; the last curve is drawn on top.

    `curves` is empty if the names depend on the run. If `legend` is None, the viewer chooses its position.
    """

    path: str
    title: str = ""
    curves: Mapping[str, Colour] = field(default_factory=dict)
    width: float = 1.2
    legend: rrb.Corner2D | rrb.PlotLegend | None = rrb.Corner2D.LeftTop

    def name(self, stream: rr.RecordingStream, curves: Mapping[str, Colour] | None = None) -> None:
        """Send the names and colours of the curves, for all times; by default those of `self.curves`."""
        named = self.curves if curves is None else curves
        style = rr.SeriesLines(
            names=list(named),
            colors=list(named.values()),
            widths=[self.width] * len(named),
            aggregation_policy=AggregationPolicy.MinMax,  # keeps the peaks if a pixel has many rows
        )
        stream.log(self.path, style, static=True)

    def add(self, stream: rr.RecordingStream, times_ns: Long, values: npt.NDArray[np.floating]) -> None:
        """Add values (rows,) or (rows, curves) in one message; successive rows that are not finite become one gap."""
        if not len(times_ns):
            return
        columns = values.reshape(len(times_ns), -1)
        finite = np.isfinite(columns).all(axis=1)
        kept = finite | np.concatenate([[True], finite[:-1]])
        times, columns = times_ns[kept], columns[kept]
        scalars = rr.Scalars.columns(scalars=columns.astype(np.float64).ravel())
        stream.send_columns(
            self.path,
            indexes=[rr.TimeColumn(TIMELINE, timestamp=times.view("datetime64[ns]"))],
            columns=scalars.partition([columns.shape[1]] * len(times)),
        )

    def add_one(self, stream: rr.RecordingStream, time_ns: int, *values: float) -> None:
        """Add one row."""
        self.add(stream, np.array([time_ns]), np.array([values], np.float64))

    def view(self, **options: Any) -> rrb.TimeSeriesView:
        """View of the plot for a layout, with further options of the viewer."""
        return rrb.TimeSeriesView(**({"origin": self.path, "name": self.title, "plot_legend": self.legend} | options))


class Axes:
    """A box with linear axes and any ticks; rerun's plots have no such ticks, and drop the oldest points."""

    def __init__(self, path: str, width: float) -> None:
        self.path = path
        self._width = width
        self._x, self._y = (0.0, 1.0), (0.0, 1.0)
        self._fitted: object = None
        self._named: object = None

    def fit(
        self, stream: rr.RecordingStream, x: tuple[float, float], y: tuple[float, float], x_ticks: Ticks, y_ticks: Ticks
    ) -> None:
        """Set the first and last value of each axis and its ticks; the grid is redrawn only if they change."""
        fitted = x, y, tuple(x_ticks), tuple(y_ticks)
        if fitted == self._fitted:
            return
        self._x, self._y, self._fitted = x, y, fitted
        width, height = self._width, BOX_HEIGHT
        columns = [float(self.positions([value], [y[0]])[0, 0]) for value, _ in x_ticks]
        rows = [float(self.positions([x[0]], [value])[0, 1]) for value, _ in y_ticks]
        box = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]])
        lines = [box, *(np.array([[at_x, 0], [at_x, height]]) for at_x in columns)]
        lines += [np.array([[0, at_y], [width, at_y]]) for at_y in rows]
        grid = rr.LineStrips2D(lines, colors=[(70, 72, 80)], radii=rr.Radius.ui_points(0.5), draw_order=-1.0)
        stream.log(f"{self.path}/grid", grid)
        positions = [(at_x, height + 1) for at_x in columns] + [(-11.0, at_y - LABEL) for at_y in rows]
        stream.log(f"{self.path}/ticks", labels(positions, [label for _, label in (*x_ticks, *y_ticks)]))

    def name(self, stream: rr.RecordingStream, names: Sequence[str], colours: Sequence[Colour]) -> None:
        """Draw the names of the curves above the box when they change."""
        if names != self._named:
            self._named = names
            positions = [(self._width * (number + 0.5) / len(names), -LABEL - 7) for number in range(len(names))]
            stream.log(f"{self.path}/names", labels(positions, names, colours))

    def draw(
        self,
        stream: rr.RecordingStream,
        x: Array,
        curves: Sequence[Array],
        colours: Sequence[Colour],
        widths: Sequence[float],
    ) -> None:
        """Draw curves over x, the last one on top, with gaps where they are not finite."""
        strips: list[tuple[Array, Colour, float]] = []
        for y, colour, width in zip(curves, colours, widths, strict=False):
            for piece in np.ma.clump_unmasked(np.ma.masked_invalid(y)):  # type: ignore[no-untyped-call]
                points = self.positions(x[piece], y[piece])
                strips.append((points if len(points) > 1 else np.repeat(points, 2, axis=0), colour, width))
        positions, shades, line_widths = zip(*strips, strict=True) if strips else ((), (), ())
        radii = rr.Radius.ui_points(list(line_widths))
        stream.log(f"{self.path}/curves", rr.LineStrips2D(positions, colors=list(shades), radii=radii))

    def positions(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Array:
        """Positions of values (points, 2) in the view, whose y axis points down."""
        share_x = (np.asarray(x, np.float64) - self._x[0]) / (self._x[1] - self._x[0])
        share_y = (np.asarray(y, np.float64) - self._y[0]) / (self._y[1] - self._y[0])
        return np.stack([self._width * share_x, BOX_HEIGHT * (1 - share_y)], axis=1)


def bounds(width: float) -> rrb.VisualBounds2D:
    """Bounds of the view of a box of this width with its labels and names."""
    return rrb.VisualBounds2D(x_range=[-20, width + 8], y_range=[-17, BOX_HEIGHT + 11])
