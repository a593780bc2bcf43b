"""Command line, ranges over repeats and tables as text, shared by the benchmarks."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any, Protocol

from rich.console import Console

from lowfc.adapters.process.progress import passing_bar
from lowfc.programs.cli.result import table
from tools.shared import host, markdown

Result = dict[str, Any]
Lines = Sequence[Sequence[str]]
"""A table, its headings first."""
Report = Callable[[str], None]
"""Displays what is being measured."""


class Benchmark(Protocol):
    """A module that measures one thing; its docstring is the help of its command."""

    def options(self, parser: argparse.ArgumentParser) -> None:
        """Add its own options."""

    def measure(self, options: argparse.Namespace, report: Report) -> Result:
        """Measure, and return the object that `--json` prints; a `failed` that is not empty makes the exit status 1."""

    def tables(self, result: Result) -> Sequence[Lines]:
        """Tables of the result."""

    def about(self, result: Result) -> str:
        """Explanation of the tables: conditions and definitions."""


def run(name: str, benchmark: Benchmark, arguments: Sequence[str]) -> int:
    """Run a benchmark from its command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        f"python -m benchmarks {name}",
        description=benchmark.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    benchmark.options(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    if not 0.01 <= options.seconds <= 1e5 or getattr(options, "repeats", 1) < 1:
        parser.error("--seconds must be 0.01 to 100000, --repeats at least 1")
    where = host()
    with passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task(name, total=None)
        result = benchmark.measure(options, lambda what: bar.update(task, description=what))
    text = ["\n".join(table(head, rows)) for head, *rows in benchmark.tables(result)]
    printed = json.dumps({"host": where} | result) if options.json else "\n\n".join([*text, benchmark.about(result)])
    sys.stdout.write(printed + "\n")
    return 1 if result.get("failed") else 0


def in_markdown(benchmark: Benchmark, result: Result) -> str:
    """The result in markdown."""
    return "\n".join([*(markdown(head, rows) for head, *rows in benchmark.tables(result)), benchmark.about(result)])


def add_times(parser: argparse.ArgumentParser, seconds: float, repeats: int | None = None) -> None:
    """Add `--seconds` and, if `repeats` is given, `--repeats`."""
    parser.add_argument("--seconds", type=float, default=seconds, help="duration of each measurement (%(default)g)")
    if repeats is not None:
        parser.add_argument("--repeats", type=int, default=repeats, help="repeats of every measurement (%(default)s)")


def us(value: float) -> str:
    """Microseconds as text; one decimal below 100."""
    return f"{value:.{1 if value < 100 else 0}f}"


def ranged(values: Sequence[float], form: Callable[[float], str] = us) -> str:
    """Median of some repeats, with the lowest and the highest."""
    return f"{form(median(values))} ({form(min(values))} to {form(max(values))})"
