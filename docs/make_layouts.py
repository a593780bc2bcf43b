"""Write the layouts for rerun to deploy/layouts: `python docs/make_layouts.py`; a test holds that they are these."""

from pathlib import Path

from lowfc.programs.view.layout import APPLICATION, layout
from lowfc.programs.view.message_layout import message_layout

LAYOUTS = Path(__file__).parents[1] / "deploy" / "layouts"


def main() -> None:
    """Both of them."""
    layout().save(APPLICATION, LAYOUTS / "lowfc.rbl")
    message_layout().save(APPLICATION, LAYOUTS / "log.rbl")


if __name__ == "__main__":
    main()
