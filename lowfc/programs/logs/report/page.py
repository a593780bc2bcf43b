"""The report's self-contained HTML page, made from results and drawings."""

from collections.abc import Callable, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import tomli_w

from lowfc.adapters.files.drawing import figure_class
from lowfc.adapters.process.extras import package_required
from lowfc.contract.printable import LINES, printable
from lowfc.programs.cli.contrast import added_contrast_in_words
from lowfc.programs.logs.report.drawings import drawings
from lowfc.programs.logs.report.results import Report

NOT_IN_LOG = "not in this log"
"""Text in place of a missing number."""


def page(report: Report, progress: Callable[[str], None] = lambda name: None) -> str:
    """HTML that needs no other file and no network."""
    configuration = report.results["run"]["configuration"]
    added = report.results["residual"]["added_contrast"]
    text: str = _template().render(
        **report.results,
        contrast_in_words=added_contrast_in_words(added) if added is not None else "",
        drawings=drawings(report, progress),
        toml=tomli_w.dumps(configuration) if configuration is not None else None,
    )
    return text


def require_page() -> None:
    """Raise an error if the page cannot be made for lack of a package; called before the log is read."""
    with package_required("the HTML page, unlike --json, requires jinja2", "plots"):
        import jinja2  # noqa: F401
    figure_class()


def number(value: float | str | None, digits: int = 3) -> str:
    """A number in running text with at least this many significant digits, its integer part whole; or `NOT_IN_LOG`."""
    if value is None:
        return NOT_IN_LOG
    if isinstance(value, str | int):
        return str(value)
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if abs(float(text)) >= 10**digits else text


def fixed(value: float | str, decimals: int = 3) -> str:
    """A number in a column with this number of decimals; a positive number that rounds to zero is "< 0.001"."""
    if isinstance(value, str | int):
        return str(value)
    least = 10.0**-decimals
    return f"< {least:.{decimals}f}" if 0 < value < least / 2 else f"{value:.{decimals}f}"


def per_mode(values: Sequence[float]) -> str:
    """The value of each mode with four significant digits, or a single value if all are equal."""
    shown = [f"{value:.4g}" for value in values]
    return f"{shown[0]} for all" if len(set(shown)) == 1 else ", ".join(shown)


@cache
def _template() -> Any:
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.finalize = lambda value: printable(value, keep=LINES) if type(value) is str else value  # keeps Markup
    environment.filters |= {"n": number, "fixed": fixed, "per_mode": per_mode}
    return environment.from_string((files("lowfc") / "data" / "report.html").read_text(encoding="utf-8"))
