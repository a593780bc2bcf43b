"""Checks of a host or a device as data: a table of them, what each one found, and the report as text or JSON."""

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from typing import Any, Generic, NamedTuple, TypeVar

from lowfc.control.loop.wording import counted

S = TypeVar("S")

_WIDTH = 120  # where there is no terminal


class Status(StrEnum):
    """How a check ended."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    WRONG = "wrong"


_STYLES = {Status.OK: "green", Status.NOTE: "cyan", Status.WARNING: "bold yellow", Status.WRONG: "bold red"}


class Check(NamedTuple):
    """One line of a report.

    Attributes:
        status: wrong breaks the contract; a warning costs something or could not be tried; a note is worth knowing.
        got: what was found.
        advice: what to do about it; empty where there is nothing to do.
        cost: what it costs otherwise.
        name: what was looked at.
        expected: what the contract says.
    """

    status: Status
    got: str
    advice: str = ""
    cost: str = ""
    name: str = ""
    expected: str = ""


Severity = Callable[[str, str], Check]
"""What makes a check of what was found and what to do about it."""


def ok(got: str) -> Check:
    """As it should be."""
    return Check(Status.OK, got)


def note(got: str, advice: str = "", cost: str = "") -> Check:
    """Something worth knowing."""
    return Check(Status.NOTE, got, advice, cost)


def warning(got: str, advice: str = "", cost: str = "") -> Check:
    """Something that costs, or could not be tried."""
    return Check(Status.WARNING, got, advice, cost)


def wrong(got: str, advice: str) -> Check:
    """Something that breaks the contract."""
    return Check(Status.WRONG, got, advice)


def judged(
    name: str, expected: str, good: bool, got: str, advice: str, but: str = "", severity: Severity = wrong
) -> Check:
    """A check by its name: `got` where it is good, else `but`, or the same again, with what to do."""
    check = ok(got) if good else severity(but or got, advice)
    return check._replace(name=name, expected=expected)


class Table(Generic[S]):
    """Checks by name, in the order of the report; each looks at the same thing."""

    def __init__(self) -> None:
        self.looks: dict[str, tuple[Check, Callable[[S], Check | None]]] = {}

    def check(
        self, name: str, expected: str = "", advice: str = "", cost: str = ""
    ) -> Callable[[Callable[[S], Check | None]], Callable[[S], object]]:
        """Enter a function that looks; it returns None where there is nothing to look at.

        Args:
            name: of the check.
            expected: what the contract says.
            advice: what to do, for a warning that does not say it itself.
            cost: what it costs otherwise.
        """

        def enter(look: Callable[[S], Check | None]) -> Callable[[S], object]:
            self.looks[name] = Check(Status.WARNING, "", advice, cost, name, expected), look
            return look

        return enter

    def of(self, seen: S, unknown: tuple[type[Exception], ...] = ()) -> Iterator[Check]:
        """The result of every check; a note where one raises one of these exceptions."""
        for usual, look in self.looks.values():
            try:
                found = look(seen)
            except unknown as fault:
                found = note(f"not known: {fault}")
            if found is not None and found.status is Status.WARNING and not found.advice:
                yield usual._replace(got=found.got)
            elif found is not None:
                yield found._replace(name=usual.name, expected=usual.expected)


def put(
    checks: list[Check], worst_first: tuple[Status, ...], fields: Mapping[str, str], about: dict[str, Any] | None
) -> None:
    """Print a report.

    Args:
        checks: in their order.
        worst_first: statuses that are counted.
        fields: attribute of a check by its key in JSON.
        about: the rest of the JSON object; None for a table.
    """
    ended = Counter(check.status for check in checks)
    if about is not None:
        rows = [{key: getattr(check, attribute) for key, attribute in fields.items()} for check in checks]
        counts = {str(status): ended[status] for status in reversed(worst_first)}
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
    words = [
        f"{ended[status]} {status}" if status in (Status.OK, Status.WRONG) else counted(ended[status], status)
        for status in worst_first
    ]
    console.print(f"\n{', '.join(words)}")
