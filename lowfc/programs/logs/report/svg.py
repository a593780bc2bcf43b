"""Inline SVG drawings with the page's colours, so that one drawing serves light, dark and printed pages."""

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lowfc.adapters.files.drawing import figure_class, lay_out
from lowfc.programs.logs.report.results import Report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {
    "ink": "#010203",
    "faint": "#a1a2a3",
    "open": "#e69f01",
    "closed": "#0072b3",
    "error": "#d55e01",
    "other": "#009e74",
    "another": "#cc79a8",
    "safe": "#7f3c8e",
    "paper": "#fcfbfa",
}
"""Placeholders, replaced by the page's variables of these names; most hues are near Okabe and Ito's palette, safe for
colour blindness. Open loop has one colour in all drawings, closed loop another."""

_STYLE: Any = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.edgecolor": COLOURS["faint"],
    "axes.labelcolor": COLOURS["ink"],
    "axes.titlesize": 10.0,
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": COLOURS["faint"],
    "grid.alpha": 0.35,
    "grid.linewidth": 0.5,
    "text.color": COLOURS["ink"],
    "xtick.color": COLOURS["ink"],
    "ytick.color": COLOURS["ink"],
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "hatch.linewidth": 0.8,
    "path.simplify_threshold": 0.3,
}
_WIDTH_IN = 10.0


def svg(name: str, height_in: float, draw: Callable[["Figure", Report], bool], report: Report) -> str | None:
    """Draw a figure of the page's width; None if `draw` has nothing to draw.

    The SVG has no prologue and no metadata; its identifiers are unique on the page, its colours are the page's.
    """
    figure_type = figure_class()
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    content = io.StringIO()
    with rc_context(_STYLE | {"svg.hashsalt": name}):
        figure = figure_type(figsize=(_WIDTH_IN, height_in), layout="constrained")
        if not draw(figure, report):
            return None
        lay_out(figure, FigureCanvasSVG, figure.dpi)
        figure.savefig(content, format="svg", transparent=True)
    text = content.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(href="|url\()#', rf"\1#{name}-", text)
    for colour, value in COLOURS.items():
        text = text.replace(value, f"var(--{colour})")
    head = rf'<svg viewBox="\1" role="img" aria-label="{name}">'
    return re.sub(r'<svg [^>]*viewBox="([^"]*)"[^>]*>', head, text, count=1)
