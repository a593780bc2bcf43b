"""What each change on the way down bought: python -m benchmarks.road, from the root of the repository."""

import argparse
import json
import os
import shlex
import sys
import time
from collections.abc import Mapping
from typing import Any

from benchmarks import cells
from benchmarks.command import run_main
from benchmarks.host import host
from benchmarks.road import table
from benchmarks.road.changes import CHANGES, Change, Loop
from benchmarks.road.measure import figures, in_turns
from benchmarks.road.patches import applied
from benchmarks.road.trip import prepared, trip
from lowfc.adapters.clock import sharpen_sleep
from lowfc.contract.configuration import Configuration
from lowfc.programs.latency import Camera, _configuration


def main() -> int:
    """The command line; returns its exit status."""
    asked = parser("python -m benchmarks.road", __doc__, seconds=1.5)
    asked.add_argument("--only", nargs="+", metavar="NAME", choices=[one.name for one in CHANGES], help="these changes")
    chosen = asked.parse_args()
    result = measure(chosen)
    say(result, table.road(result), chosen)
    return 0


def measure(asked: argparse.Namespace) -> dict[str, Any]:
    """Try the changes that the command line asks for; the object that --json prints."""
    changes = [one for one in CHANGES if not asked.only or one.name in asked.only]
    for change in changes:
        if change.patches:
            with applied(change.patches):  # before the work, where there is nothing to replace
                pass
    result = about(asked, "python -m benchmarks.road")
    sharpen_sleep()
    with prepared(settings()) as run:

        def travel(change: Change | None, loop: Loop) -> Mapping[str, Any]:
            tell(f"{change.name}, {loop}" if change is not None else loop)
            keys, variables = ({}, loop.variables) if change is None else (change.keys, change.variables)
            return trip(run, asked.seconds, keys, variables, record=loop is Loop.RECORDING)

        tried = in_turns(changes, asked.repeats, travel)
    granted: list[str] = next((pair[0]["granted"] for one in tried for pair in one.neighbours), [])
    return result | {"granted": granted, "changes": [figures(one) for one in tried]}


def settings(*, plain: bool = False) -> Configuration:
    """Of `lowfc latency` as it is, or with --plain-scheduling."""
    return _configuration(None, None, Camera.PREPARED, plain=plain)


def parser(program: str, what: str | None, seconds: float) -> argparse.ArgumentParser:
    """What both command lines have."""
    found = argparse.ArgumentParser(program, description=what)
    found.add_argument("--seconds", type=float, default=seconds, help="measured of each run (%(default)g)")
    found.add_argument("--repeats", type=int, default=5, help="(%(default)s)")
    found.add_argument("--json", action="store_true", help="print one JSON object")
    found.add_argument("--markdown", action="store_true", help="print the table in Markdown")
    return found


def about(asked: argparse.Namespace, program: str) -> dict[str, Any]:
    """Where, when and how something is measured; to be called before."""
    return {
        "settings": {
            "seconds": asked.seconds,
            "repeats": asked.repeats,
            "rate_hz": settings().camera.rate_hz,
        },
        "host": {**host(), "load_before": round(os.getloadavg()[0], 2)},
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "command": shlex.join([*program.split(), *sys.argv[1:]]),
    }


def say(result: Mapping[str, Any], lines: cells.Lines, asked: argparse.Namespace) -> None:
    """Print what was measured, its table being `lines`."""
    table_of = cells.markdown if asked.markdown else cells.text
    sys.stdout.write((json.dumps(result) if asked.json else table_of(lines)) + "\n")


def tell(what: str) -> None:
    """Say what runs now; a bar would be a thread, and the next run's process is forked."""
    sys.stderr.write(f"{time.strftime('%H:%M:%S')} {what}\n")


if __name__ == "__main__":
    run_main(main)
