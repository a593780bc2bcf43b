"""Pictures as PNG files; matplotlib is loaded only where something is drawn."""

import io
from typing import Any

from lowfc.adapters.process.extras import install_advice
from lowfc.contract.errors import ConfigurationError


def figure_class() -> Any:
    """Matplotlib's Figure, which draws without a screen.

    Raises:
        ConfigurationError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigurationError(
            f"plots need matplotlib, which is not there ({error}); install it with: {install_advice('plots')}"
        ) from None
    return Figure


def png(figure: Any, dpi: int = 120) -> bytes:
    """A figure as PNG, without the version of what drew it: the same figure is the same file."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    return content.getvalue()
