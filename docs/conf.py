"""Sphinx: `make docs` builds the site from the pages of this folder into build/docs."""

import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parents[1]))

from lowfc import __version__  # the checkout's
from tools.site import with_built

project = "lowfc"
copyright = "the authors of lowfc, BSD 3-clause"  # noqa: A001  # Sphinx's name
release = version = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
highlight_language = "bash"
default_role = "code"  # of the docstrings, which have single backticks
napoleon_use_ivar = True
autodoc_member_order = "bysource"
suppress_warnings = ["ref.python"]  # ambiguous reference to an attribute that several classes have
html_theme = "pydata_sphinx_theme"
html_title = f"lowfc {release}"
html_copy_source = False
html_static_path = ["style"]
html_css_files = ["site.css"]
html_theme_options = {"show_prev_next": False, "navigation_with_keys": False}

_ARRAY = re.compile(r"~?numpy\.ndarray\[(?:tuple\[.*?\]|~?typing\.Any), ~?numpy\.dtype\[(.*?)\]\]")


def _short(text: str | None) -> str | None:
    """Types of arrays shortened to `array[float64]`: their shapes are in the docstrings."""
    return _ARRAY.sub(lambda found: f"array[{found[1].rpartition('.')[2]}]", text) if text else text


def setup(app: Sphinx) -> None:
    """Put the generated parts of the reference into the pages, and shorten the types of arrays."""

    def read(_app: Sphinx, _name: str, source: list[str]) -> None:
        source[0] = with_built(source[0])

    def signature(*found: object) -> tuple[str | None, str | None]:
        arguments, returned = found[-2:]
        return _short(arguments), _short(returned)  # type: ignore[arg-type]  # texts or none

    app.connect("source-read", read)
    app.connect("autodoc-process-signature", signature)
