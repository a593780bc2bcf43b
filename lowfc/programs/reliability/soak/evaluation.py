"""Results of a soak: growth of each process's memory, handles and threads, and drift of the latency."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

from lowfc.control.loop.wording import counted
from lowfc.programs.cli.result import table

BLOCKS = 12
"""Number of means to which a slope is fitted: neighbouring samples are correlated, means of many samples hardly are."""
WARM_UP = 0.25
"""Fraction of the time, at its start, that is left out, because caches and queues fill."""
SIGNIFICANT = 3.0
"""Standard errors above which a slope is significant."""
MIN_GROWTH_MB = 1.0
"""Growth over the evaluated time above which memory counts as growing; the allocator's steps are smaller."""
TOO_SHORT = "too short to judge"


class Usage(NamedTuple):
    """Resources of a process at one time; `handles` is the number of open files and sockets."""

    time_s: float
    memory_bytes: int
    handles: int
    threads: int


def slope(times_s: Sequence[float], values: Sequence[float]) -> tuple[float, float] | None:
    """Change per hour and its standard error, from means of blocks after the warm-up; None with too few samples."""
    hours, samples = np.asarray(times_s, np.float64) / 3600, np.asarray(values, np.float64)
    later = hours >= hours[0] + WARM_UP * (hours[-1] - hours[0]) if hours.size else hours
    if np.count_nonzero(later) < 2 * BLOCKS:
        return None
    block_hours, block_means = (
        np.array([block.mean() for block in np.array_split(column[later], BLOCKS)]) for column in (hours, samples)
    )
    fit = scipy.stats.linregress(block_hours, block_means)
    return float(fit.slope), float(np.nan_to_num(fit.stderr))  # NaN if all values are equal


def _grew(counts: Sequence[int]) -> bool:
    """Whether the median of the last quarter of the samples exceeds the median of the second quarter."""
    quarter = len(counts) // 4
    return bool(np.median(counts[-quarter:]) > np.median(counts[quarter : 2 * quarter]))


def process_statistics(samples: Sequence[Usage]) -> dict[str, Any]:
    """First, largest and last usage of one process, the slope of its memory, and which resources grow."""
    times_s, memory_bytes, handles, threads = zip(*samples, strict=True)
    memory_mb = [size / 1e6 for size in memory_bytes]
    memory_slope = slope(times_s, memory_mb)
    grows, too_short = [], ["memory", "handles", "threads"]
    if memory_slope is not None:
        mb_per_hour, error = memory_slope
        evaluated_h = (times_s[-1] - times_s[0]) / 3600 * (1 - WARM_UP)
        memory_grows = mb_per_hour > SIGNIFICANT * error and mb_per_hour * evaluated_h > MIN_GROWTH_MB
        checks = {"memory": memory_grows, "handles": _grew(handles), "threads": _grew(threads)}
        grows, too_short = [name for name, grew in checks.items() if grew], []
    measured = {"memory": [round(mb, 2) for mb in memory_mb], "handles": handles, "threads": threads}
    usage: dict[str, Any] = {}
    for name, values in measured.items():
        unit = "_mb" if name == "memory" else ""
        usage |= {f"{name}_first{unit}": values[0], f"{name}_most{unit}": max(values), f"{name}_last{unit}": values[-1]}
    return {**usage, **_per_hour("memory_mb", memory_slope), "grows": grows, "too_short": too_short}


def latency_statistics(samples: Sequence[tuple[float, float, float]]) -> dict[str, float | None]:
    """Median and drift of the latency, from samples of time, s, and p50 and p99 since the previous sample, us."""
    times_s, *percentiles_us = zip(*samples, strict=True) if samples else ((), (), ())
    statistics: dict[str, float | None] = {}
    for name, latencies_us in zip(("p50_us", "p99_us"), percentiles_us, strict=True):
        statistics[name] = float(np.median(latencies_us)) if latencies_us else None
        statistics |= _per_hour(name, slope(times_s, latencies_us))
    return statistics


def _per_hour(name: str, fitted: tuple[float, float] | None) -> dict[str, float | None]:
    """A slope for JSON: null if the time was too short to judge."""
    per_hour, error = fitted or (None, None)
    return {f"{name}_per_hour": per_hour, f"{name}_per_hour_error": error}


def too_short(processes: Mapping[str, Mapping[str, Any]], latency: Mapping[str, float | None]) -> list[str]:
    """Checks for which the time was too short."""
    checks = [f"the {name}'s {what}" for name, process in processes.items() for what in process["too_short"]]
    return [*checks, "the latency"] if latency["p50_us_per_hour"] is None else checks


def verdict(results: Mapping[str, Any]) -> str:
    """Text of the verdict: passed, failed with the reasons, or too short to judge with the checks concerned."""
    if results["why"]:
        return "FAILED: " + "; ".join(results["why"])
    return f"{TOO_SHORT}: {', '.join(results['too_short'])}" if results["too_short"] else "passed"


def latency_in_words(latency: Mapping[str, float | None]) -> str:
    """Text of the latencies and their drift."""
    parts = []
    for name in ("p50", "p99"):
        value_us, per_hour, error = (latency[f"{name}_us{end}"] for end in ("", "_per_hour", "_per_hour_error"))
        change = _change(per_hour, error, "+.1f", " us per hour")
        parts.append(f"{name} {TOO_SHORT}" if value_us is None else f"{name} {value_us:.0f} us, {change}")
    return "; ".join(parts)


def _change(per_hour: float | None, error: float | None, form: str, unit: str = "") -> str:
    return TOO_SHORT if per_hour is None else f"{per_hour:{form}} +- {error:{form.removeprefix('+')}}{unit}"


def render(results: dict[str, Any]) -> str:
    """The results as text."""
    rows = [
        (
            name,
            f"{process['memory_first_mb']:.1f} -> {process['memory_last_mb']:.1f}",
            _change(process["memory_mb_per_hour"], process["memory_mb_per_hour_error"], ".2f"),
            *(f"{process[f'{what}_first']} -> {process[f'{what}_last']}" for what in ("handles", "threads")),
        )
        for name, process in results["processes"].items()
    ]
    return "\n".join(
        [
            *table(("process", "memory, MB", "MB per hour", "handles", "threads"), rows),
            f"frame to command: {latency_in_words(results['latency'])}",
            f"{counted(results['frames_published'], 'frame')}, {results['frames_skipped']} skipped, "
            f"{results['frames_missing']} missing; {counted(results['messages_recorded'], 'message')} in "
            f"{counted(results['logs'], 'log')}, {results['messages_lost']} lost, {results['gaps']} gaps",
            verdict(results),
        ]
    )
