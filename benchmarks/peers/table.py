"""From the runs of a contest to one table, as text or Markdown."""

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

from benchmarks import cells
from benchmarks.peers.contestants import BARE, TIMER

PERCENTILES = {"p50_us": "p50", "p99_us": "p99", "p99_9_us": "p99.9", "max_us": "max"}
HEADINGS = (
    "contestant",
    "class",
    *(f"{name}, us" for name in PERCENTILES.values()),
    f"p50 of {BARE}'s",
    "p99",
    "without a command",
    "to the mirror p50, us",
    "p99, us",
)

DEFINITIONS = {
    "t0": "just before the source sends a frame: before the put, the ring's put, or pyrtcao's WavefrontSensor.expose",
    "t1": "just after the controller has sent the frame's command: after the put, the ring's put, or pyrtcao's "
    "write_stream; for shared memory beside zenoh after the ring's put, and for lowfc's bus after its socket's send, "
    "before zenoh's",
    "to the mirror": "from t0 until the command is in the mirror's process: the source's own, on its receiving thread; "
    "for pyrtcao the corrector's process, its actuators made",
    "clock": "CLOCK_MONOTONIC, one host",
    "pacing": "the source sleeps until absolute times; a late frame is sent at once, its t0 is when it was sent, and "
    "none is left out",
    "cells": "minimum / median over the repeats; contestants and classes take turns within every repeat",
    "without a command": "measured frames that no command was made from: median over the repeats, of how many",
    "pinning": "source, mirror and onlooker on the first processor, controller (pyrtcao: and signal) on the second",
    "threads": "BLAS and numba 1; garbage collection off everywhere",
}


def table(rows: Sequence[dict[str, Any]]) -> list[list[str]]:
    """The cells of the table, one line for each row of `contest.hold`, under `HEADINGS`."""
    bare = {row["scheduling"]: row for row in rows if row["contestant"] == BARE}
    lines = [_cells(row, bare.get(row["scheduling"])) for row in rows]
    return [line + [""] * (len(HEADINGS) - len(line)) for line in lines]


def summary(row: dict[str, Any]) -> dict[str, Any]:
    """Minimum and median over the repeats of a row, as `{span: {percentile: {min, median}}}`; counts as medians."""
    repeats = row["repeats"]
    found: dict[str, Any] = {name: median(run[name] for run in repeats) for name in _counts(repeats)}
    for span in ("frame_to_command", "frame_to_mirror"):
        measured = [run[span] for run in repeats if run[span] is not None]
        if measured:
            found[span] = {
                name: {"min": min(run[name] for run in measured), "median": median(run[name] for run in measured)}
                for name in PERCENTILES
            }
    return found


def text(result: dict[str, Any]) -> str:
    """The whole result for a terminal."""
    return "\n".join([cells.text([HEADINGS, *table(result["rows"])]), "", *_about(result)])


def markdown(result: dict[str, Any]) -> str:
    """The whole result for a document."""
    about = (f"- {line}" for line in _about(result))
    return "\n".join([cells.markdown([HEADINGS, *table(result["rows"])]), "", *about, ""])


def _cells(row: dict[str, Any], bare: dict[str, Any] | None) -> list[str]:
    head = [row["contestant"], row["scheduling"]]
    if "missing" in row:
        return [*head, row["missing"].partition(":")[0]]
    if not row["repeats"]:
        return [*head, "failed"]
    found = summary(row)
    if row["contestant"] == TIMER:
        return [*head, *_span(found, "frame_to_command", PERCENTILES)]
    return [
        *head,
        *_span(found, "frame_to_command", PERCENTILES),
        *_ratios(found, bare),
        f"{found['without_command']:g} of {found['frames']:g}",
        *_span(found, "frame_to_mirror", ("p50_us", "p99_us")),
    ]


def _span(found: dict[str, Any], span: str, percentiles: Iterable[str]) -> list[str]:
    measured = found.get(span)
    if measured is None:
        return ["" for _ in percentiles]
    return [f"{measured[name]['min']:.0f}/{measured[name]['median']:.0f}" for name in percentiles]


def _ratios(found: dict[str, Any], bare: dict[str, Any] | None) -> list[str]:
    """Medians over those of bare zenoh in the same class."""
    if bare is None or not bare["repeats"]:
        return ["", ""]
    ours, theirs = found.get("frame_to_command"), summary(bare).get("frame_to_command")
    if ours is None or theirs is None:
        return ["", ""]
    return [f"{ours[name]['median'] / theirs[name]['median']:.2f}" for name in ("p50_us", "p99_us")]


def _counts(repeats: Sequence[dict[str, Any]]) -> list[str]:
    return [name for name, value in repeats[0].items() if isinstance(value, int)]


def _about(result: dict[str, Any]) -> list[str]:
    """What the table's figures are, and of which host."""
    rules, host = result["rules"], result["host"]
    said = DEFINITIONS | {row["contestant"]: row["what"] for row in result["rows"]}
    lines = [f"{name}: {what}." for name, what in said.items()]
    lines.append(
        f"{rules['repeats']} repeats of {rules['seconds']:g} s at {rules['rate_hz']:g} Hz after {rules['warm_up']} "
        f"frames; {result['sizes']}."
    )
    late = sum(run["sent_late"] for row in result["rows"] for run in row["repeats"])
    sent = sum(run["frames"] for row in result["rows"] for run in row["repeats"])
    lines.append(f"{late} of all {sent} frames were sent more than a period late.")
    for row in result["rows"]:
        seen = [run for run in row["repeats"] if "frames_observed" in run]
        if seen:
            got, of = sum(run["frames_observed"] for run in seen), sum(run["frames"] for run in seen)
            lines.append(f"{row['contestant']}, {row['scheduling']}: the onlooker got {got} of {of} frames.")
    lines += sorted({f"{row['contestant']}: {row['missing']}." for row in result["rows"] if "missing" in row})
    lines += [f"Failed, {row['scheduling']}: {fault}" for row in result["rows"] for fault in row["failures"]]
    lines += result["notes"]
    lines.append(
        f"{host['processors']} processors of {host['processor']}, of which {result['pinned_to']}, Linux "
        f"{host['kernel']}, clock source {host['clock_source']}, Python {host['python']}, "
        f"load {host['load_before']:g} before, {result['date']}; "
        f"{', '.join(f'{name} {version}' for name, version in result['versions'].items())}."
    )
    lines.append(f"By `{result['command_line']}`.")
    return lines
