"""Results of `lowfc latency`: all repeats combined, and the comparison of two results."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lowfc.control.kernel.tables import KERNELS
from lowfc.programs.measure.latency import stalls
from lowfc.programs.measure.latency.frame_statistics import COUNTS, RATIOS, RATIOS_AT, REFERENCES, edges_us

RATIO_ROW = "over_echo_and_step"
COMPARED = ("p50", "p99", "p99_9")  # percentiles

Repeats = Sequence[Mapping[str, Any]]


def combine(repeats: Repeats) -> dict[str, Any]:
    """Results of all repeats.

    Returns:
        latency_us, by span: for each percentile its median over the repeats (max: the largest). spread_us, by span: for
        each percentile its range over the repeats. Likewise echo_us{round_trip}, step_us, hot_step_us, timer_us, ratio
        and ratio_hot (p50 and p99; see `RATIOS`), each with its spread, such as step_us_spread. histogram{edges_us,
        counts by span}; over_time of each repeat; sums of `COUNTS` and reasons; rate_hz, the median; memory_mb, the
        largest of each process (live loop only); repeats, the percentiles of each; and stalls (`Stalls`) if they were
        traced.
    """
    spans = [span for span in repeats[0]["latency_us"] if all(span in repeat["latency_us"] for repeat in repeats)]
    by_span = {span: [repeat["latency_us"][span] for repeat in repeats] for span in spans}
    results: dict[str, Any] = {
        "latency_us": {span: median_of(values) for span, values in by_span.items()},
        "spread_us": {span: spread_of(values) for span, values in by_span.items()},
    }
    references = {name: [repeat[name] for repeat in repeats if repeat.get(name)] for name in REFERENCES}
    for name in RATIOS:
        references[name] = [
            {at: ratio(repeat, at, name) for at in RATIOS_AT} for repeat in repeats if repeat.get("echo_us")
        ]
    for name, values in references.items():
        results[name], results[f"{name}_spread"] = (median_of(values), spread_of(values)) if values else (None, None)
    for name in ("echo_us", "echo_us_spread"):
        results[name] = results[name] and {"round_trip": results[name]}
    for name in COUNTS:
        counts = [repeat[name] for repeat in repeats if repeat.get(name) is not None]
        results[name] = sum(counts) if counts else None
    names = sorted({name for repeat in repeats for name in repeat["reasons"]})
    results["reasons"] = {name: sum(repeat["reasons"].get(name, 0) for repeat in repeats) for name in names}
    results["rate_hz"] = float(np.median([repeat["rate_hz"] for repeat in repeats]))
    results["histogram"] = _histogram(repeats, spans)
    results["over_time"] = [repeat["over_time"] for repeat in repeats]
    results["repeats"] = [{name: repeat.get(name) for name in ("latency_us", *REFERENCES)} for repeat in repeats]
    if memory := [repeat["memory_mb"] for repeat in repeats if "memory_mb" in repeat]:
        results["memory_mb"] = {name: max(processes[name] for processes in memory) for name in memory[0]}
    if traced := [repeat["stalls"] for repeat in repeats if "stalls" in repeat]:
        results["stalls"] = stalls.combine(traced).json_object()
    return results


def kernel_summary(repeats: Repeats) -> dict[str, Any]:
    """The combined repeats if all have the same kernel; otherwise those with the fused step, compared with numpy.

    Returns:
        kernel: numpy, fused or both. With both: numpy_us, frame to command with numpy; kernel_ratio (p50 and p99), the
        median over the repeats of frame to command with the fused step over that with numpy; and kernel_ratio_spread.
    """
    by_kernel = {name: [repeat for repeat in repeats if repeat["kernel"] == name] for name in KERNELS}
    if not all(by_kernel.values()):
        return combine(repeats) | {"kernel": repeats[0]["kernel"]}
    fused_us, numpy_us = (
        [repeat["latency_us"]["frame_to_command"] for repeat in by_kernel[name]] for name in ("fused", "numpy")
    )
    ratios = [{at: fused[at] / numpy[at] for at in RATIOS_AT} for fused, numpy in zip(fused_us, numpy_us, strict=True)]
    comparison = {"kernel_ratio": median_of(ratios), "kernel_ratio_spread": spread_of(ratios)}
    return combine(by_kernel["fused"]) | {"kernel": "both", "numpy_us": median_of(numpy_us)} | comparison


def median_of(repeats: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Median of each percentile over the repeats; of max, the largest."""
    by_percentile = {at: [repeat[at] for repeat in repeats] for at in repeats[0]}
    return {at: float(max(values) if at == "max" else np.median(values)) for at, values in by_percentile.items()}


def spread_of(repeats: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Lowest and highest value of each percentile over the repeats."""
    by_percentile = {at: [repeat[at] for repeat in repeats] for at in repeats[0]}
    return {at: [float(min(values)), float(max(values))] for at, values in by_percentile.items()}


def ratio(repeat: Mapping[str, Any], at: str, name: str = "ratio") -> float:
    """Latency from frame to command, divided by the sum of half a bare echo's round trip and one control step alone."""
    reference_us: float = repeat["echo_us"][at] / 2 + repeat[RATIOS[name][0]][at]
    return float(repeat["latency_us"]["frame_to_command"][at] / reference_us)


def compare(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Two results side by side.

    Returns:
        rows, one for each span that both have at each of `COMPARED`, and for `ratio` at `RATIOS_AT`: name, at, unit
        (us, or empty for the ratio), a, b, ratio (b over a), better ("a", "b" or "same"), difference (b minus a),
        spread (the larger of both ranges over the repeats; None if one has a single repeat) and beyond_spread. counts:
        a and b for each of `COUNTS` that both have.
    """
    both = (before, after)
    pairs = [
        (span, at, "us", [(result["latency_us"][span][at], result["spread_us"][span][at]) for result in both])
        for span in before["latency_us"]
        if span in after["latency_us"]
        for at in COMPARED
    ]
    if before["ratio"] and after["ratio"]:
        pairs += [
            (RATIO_ROW, at, "", [(result["ratio"][at], result["ratio_spread"][at]) for result in both])
            for at in RATIOS_AT
        ]
    single = min(len(result["repeats"]) for result in both) < 2
    return {
        "rows": [_row(*pair, single=single) for pair in pairs],
        "counts": {
            name: [result[name] for result in both]
            for name in COUNTS
            if all(result.get(name) is not None for result in both)
        },
    }


def _row(name: str, at: str, unit: str, values: list[tuple[float, list[float]]], *, single: bool) -> dict[str, Any]:
    (a, a_spread), (b, b_spread) = values
    spread = None if single else max(high - low for low, high in (a_spread, b_spread))
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
        "beyond_spread": None if spread is None else abs(b - a) > spread,
    }


def _histogram(repeats: Repeats, spans: Sequence[str]) -> dict[str, Any]:
    """Counts of all repeats, without the empty bins at both ends."""
    counts = {span: np.sum([repeat["histogram"][span] for repeat in repeats], axis=0) for span in spans}
    filled = np.flatnonzero(np.sum(list(counts.values()), axis=0))
    first, last = int(filled[0]), int(filled[-1]) + 1
    return {
        "edges_us": np.round(edges_us()[first : last + 1], 4).tolist(),
        "counts": {span: column[first:last].tolist() for span, column in counts.items()},
    }
