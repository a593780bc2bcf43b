"""Functions shared by the measurements: description of the host, JSON of a command, tables in Markdown."""

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
Results = dict[str, Any]


def host() -> dict[str, Any]:
    """Properties of the host that the results depend on."""
    properties = provenance()
    return {
        "processor": properties["processor"],
        "processors": int(properties["processors"]),
        "kernel": properties["kernel"],
        "python": properties["python"],
        "virtual": "hypervisor" in Path("/proc/cpuinfo").read_text(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "load_before": round(os.getloadavg()[0], 2),
    }


def json_of(command: str, folder: Path | str = ROOT) -> Results:
    """JSON that a command prints with `--json`, at any exit status: a failed case is a result too.

    Args:
        command: `lowfc ...` or `python -m ...`, as shown on the page.
        folder: working directory.

    Raises:
        RuntimeError: the command printed nothing.
    """
    arguments = shlex.split(command.removeprefix("python -m "))
    completed = subprocess.run(
        [sys.executable, "-m", *arguments, "--json"], cwd=folder, stdout=subprocess.PIPE, text=True, check=False
    )
    if not completed.stdout:
        raise RuntimeError(f"`{command}` ended with {completed.returncode} and printed nothing")
    results: Results = json.loads(completed.stdout)
    return results


ESCAPED = r"\|"  # a bare one would end the cell of a table


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    first, *lines = [f"| {' | '.join(str(cell).replace('|', ESCAPED) for cell in line)} |\n" for line in (head, *rows)]
    return f"{first}{'|---' * len(head)}|\n{''.join(lines)}"


def formatted_table(formats: dict[str, str], rows: Iterable[Results]) -> str:
    """A table in Markdown: heading of each column, and the format of its cells from the results of a row."""
    return markdown([*formats], ([cell.format(**row) for cell in formats.values()] for row in rows))


def provenance_text(name: str, results: Results) -> str:
    """Date, host and commands of a measurement, as a sentence."""
    about = results["host"]
    *first, last = [f"`{command}`" for command in results["commands"]] or [""]
    runs = f", which runs {', '.join(first)}{' and ' if first else ''}{last}" if last else ""
    return f"Measured {host_in_words(about)} by `python -m tools.measure {name}`{runs}."


def host_in_words(about: Results) -> str:
    """Date and host, from the result of `host`."""
    virtual = "a virtual machine, " if about.get("virtual", True) else ""  # older results are of virtual machines
    return (
        f"{about['date']} on {about['processors']} cores of {about['processor']} ({virtual}Linux "
        f"{about['kernel']}, Python {about['python']}, load before: {about['load_before']})"
    )
