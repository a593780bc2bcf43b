"""Progress bars that leave nothing behind."""

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

Counted = Callable[[str, int, int], None]
"""What is being done, how much of it is, and of how much."""


def passing_bar(console: Console, *columns: ProgressColumn) -> Progress:
    """A bar that vanishes at its end, and is not there at all where nobody looks: it would leave an empty line."""
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def reading_bar(console: Console) -> Progress:
    """The same for a file: how much of it has been read."""
    text, time = TextColumn("{task.description}"), TimeRemainingColumn()
    return passing_bar(console, text, BarColumn(), DownloadColumn(), time)


@contextlib.contextmanager
def counting_bar(console: Console, *columns: ProgressColumn) -> Iterator[Counted]:
    """One bar for what is done one after the other; it appears with the first step.

    Args:
        console: where it is drawn.
        columns: beside its description.
    """
    with passing_bar(console, TextColumn("{task.description}"), BarColumn(), *columns) as bar:
        tasks: list[TaskID] = []

        def count(what: str, done: int, total: int) -> None:
            if not tasks:
                tasks.append(bar.add_task(what, total=total))
            bar.update(tasks[0], description=what, completed=done, total=total)

        yield count
