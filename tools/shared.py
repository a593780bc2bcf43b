"""What every measurement needs: the host's description, a command's JSON, a table in Markdown."""

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from lowfc.adapters.process.provenance import provenance

ROOT = Path(__file__).parents[1]
Figures = dict[str, Any]


def host() -> dict[str, Any]:
    """What the figures depend on."""
    known = provenance()
    return {
        "processor": known["processor"],
        "processors": int(known["processors"]),
        "kernel": known["kernel"],
        "python": known["python"],
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "load_before": round(os.getloadavg()[0], 2),
    }


def json_of(command: str, folder: Path | str = ROOT) -> Figures:
    """The JSON that a command prints with `--json`, whatever its exit status: a case that failed is a result too.

    Args:
        command: `lowfc ...` or `python -m ...`, as the page shows it.
        folder: where it runs.

    Raises:
        RuntimeError: it printed nothing.
    """
    words = shlex.split(command.removeprefix("python -m "))
    done = subprocess.run(
        [sys.executable, "-m", *words, "--json"], cwd=folder, stdout=subprocess.PIPE, text=True, check=False
    )
    if not done.stdout:
        raise RuntimeError(f"`{command}` ended with {done.returncode} and printed nothing")
    found: Figures = json.loads(done.stdout)
    return found


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    first, *lines = [f"| {' | '.join(map(str, line))} |\n" for line in (head, *rows)]
    return f"{first}{'|---' * len(head)}|\n{''.join(lines)}"


def columns(formats: dict[str, str], rows: Iterable[Figures]) -> str:
    """A table in Markdown: the head of each column, and how its cells are made of the figures of a row."""
    return markdown([*formats], ([cell.format(**row) for cell in formats.values()] for row in rows))


def where(name: str, figures: Figures) -> str:
    """When a measurement was made, on which host, and by which commands."""
    about = figures["host"]
    *most, last = [f"`{command}`" for command in figures["commands"]] or [""]
    runs = f", which runs {', '.join(most)}{' and ' if most else ''}{last}" if last else ""
    return f"Measured {of_host(about)} by `python -m tools.measure {name}`{runs}."


def of_host(about: Figures) -> str:
    """When and on which host, from what `host` found."""
    return (
        f"{about['date']} on {about['processors']} cores of {about['processor']} (a virtual machine, Linux "
        f"{about['kernel']}, Python {about['python']}, load {about['load_before']} before)"
    )
