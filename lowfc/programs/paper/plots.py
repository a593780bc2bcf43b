"""Plots of the figures as PNG files; matplotlib is imported only when something is plotted."""

from collections.abc import Callable, Sequence
from math import ceil
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from lowfc.adapters.files.drawing import figure_class, png
from lowfc.adapters.files.whole_file import write_whole
from lowfc.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Scale = Literal["log", "linear", "signed"]

SKY_UNIT = r"$\lambda$/D"
SKY = (f"x, {SKY_UNIT}", f"y, {SKY_UNIT}")
PUPIL = ("x, pupil diameters", "y, pupil diameters")

# Okabe and Ito's colours, which colour-blind readers can distinguish; curves also differ in line style or marker.
_COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442")
_STYLES = ("-", "--", "-.", ":")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_MAPS = {"log": "inferno", "linear": "inferno", "signed": "PuOr_r"}
_PANEL_IN = (3.6, 3.3)  # width and height of a panel, inches
_DPI = 110


class Line(NamedTuple):
    """Points (n,) with a name, joined by a line or drawn as markers."""

    name: str
    x: Array
    y: Array
    joined: bool = True


Panel = Callable[["Figure", "Axes"], None]
"""Function that draws a panel into its axes."""


def draw(path: Path, panels: Sequence[Panel], caption: str, columns: int = 3, wide: bool = False) -> None:
    """Draw panels in rows with a caption below, as a PNG file; `wide` panels have one and a half times the width."""
    figure_type = figure_class()
    columns = min(columns, len(panels))
    rows = ceil(len(panels) / columns)
    width = columns * _PANEL_IN[0] * (1.5 if wide else 1.0)
    text = fill(caption, int(width * 16))
    height = rows * _PANEL_IN[1]
    below = 0.2 * (text.count("\n") + 1) + 0.1
    figure = figure_type(figsize=(width, height + below), dpi=_DPI, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.1, rect=(0, below / (height + below), 1, height / (height + below)))
    for i, panel in enumerate(panels):
        axes = figure.add_subplot(rows, columns, i + 1)
        axes.tick_params(labelsize=8)
        panel(figure, axes)
    figure.text(0.01, 0.005, text, fontsize=8, va="bottom")
    write_whole(path, png(figure, _DPI))


def picture(
    values: Array,
    title: str,
    labels: tuple[str, str],
    half_width: float,
    bounds: tuple[float, float],
    unit: str,
    scale: Scale = "linear",
) -> Panel:
    """An image (rows, columns) with a colour bar; NaN is grey. `half_width` is in the unit of the axes."""

    def panel(figure: "Figure", axes: "Axes") -> None:
        image = axes.imshow(
            np.maximum(values, bounds[0]) if scale == "log" else values,
            cmap=_MAPS[scale],
            norm="log" if scale == "log" else "linear",
            vmin=bounds[0],
            vmax=bounds[1],
            origin="lower",
            extent=(-half_width, half_width, -half_width, half_width),
            interpolation="nearest",
        )
        axes.set_facecolor("0.75")
        _label(axes, title, *labels)
        bar = figure.colorbar(image, ax=axes, shrink=0.85)
        bar.set_label(unit, fontsize=8)
        bar.ax.tick_params(labelsize=7)

    return panel


def curves(
    lines: Sequence[Line],
    title: str,
    x_label: str,
    y_label: str,
    scale: Literal["log", "linear"] = "linear",
    y_bounds: tuple[float, float] | None = None,
    ticks: Sequence[str] = (),
    diagonal: bool = False,
    legend: Literal["upper right", "upper left", "lower left"] = "upper right",
) -> Panel:
    """Lines in one pair of axes; `ticks` are the labels at x = 0, 1, 2 and so on."""

    def panel(_: "Figure", axes: "Axes") -> None:
        if diagonal:
            ends = [min(line.x.min() for line in lines), max(line.x.max() for line in lines)]
            axes.plot(ends, ends, color="0.6", linewidth=1, zorder=0)
        for i, line in enumerate(lines):
            colour, marker = _COLOURS[i % len(_COLOURS)], _MARKERS[i % len(_MARKERS)]
            style = _STYLES[(i + i // len(_COLOURS)) % len(_STYLES)]
            if line.joined:
                axes.plot(line.x, line.y, style, color=colour, label=line.name, linewidth=1.3)
            else:
                axes.plot(line.x, line.y, marker, color=colour, label=line.name, markersize=3, alpha=0.7)
        axes.set_yscale(scale)
        _label(axes, title, x_label, y_label)
        axes.grid(alpha=0.3)
        if y_bounds is not None:
            axes.set_ylim(y_bounds)
        if ticks:
            axes.set_xticks(range(len(ticks)), ticks)
        else:
            axes.locator_params(axis="x", nbins=4)
        if len(lines) > 1:
            axes.legend(fontsize=7, loc=legend, ncols=1 + len(lines) // 8)

    return panel


def bars(heights: dict[str, Array], groups: Sequence[str], title: str, y_label: str) -> Panel:
    """Groups of bars side by side: heights (groups,) by name."""

    def panel(_: "Figure", axes: "Axes") -> None:
        width = 0.8 / len(heights)
        places = np.arange(len(groups))
        for i, (name, each) in enumerate(heights.items()):
            middles = places + (i - (len(heights) - 1) / 2) * width
            axes.bar(middles, each, width, label=name, color=_COLOURS[1 + i], edgecolor="black", linewidth=0.4)
        axes.set_xticks(places, groups)
        _label(axes, title, "", y_label)
        axes.axhline(0, color="black", linewidth=0.8)
        axes.grid(axis="y", alpha=0.3)
        axes.legend(fontsize=7)

    return panel


def _label(axes: "Axes", title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
