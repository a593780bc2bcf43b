"""Sphinx: `make docs` builds the site from the pages of this folder into build/docs."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from lowfc import __version__  # noqa: E402  # the checkout's

project = "lowfc"
copyright = "the authors of lowfc, BSD 3-clause"  # noqa: A001  # Sphinx's name
release = version = __version__
extensions = ["myst_parser"]
myst_heading_anchors = 3
highlight_language = "bash"
html_theme = "pydata_sphinx_theme"
html_title = f"lowfc {release}"
html_copy_source = False
html_theme_options = {
    "show_prev_next": False,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
}
