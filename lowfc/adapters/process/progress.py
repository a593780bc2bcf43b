"""Progress display: bars that disappear at the end or, without a terminal, lines."""

import contextlib
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, ProgressColumn, TaskID, TextColumn, TimeRemainingColumn

ProgressCallback = Callable[[str, int, int], None]
"""Function called with the description of the work, the amount done and the total amount."""
_LINE_PERIOD_S = 10.0


def passing_bar(console: Console, *columns: ProgressColumn) -> Progress:
    """Make a bar that disappears at its end; without a terminal it is not shown, as it would leave an empty line."""
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


@contextlib.contextmanager
def counting_bar(console: Console, *columns: ProgressColumn) -> Iterator[ProgressCallback]:
    """Yield a callback that shows several tasks in turn in one bar, with `columns`; the bar appears at its first call.

    Without a terminal, the callback prints lines: see `progress_lines`.
    """
    if not console.is_terminal:
        yield progress_lines(lambda line: console.print(line, markup=False, highlight=False, soft_wrap=True))
        return
    with passing_bar(console, TextColumn("{task.description}", markup=False), BarColumn(), *columns) as bar:
        tasks: list[TaskID] = []

        def count(what: str, done: int, total: int) -> None:
            if not tasks:
                tasks.append(bar.add_task(what, total=total))
            bar.update(tasks[0], description=what, completed=done, total=total)

        yield count


def percentage_bar(console: Console) -> contextlib.AbstractContextManager[ProgressCallback]:
    """Make a bar like `counting_bar` that shows the amount done in per cent of the total."""
    return counting_bar(console, TextColumn("{task.percentage:.0f} %"), TimeRemainingColumn())


def reading_bar(console: Console) -> contextlib.AbstractContextManager[ProgressCallback]:
    """Make a bar like `counting_bar` that shows the bytes read from a file."""
    return counting_bar(console, DownloadColumn(), TimeRemainingColumn())


def progress_lines(write: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> ProgressCallback:
    """Make a callback for use without a terminal: a line every 10 s with the remaining time; `clock` is in seconds."""
    first = last = -1
    begun = written = 0.0

    def count(what: str, done: int, total: int) -> None:
        nonlocal first, last, begun, written
        now = clock()
        if last < 0:
            written = now
        if last < 0 or done < last:  # a new task
            first = done
        last = done
        if done == first:  # exclude the time before the first progress from the rate
            begun = now
        elif now - written >= _LINE_PERIOD_S:
            written = now
            seconds = (now - begun) / (done - first) * (total - done)
            write(f"{what}: {done / total:.0%}, about {seconds:.0f} s to go")

    return count
