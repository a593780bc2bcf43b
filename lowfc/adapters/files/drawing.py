"""Plots with matplotlib, which is imported only when needed."""

import io
from typing import Any

from lowfc.adapters.process.extras import package_required


def figure_class() -> Any:
    """Return matplotlib's class Figure, which draws without a display.

    Raises:
        ConfigurationError: matplotlib is not installed.
    """
    with package_required("plots require matplotlib", "plots"):
        from matplotlib.figure import Figure
    return Figure


def png(figure: Any, dpi: int = 120) -> bytes:
    """Encode a figure as PNG without matplotlib's version, so that the same figure gives the same file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    content = io.BytesIO()
    lay_out(figure, FigureCanvasAgg, dpi)
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    return content.getvalue()


def lay_out(figure: Any, canvas_class: Any, dpi: float) -> None:
    """Lay out a figure for a class of canvases; otherwise `savefig` draws the figure twice."""
    engine = figure.get_layout_engine()
    if engine is None:
        return
    canvas_class(figure)
    former_dpi, figure.dpi = figure.dpi, dpi
    engine.execute(figure)
    figure.dpi = former_dpi
    figure.set_layout_engine(None)
