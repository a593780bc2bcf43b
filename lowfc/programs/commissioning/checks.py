"""Tables of checks of a host or a device, results of checks, and the report as text or JSON."""

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from typing import Any, Generic, NamedTuple, TypeVar

from lowfc.control.loop.wording import counted

S = TypeVar("S")

_WIDTH = 120  # columns of a report that is not printed on a terminal


class Status(StrEnum):
    """Result of a check."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    WRONG = "wrong"


_STYLES = {Status.OK: "green", Status.NOTE: "cyan", Status.WARNING: "bold yellow", Status.WRONG: "bold red"}


class Check(NamedTuple):
    """One line of a report.

    Attributes:
        status: wrong: the contract is violated; warning: there is a cost, or no test was possible; note: information.
        got: result of the check.
        advice: recommended action; empty if none is needed.
        cost: consequence of ignoring the advice.
        name: name of the check.
        expected: requirement of the contract.
    """

    status: Status
    got: str
    advice: str = ""
    cost: str = ""
    name: str = ""
    expected: str = ""


Severity = Callable[[str, str], Check]
"""`note`, `warning` or `wrong`: makes a Check from a result and advice."""


def ok(got: str) -> Check:
    """A check that passed."""
    return Check(Status.OK, got)


def note(got: str, advice: str = "", cost: str = "") -> Check:
    """A result for information."""
    return Check(Status.NOTE, got, advice, cost)


def warning(got: str, advice: str = "", cost: str = "") -> Check:
    """A result that has a cost, or a check that could not be carried out."""
    return Check(Status.WARNING, got, advice, cost)


def wrong(got: str, advice: str) -> Check:
    """A violation of the contract."""
    return Check(Status.WRONG, got, advice)


def judged(
    name: str, expected: str, good: bool, got: str, advice: str, got_if_bad: str = "", severity: Severity = wrong
) -> Check:
    """A named check: `ok(got)` if good, otherwise `severity(got_if_bad or got, advice)`."""
    check = ok(got) if good else severity(got_if_bad or got, advice)
    return check._replace(name=name, expected=expected)


class Table(Generic[S]):
    """Checks by name, in the order of the report; all examine the same subject."""

    def __init__(self) -> None:
        self.functions: dict[str, tuple[Check, Callable[[S], Check | None]]] = {}

    def check(
        self, name: str, expected: str = "", advice: str = "", cost: str = ""
    ) -> Callable[[Callable[[S], Check | None]], Callable[[S], object]]:
        """Register a check function, which returns None if the check does not apply.

        Args:
            name: Name of the check.
            expected: Requirement of the contract.
            advice: Recommended action, for each warning in which the function names none.
            cost: Consequence of ignoring this advice.
        """

        def register(function: Callable[[S], Check | None]) -> Callable[[S], object]:
            self.functions[name] = Check(Status.WARNING, "", advice, cost, name, expected), function
            return function

        return register

    def run(self, subject: S, read_errors: tuple[type[Exception], ...] = ()) -> Iterator[Check]:
        """Run every check on `subject`; a check that raises one of `read_errors` gives the note "not known"."""
        for template, function in self.functions.values():
            try:
                result = function(subject)
            except read_errors as fault:
                result = note(f"not known: {fault}")
            if result is not None and result.status is Status.WARNING and not result.advice:
                yield template._replace(got=result.got)
            elif result is not None:
                yield result._replace(name=template.name, expected=template.expected)


def print_report(
    checks: list[Check], worst_first: tuple[Status, ...], fields: Mapping[str, str], about: dict[str, Any] | None
) -> None:
    """Print a report.

    Args:
        checks: The results, in the order of the report.
        worst_first: Statuses to count, the worst first.
        fields: Attribute of a check by JSON key.
        about: Other members of the JSON object; None for a text table.
    """
    numbers = Counter(check.status for check in checks)
    if about is not None:
        rows = [{key: getattr(check, attribute) for key, attribute in fields.items()} for check in checks]
        counts = {str(status): numbers[status] for status in reversed(worst_first)}
        sys.stdout.write(json.dumps({"checks": rows, "counts": counts} | about) + "\n")
        return
    from rich.console import Console
    from rich.table import Table as Grid
    from rich.text import Text

    grid = Grid.grid(padding=(0, 2))
    for check in checks:
        grid.add_row(Text(check.status, style=_STYLES[check.status]), Text(check.name), Text(check.got))
        if check.advice:
            for label, text in (("expected", check.expected), ("to do", check.advice), ("otherwise", check.cost)):
                if text:
                    style = "" if label == "to do" else "dim"
                    grid.add_row("", Text(label, style="dim", justify="right"), Text(text, style=style))
    console = Console(width=None if sys.stdout.isatty() else _WIDTH, highlight=False)
    console.print(grid)
    totals = [
        f"{numbers[status]} {status}" if status in (Status.OK, Status.WRONG) else counted(numbers[status], status)
        for status in worst_first
    ]
    console.print(f"\n{', '.join(totals)}")
