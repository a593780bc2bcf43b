"""What each change on the way down bought: python -m benchmarks.road, from the root of the repository."""

import argparse
import sys
import time
from collections.abc import Mapping
from typing import Any

from benchmarks import cells
from benchmarks.command import add_forms, occasion, run_main, say
from benchmarks.road import table
from benchmarks.road.changes import CHANGES, Change, Loop
from benchmarks.road.measure import figures, in_turns
from benchmarks.road.patches import applied
from benchmarks.road.trip import prepared, trip
from lowfc.adapters.clock import sharpen_sleep
from lowfc.contract.configuration import Configuration
from lowfc.programs.latency.command import Camera, _configuration


def main() -> int:
    """The command line; returns its exit status."""
    asked = parser("python -m benchmarks.road", __doc__, seconds=1.5)
    asked.add_argument("--only", nargs="+", metavar="NAME", choices=[one.name for one in CHANGES], help="these changes")
    chosen = asked.parse_args()
    result = measure(chosen)
    say(result, chosen, lambda found: cells.text(table.road(found)), lambda found: cells.markdown(table.road(found)))
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
    add_forms(found)
    return found


def about(asked: argparse.Namespace, program: str) -> dict[str, Any]:
    """Where, when and how something is measured; to be called before."""
    when = occasion(program)
    load_before = when.pop("load_before")
    rules = {"seconds": asked.seconds, "repeats": asked.repeats, "rate_hz": settings().camera.rate_hz}
    return {"settings": rules, **when, "host": {**when["host"], "load_before": load_before}}


def tell(what: str) -> None:
    """Say what runs now; a bar would be a thread, and the next run's process is forked."""
    sys.stderr.write(f"{time.strftime('%H:%M:%S')} {what}\n")


if __name__ == "__main__":
    run_main(main)
