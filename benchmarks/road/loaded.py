"""The loop with its real-time set-up and without, on a quiet host and a busy one: python -m benchmarks.road.loaded."""

import argparse
import contextlib
import itertools
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import cells
from benchmarks.command import run_main, say
from benchmarks.road import table
from benchmarks.road.__main__ import about, parser, settings, tell
from benchmarks.road.load import WHAT, background
from benchmarks.road.measure import course
from benchmarks.road.trip import DUE, PERCENTILES, TripError, prepared, trip
from lowfc.adapters.clock import sharpen_sleep
from lowfc.adapters.run import Run

KINDS = tuple(itertools.product((True, False), (False, True)))
"""With the load or without; without the real-time set-up or with; in the order of a repeat."""


def main() -> int:
    """The command line; returns its exit status."""
    asked = parser("python -m benchmarks.road.loaded", __doc__, seconds=5.0).parse_args()
    result = measure(asked)
    say(
        result,
        asked,
        lambda found: f"{cells.text(table.loaded(found))}\n\n{table.ratios(found)}",
        lambda found: f"{cells.markdown(table.loaded(found))}\n\n{table.ratios(found)}",
    )
    return 0


def measure(asked: argparse.Namespace) -> dict[str, Any]:
    """Every kind of run in turns; the object that --json prints."""
    result = about(asked, "python -m benchmarks.road.loaded")
    plain = {f"realtime.{key}": value for key, value in settings(plain=True).realtime.model_dump().items()}
    sharpen_sleep()
    runs: dict[tuple[bool, bool], list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    with prepared(settings()) as run:
        for _, (load, bare) in itertools.product(range(asked.repeats), KINDS):
            tell(f"{'loaded' if load else 'quiet'}, {'plain scheduling' if bare else 'real time'}")
            runs[load, bare].append(_run(run, asked.seconds, plain if bare else {}, load=load))
    return result | figures(runs)


def _run(run: Run, seconds: float, keys: Mapping[str, Any], *, load: bool) -> dict[str, Any]:
    """One run; of the load, which share of the host it took."""
    with background() if load else contextlib.nullcontext() as beside:
        begun_s, used_s = time.monotonic(), beside.used_s() if beside else 0.0
        found = trip(run, seconds, keys)
        if "refused" in found:
            raise TripError(found["refused"])
        if beside is not None:
            processors_s = (time.monotonic() - begun_s) * len(os.sched_getaffinity(0))
            found["load_share"] = (beside.used_s() - used_s) / processors_s
    return found


def figures(runs: Mapping[tuple[bool, bool], Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Each kind's figures, and how many times the set-up lowers what, run by run.

    Returns:
        kinds (load, plain, latency_us by percentile, frames, frames_without_command, granted, load_share), lowered
        ("loaded" and "quiet", by percentile; plain over real time), load (what it is).
    """
    kinds = [
        {
            "load": load,
            "plain": plain,
            "latency_us": {at: course(one[at] for one in found) for at in (*PERCENTILES, DUE)},
            "frames": sum(one["frames"] for one in found),
            "frames_without_command": sum(one["frames_without_command"] for one in found),
            "granted": found[-1]["granted"],
            "load_share": course(one["load_share"] for one in found) if load else None,
        }
        for (load, plain), found in runs.items()
    ]
    lowered = {
        "loaded" if load else "quiet": {
            at: course(bare[at] / full[at] for full, bare in zip(runs[load, False], runs[load, True], strict=True))
            for at in (*PERCENTILES, DUE)
        }
        for load in (True, False)
    }
    return {"kinds": kinds, "lowered": lowered, "load": WHAT}


if __name__ == "__main__":
    run_main(main)
