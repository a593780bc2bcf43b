"""The tables of the road and of the loaded host: their headings, then their lines."""

from collections.abc import Mapping
from typing import Any

from benchmarks.road.changes import Loop

HEADINGS = (
    "change",
    "p50 before, us",
    "after",
    "p99 before, us",
    "after",
    "p50, after over before",
    "p99",
    "p50 to mirror",
    "without a command",
    "most of it in",
    "kept",
    "why not",
)
LOADED_HEADINGS = (
    "load",
    "real-time set-up",
    "p50, us",
    "p99",
    "p99.9",
    "max",
    "p99.9 from when due",
    "without a command",
)

_RATIOS = {"p50": "p50", "p99": "p99", "mirror_p50": "p50 to the mirror"}
_AT = {"p50": "p50", "p99": "p99", "p99_9": "p99.9", "due_p99_9": "p99.9 from when due"}

Cells = tuple[str, ...]


def road(result: Mapping[str, Any]) -> list[Cells]:
    """`HEADINGS`, and a line for each change."""
    return [HEADINGS, *map(_line, result["changes"])]


def loaded(result: Mapping[str, Any]) -> list[Cells]:
    """`LOADED_HEADINGS`, and a line for each kind of run."""
    lines = (
        (
            "yes" if kind["load"] else "no",
            "without" if kind["plain"] else "with",
            *(_course(kind["latency_us"][at], ".0f") for at in ("p50", "p99", "p99_9", "max", "due_p99_9")),
            f"{kind['frames_without_command']} of {kind['frames']}",
        )
        for kind in result["kinds"]
    )
    return [LOADED_HEADINGS, *lines]


def ratios(result: Mapping[str, Any]) -> str:
    """How many times the set-up lowers what, with and without the load."""
    parts = []
    for state, found in result["lowered"].items():
        each = ", ".join(f"{words} {_course(found[at], '.2f')}" for at, words in _AT.items())
        parts.append(f"{state}: {each}")
    return f"The real-time set-up lowers frame to command by these times, {'; '.join(parts)}."


def _line(change: Mapping[str, Any]) -> Cells:
    name = change["what"] if change["loop"] == Loop.AS_IT_IS else f"{change['what']} ({change['loop']})"
    kept, why = "yes" if change["kept"] else "no", change["why"]
    if "ratio" not in change:
        return (name, *[""] * (len(HEADINGS) - 3), kept, f"it does not run: {change['refused']}")
    before, after = change["before"], change["after"]
    frames, without = change["frames"], change["frames_without_command"]
    return (
        name,
        *(_course(side[at], ".0f") for at in ("p50", "p99") for side in (before, after)),
        *(_course(change["ratio"][at], ".2f") for at in _RATIOS),
        " / ".join(f"{without[side]} of {frames[side]}" for side in ("before", "after")),
        _stage(change["stages_us"]),
        kept,
        "; ".join(filter(None, [why, _verdict(change)])),
    )


def _verdict(change: Mapping[str, Any]) -> str:
    """What the figures say against a change that was not kept."""
    if change["kept"]:
        return ""
    if change["refused"]:
        return f"it did not always run: {change['refused']}"
    gains = [at for at, ratio in change["ratio"].items() if ratio["highest"] < 1]
    losses = [at for at, ratio in change["ratio"].items() if ratio["lowest"] > 1]
    parts = [*(f"worse {_RATIOS[at]}" for at in losses), *(f"better {_RATIOS[at]}" for at in gains)]
    return ", ".join(parts) or "no difference beyond the spread"


def _stage(stages_us: Mapping[str, Mapping[str, float]]) -> str:
    """The stage whose median the change moved most."""
    before, after = stages_us["before"], stages_us["after"]
    moved = {stage: after[stage] - before[stage] for stage in after if stage in before}
    if not moved:
        return ""
    stage = max(moved, key=lambda name: abs(moved[name]))
    return f"{stage} {moved[stage]:+.0f} us"


def _course(found: Mapping[str, float], form: str) -> str:
    return f"{found['median']:{form}} ({found['lowest']:{form}} to {found['highest']:{form}})"
