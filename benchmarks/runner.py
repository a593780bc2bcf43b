"""What the benchmarks share: options, where and when something is measured, ranges, tables, JSON."""

import argparse
import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Protocol

from rich.console import Console

from lowfc.adapters.process.host import Host
from lowfc.adapters.process.progress import passing_bar
from lowfc.adapters.process.provenance import provenance

Result = dict[str, Any]
Lines = Sequence[Sequence[str]]
"""A table, its headings first."""
Tell = Callable[[str], None]
"""Shows what is measured now."""


class Benchmark(Protocol):
    """A module that measures one thing; its docstring is the help of its command."""

    def options(self, parser: argparse.ArgumentParser) -> None:
        """Add its own options."""

    def measure(self, asked: argparse.Namespace, tell: Tell) -> Result:
        """Measure; what `--json` prints. A `failed` in it that is not empty makes the exit status 1."""

    def tables(self, result: Result) -> Sequence[Lines]:
        """Lay the figures out."""

    def about(self, result: Result) -> str:
        """What the tables do not say; without where and when."""


def run(name: str, benchmark: Benchmark, words: Sequence[str]) -> int:
    """Run one from its command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        f"python -m benchmarks {name}",
        description=benchmark.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    benchmark.options(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--markdown", action="store_true", help="print the tables in Markdown")
    parser.add_argument("--render", type=Path, metavar="FILE.json", help="measure nothing: print what this file has")
    asked = parser.parse_args(words)
    if asked.render:
        result = json.loads(asked.render.read_text())
    else:
        begun = occasion(["python", "-m", "benchmarks", name, *words])
        with passing_bar(Console(stderr=True)) as bar:
            task = bar.add_task(name, total=None)
            result = begun | benchmark.measure(asked, lambda what: bar.update(task, description=what))
    sys.stdout.write((json.dumps(result) if asked.json else said(benchmark, result, markdown=asked.markdown)) + "\n")
    return 1 if result.get("failed") else 0


def add_times(parser: argparse.ArgumentParser, seconds: float, repeats: int | None = None) -> None:
    """Add the options for how long and, where there are repeats, how often."""
    parser.add_argument("--seconds", type=float, default=seconds, help="of each measurement (%(default)g)")
    if repeats is not None:
        parser.add_argument("--repeats", type=int, default=repeats, help="of everything (%(default)s)")


def occasion(command: Sequence[str]) -> Result:
    """Where, when and by which command something is measured; to be asked for before."""
    return {
        "host": host(),
        "load_before": round(os.getloadavg()[0], 2),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "command": shlex.join(command),
    }


def host() -> Result:
    """What figures of time depend on."""
    known = provenance()
    try:
        clock_source = Host().clock_source()
    except OSError:
        clock_source = "not known"
    found = {name: known[name] for name in ("processor", "kernel", "python")}
    return found | {"processors": int(known["processors"]), "clock_source": clock_source}


def said(benchmark: Benchmark, result: Result, *, markdown: bool) -> str:
    """The whole result for a document or a terminal."""
    form = in_markdown if markdown else in_columns
    parts = [*map(form, benchmark.tables(result)), benchmark.about(result)]
    if "date" in result:
        where = result["host"]
        parts[-1] += (
            f" Measured {result['date']} on {where['processors']} processors of {where['processor']}, Linux "
            f"{where['kernel']}, clock source {where['clock_source']}, Python {where['python']}, load "
            f"{result['load_before']:g} before, by `{result['command']}`."
        )
    return "\n\n".join(parts)


def in_columns(lines: Lines) -> str:
    """A table for a terminal: the first column and words to the left, figures to the right."""
    columns = list(zip(*lines, strict=True))
    widths = [max(map(len, column)) for column in columns]
    figures = [any(cell[:1].isdigit() for cell in column[1:]) for column in columns]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if column and figures[column] else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def in_markdown(lines: Lines) -> str:
    """The same for a document; a bar within a cell becomes a slash."""
    first, *others = (f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)
    return "\n".join([first, "|---" * len(lines[0]) + "|", *others])


def us(value: float) -> str:
    """Microseconds, three digits or more."""
    return f"{value:.{1 if value < 100 else 0}f}"


def ranged(values: Sequence[float], form: Callable[[float], str] = us) -> str:
    """Median of some repeats, with the lowest and the highest."""
    return f"{form(median(values))} ({form(min(values))} to {form(max(values))})"
