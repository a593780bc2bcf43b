"""What a soak found: how each process's memory, handles, threads and the latency went with time."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

BLOCKS = 12
"""Means over which a slope is fitted: neighbouring samples are not independent, means of many nearly are."""
WARM_UP = 0.25
"""Part of the time at the start that does not count: caches and queues fill."""
SIGNIFICANT = 3.0
"""Standard errors above which a slope is one."""
LEAST_GROWTH_MB = 1.0
"""Over the time that counts; less than a leak of a night would be, and more than the allocator's steps."""


class Usage(NamedTuple):
    """What a process has at one time."""

    time_s: float
    memory_bytes: int
    handles: int
    threads: int


class Slope(NamedTuple):
    """Change per hour, and its standard error; NaN where there is too little to fit."""

    per_hour: float
    error: float


def slope(times_s: Sequence[float], values: Sequence[float]) -> Slope:
    """Slope of values against time after the warm-up, fitted to the means of blocks."""
    times, found = np.asarray(times_s, np.float64), np.asarray(values, np.float64)
    later = times >= times[0] + WARM_UP * (times[-1] - times[0])
    times, found = times[later] / 3600, found[later]
    if times.size < 2 * BLOCKS:
        return Slope(float("nan"), float("nan"))
    when, means = (np.array([part.mean() for part in np.array_split(one, BLOCKS)]) for one in (times, found))
    fit = stats.linregress(when, means)
    return Slope(float(fit.slope), float(fit.stderr))


def grows(found: Slope, span_hours: float) -> bool:
    """Whether memory grows: by a slope beyond its error, and more than `LEAST_GROWTH_MB` over the time that counts."""
    counted = span_hours * (1 - WARM_UP)
    return found.per_hour > SIGNIFICANT * found.error and found.per_hour * counted > LEAST_GROWTH_MB


def more(times_s: Sequence[float], counts: Sequence[int]) -> bool:
    """Whether there are usually more of something in the last quarter of the time than in the second."""
    when = (np.asarray(times_s) - times_s[0]) / (times_s[-1] - times_s[0])
    second = np.median(np.asarray(counts)[(when >= WARM_UP) & (when < 2 * WARM_UP)])
    return bool(np.median(np.asarray(counts)[when >= 1 - WARM_UP]) > second)


def of_process(samples: Sequence[Usage]) -> dict[str, Any]:
    """Figures of one process."""
    times_s = [one.time_s for one in samples]
    span_hours = (times_s[-1] - times_s[0]) / 3600
    memory_mb = [one.memory_bytes / 1e6 for one in samples]
    memory = slope(times_s, memory_mb)
    grown = {
        "memory": grows(memory, span_hours),
        "handles": more(times_s, [one.handles for one in samples]),
        "threads": more(times_s, [one.threads for one in samples]),
    }
    return {
        "memory_first_mb": round(memory_mb[0], 2),
        "memory_last_mb": round(memory_mb[-1], 2),
        "memory_most_mb": round(max(memory_mb), 2),
        "memory_mb_per_hour": memory.per_hour,
        "memory_mb_per_hour_error": memory.error,
        "handles_first": samples[0].handles,
        "handles_most": max(one.handles for one in samples),
        "handles_last": samples[-1].handles,
        "threads_first": samples[0].threads,
        "threads_most": max(one.threads for one in samples),
        "threads_last": samples[-1].threads,
        "grows": [name for name, grew in grown.items() if grew],
    }


def of_latency(times_s: Sequence[float], p50_us: Sequence[float], p99_us: Sequence[float]) -> dict[str, float]:
    """How the frame-to-command latency went."""
    median, high = slope(times_s, p50_us), slope(times_s, p99_us)
    return {
        "p50_us": float(np.median(p50_us)),
        "p50_us_per_hour": median.per_hour,
        "p50_us_per_hour_error": median.error,
        "p99_us": float(np.median(p99_us)),
        "p99_us_per_hour": high.per_hour,
        "p99_us_per_hour_error": high.error,
    }


def render(figures: dict[str, Any]) -> str:
    """For people."""
    lines = [f"{'process':<11} {'memory, MB':>22} {'MB per hour':>20} {'handles':>14} {'threads':>10}"]
    for name, one in figures["processes"].items():
        lines.append(
            f"{name:<11} {one['memory_first_mb']:>9.1f} -> {one['memory_last_mb']:>9.1f} "
            f"{one['memory_mb_per_hour']:>11.2f} +- {one['memory_mb_per_hour_error']:<5.2f} "
            f"{one['handles_first']:>6} -> {one['handles_last']:<4} "
            f"{one['threads_first']:>3} -> {one['threads_last']:<3}"
        )
    latency = figures["latency"]
    lines += [
        f"frame to command: p50 {latency['p50_us']:.0f} us, {latency['p50_us_per_hour']:+.1f} +- "
        f"{latency['p50_us_per_hour_error']:.1f} us per hour; p99 {latency['p99_us']:.0f} us, "
        f"{latency['p99_us_per_hour']:+.1f} +- {latency['p99_us_per_hour_error']:.1f} us per hour",
        f"{figures['frames_published']} frames, {figures['frames_skipped']} skipped, "
        f"{figures['frames_missing']} missing; "
        f"{figures['messages_recorded']} messages in {figures['logs']} logs, {figures['messages_lost']} lost, "
        f"{figures['gaps']} gaps",
        "passed" if figures["passed"] else "FAILED: " + "; ".join(figures["why"]),
    ]
    return "\n".join(lines) + "\n"
