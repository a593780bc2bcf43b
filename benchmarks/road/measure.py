"""A loop as it is and each change to it in turns, so that every change has neighbours of its own; figures of both."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import numpy as np

from benchmarks.road.changes import Change, Loop
from benchmarks.road.trip import MIRROR, TripError

SELDOM = 3
"""Repeats of a change that is not measured often."""
AT = ("p50", "p99", MIRROR)

Figures = Mapping[str, Any]
Travel = Callable[[Change | None, Loop], Figures]


@dataclass
class Tried:
    """What was measured of one change: its runs, and the two of its loop as that is beside each."""

    change: Change
    runs: list[Figures] = field(default_factory=list)
    neighbours: list[tuple[Figures, Figures]] = field(default_factory=list)
    refused: str | None = None


def in_turns(changes: Sequence[Change], repeats: int, travel: Travel) -> list[Tried]:
    """Run everything.

    Args:
        changes: to be tried; neighbours in the same loop share runs.
        repeats: of those that are measured often.
        travel: runs a loop once, with a change or as it is.

    Raises:
        TripError: a loop does not run as it is.
    """
    tried = [Tried(change) for change in changes]
    for number in range(repeats):
        due = [one for one in tried if one.refused is None and (one.change.often or number < SELDOM)]
        for loop, group in groupby(due, key=lambda one: one.change.loop):
            before = _as_it_is(travel, loop)
            for one in group:
                found = travel(one.change, loop)
                after = _as_it_is(travel, loop)
                if "refused" in found:
                    one.refused = found["refused"]
                else:
                    one.runs.append(found)
                    one.neighbours.append((before, after))
                before = after
    return tried


def _as_it_is(travel: Travel, loop: Loop) -> Figures:
    found = travel(None, loop)
    if "refused" in found:
        raise TripError(f"the loop {loop} does not run: {found['refused']}")
    return found


def figures(tried: Tried) -> dict[str, Any]:
    """What a change brought; before and after are without it and with it, whether it was kept or not.

    Returns:
        name, what, loop, kept, why, refused; where it runs, runs, before and after (p50 and p99 of frame to command,
        p50 of frame to mirror, us, each median, lowest and highest), ratio (after over before, run by run), frames
        and frames_without_command of each, and stages_us (p50 of each stage, before and after).
    """
    change = tried.change
    found: dict[str, Any] = {
        "name": change.name,
        "what": change.what,
        "loop": str(change.loop),
        "kept": change.kept,
        "why": change.why,
        "refused": tried.refused,
    }
    if not tried.runs:
        return found
    sides = [[run for pair in tried.neighbours for run in pair], tried.runs]
    names = ("after", "before") if change.kept else ("before", "after")
    ratios = {}
    for at in AT:
        as_it_is = np.array([[one[at], other[at]] for one, other in tried.neighbours]).mean(axis=1)
        changed = np.array([run[at] for run in tried.runs])
        ratios[at] = course(as_it_is / changed if change.kept else changed / as_it_is)
    return found | {
        "runs": len(tried.runs),
        **{name: {at: course(run[at] for run in runs) for at in AT} for name, runs in zip(names, sides, strict=True)},
        "ratio": ratios,
        **{
            count: {name: sum(run[count] for run in runs) for name, runs in zip(names, sides, strict=True)}
            for count in ("frames", "frames_without_command")
        },
        "stages_us": {name: _stages(runs) for name, runs in zip(names, sides, strict=True)},
    }


def course(values: Iterable[float]) -> dict[str, float]:
    """Median, lowest and highest."""
    each = np.array(list(values), float)
    found = {"median": np.median(each), "lowest": each.min(), "highest": each.max()}
    return {name: round(float(value), 4) for name, value in found.items()}


def _stages(runs: Sequence[Figures]) -> dict[str, float]:
    """Median over the runs of each stage's p50."""
    stages = runs[0]["stages_us"]
    return {stage: round(float(np.median([run["stages_us"][stage] for run in runs])), 3) for stage in stages}
