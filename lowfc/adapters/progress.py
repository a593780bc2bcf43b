"""Progress bars that leave nothing behind."""

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn


def passing_bar(console: Console, *columns: ProgressColumn) -> Progress:
    """A bar that vanishes at its end, and is not there at all where nobody looks: it would leave an empty line."""
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def reading_bar(console: Console) -> Progress:
    """The same for a file: how much of it has been read."""
    text, time = TextColumn("{task.description}"), TimeRemainingColumn()
    return passing_bar(console, text, BarColumn(), DownloadColumn(), time)
