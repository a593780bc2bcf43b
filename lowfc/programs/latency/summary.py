"""What `lowfc latency` says: repeats brought together, and two of its results compared."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lowfc.programs.latency.figures import edges_us, median_of, ratio, spread_of

OVER = "over_echo_and_step"
RATIOS = ("p50", "p99")
COMPARED = ("p50", "p99", "p99_9")
COUNTS = (
    "frames",
    "warm_up_frames",
    "frames_without_command",
    "frames_crowded_out",
    "frames_untimed",
    "frames_without_mirror_state",
    "frames_sent_late",
    "frames_skipped",
    "frames_missing",
)
_STEPS = {"ratio": "step_us", "ratio_hot": "hot_step_us"}
_ALONE = ("echo_us", "step_us", "hot_step_us", "timer_us")


def together(repeats: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of all repeats.

    Returns:
        latency_us and spread_us by span: median, and lowest and highest, over the repeats of each percentile (max: the
        largest); echo_us{round_trip}, step_us, hot_step_us, timer_us, ratio (p50 and p99; see there) and ratio_hot, its
        step of those back to back, and the same with _spread; histogram{edges_us, counts by span}; over_time of each
        repeat; counts of frames, and reasons; and repeats, the percentiles of each.
    """
    spans = [span for span in repeats[0]["latency_us"] if all(span in one["latency_us"] for one in repeats)]
    found: dict[str, Any] = {
        "latency_us": {span: median_of([one["latency_us"][span] for one in repeats]) for span in spans},
        "spread_us": {span: spread_of([one["latency_us"][span] for one in repeats]) for span in spans},
    }
    for name in _ALONE:
        each = [one[name] for one in repeats if one.get(name) is not None]
        found[name], found[f"{name}_spread"] = (median_of(each), spread_of(each)) if each else (None, None)
    for name in ("echo_us", "echo_us_spread"):
        found[name] = None if found[name] is None else {"round_trip": found[name]}
    for name, step in _STEPS.items():
        ratios = [{at: ratio(one, at, step) for at in RATIOS} for one in repeats if one.get("echo_us")]
        found[name], found[f"{name}_spread"] = (median_of(ratios), spread_of(ratios)) if ratios else (None, None)
    found |= {name: _total(repeats, name) for name in (*COUNTS, "echo_lost")}
    names = sorted({name for one in repeats for name in one["reasons"]})
    found["reasons"] = {name: sum(one["reasons"].get(name, 0) for one in repeats) for name in names}
    found["rate_hz"] = float(np.median([one["rate_hz"] for one in repeats]))
    found["histogram"] = _histogram(repeats, spans)
    found["over_time"] = [one["over_time"] for one in repeats]
    found["repeats"] = [{name: one.get(name) for name in ("latency_us", *_ALONE)} for one in repeats]
    return found


def compare(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Two results side by side.

    Returns:
        rows, one for each span and percentile that both have, and for each ratio to what the host can do: name, at,
        a, b, ratio (b over a), better ("a", "b" or "same"), difference (b minus a), spread (the larger of both ranges
        over the repeats; None for a single one) and beyond_spread; unit is us, or empty for a ratio.
    """
    rows = [
        _row(span, at, "us", [(one["latency_us"][span][at], one["spread_us"][span][at]) for one in (before, after)])
        for span in before["latency_us"]
        if span in after["latency_us"]
        for at in COMPARED
    ]
    if before["ratio"] and after["ratio"]:
        rows += [
            _row(
                OVER,
                at,
                "",
                [(one["ratio"][at], one["ratio_spread"][at]) for one in (before, after)],
            )
            for at in RATIOS
        ]
    single = min(len(before["repeats"]), len(after["repeats"])) < 2
    return {"rows": [row | {"spread": None, "beyond_spread": None} if single else row for row in rows]}


def _row(name: str, at: str, unit: str, figures: list[tuple[float, list[float]]]) -> dict[str, Any]:
    (a, a_spread), (b, b_spread) = figures
    spread = max(high - low for low, high in (a_spread, b_spread))
    return {
        "name": name,
        "at": at,
        "unit": unit,
        "a": a,
        "b": b,
        "ratio": b / a if a else None,
        "better": "same" if a == b else "a" if a < b else "b",
        "difference": b - a,
        "spread": spread,
        "beyond_spread": abs(b - a) > spread,
    }


def _total(repeats: Sequence[Mapping[str, Any]], name: str) -> int | None:
    counts = [one[name] for one in repeats if one.get(name) is not None]
    return sum(counts) if counts else None


def _histogram(repeats: Sequence[Mapping[str, Any]], spans: Sequence[str]) -> dict[str, Any]:
    """Counts of all repeats, without the empty bins at both ends."""
    counts = {span: np.sum([one["histogram"][span] for one in repeats], axis=0) for span in spans}
    filled = np.flatnonzero(np.sum(list(counts.values()), axis=0))
    first, last = int(filled[0]), int(filled[-1]) + 1
    return {
        "edges_us": np.round(edges_us()[first : last + 1], 4).tolist(),
        "counts": {span: column[first:last].tolist() for span, column in counts.items()},
    }
