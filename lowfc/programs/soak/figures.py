"""What a soak found: how each process's memory, handles, threads and the latency went with time."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from lowfc.control.wording import counted

BLOCKS = 12
"""Means over which a slope is fitted: neighbouring samples are not independent, means of many nearly are."""
WARM_UP = 0.25
"""Part of the time at the start that does not count: caches and queues fill."""
SIGNIFICANT = 3.0
"""Standard errors above which a slope is one."""
LEAST_GROWTH_MB = 1.0
"""Over the time that counts; less than a leak of a night would be, and more than the allocator's steps."""
TOO_SHORT = "too short to judge"


class Usage(NamedTuple):
    """What a process has at one time."""

    time_s: float
    memory_bytes: int
    handles: int
    threads: int


class Slope(NamedTuple):
    """Change per hour, and its standard error."""

    per_hour: float
    error: float


def slope(times_s: Sequence[float], values: Sequence[float]) -> Slope | None:
    """Slope of values against time after the warm-up, fitted to the means of blocks; None of too little to judge."""
    later = _counted(times_s)
    if later is None:
        return None
    times, found = np.asarray(times_s, np.float64)[later] / 3600, np.asarray(values, np.float64)[later]
    when, means = (np.array([part.mean() for part in np.array_split(one, BLOCKS)]) for one in (times, found))
    fit = stats.linregress(when, means)
    return Slope(float(fit.slope), float(fit.stderr))


def grows(found: Slope, span_hours: float) -> bool:
    """Whether memory grows: by a slope beyond its error, and more than `LEAST_GROWTH_MB` over the time that counts."""
    counted = span_hours * (1 - WARM_UP)
    return found.per_hour > SIGNIFICANT * found.error and found.per_hour * counted > LEAST_GROWTH_MB


def more(times_s: Sequence[float], counts: Sequence[int]) -> bool | None:
    """Whether there are usually more of something in the last quarter of the time than in the second."""
    if _counted(times_s) is None:
        return None
    when = (np.asarray(times_s) - times_s[0]) / (times_s[-1] - times_s[0])
    second = np.median(np.asarray(counts)[(when >= WARM_UP) & (when < 2 * WARM_UP)])
    return bool(np.median(np.asarray(counts)[when >= 1 - WARM_UP]) > second)


def _counted(times_s: Sequence[float]) -> npt.NDArray[np.bool_] | None:
    """Which samples are after the warm-up; None where they are too few to judge by."""
    times = np.asarray(times_s, np.float64)
    if not times.size:
        return None
    later = times >= times[0] + WARM_UP * (times[-1] - times[0])
    return later if np.count_nonzero(later) >= 2 * BLOCKS else None


def of_process(samples: Sequence[Usage]) -> dict[str, Any]:
    """Figures of one process."""
    times_s = [one.time_s for one in samples]
    span_hours = (times_s[-1] - times_s[0]) / 3600
    memory_mb = [one.memory_bytes / 1e6 for one in samples]
    memory = slope(times_s, memory_mb)
    grown = {
        "memory": None if memory is None else grows(memory, span_hours),
        "handles": more(times_s, [one.handles for one in samples]),
        "threads": more(times_s, [one.threads for one in samples]),
    }
    return {
        "memory_first_mb": round(memory_mb[0], 2),
        "memory_last_mb": round(memory_mb[-1], 2),
        "memory_most_mb": round(max(memory_mb), 2),
        **_per_hour("memory_mb", memory),
        "handles_first": samples[0].handles,
        "handles_most": max(one.handles for one in samples),
        "handles_last": samples[-1].handles,
        "threads_first": samples[0].threads,
        "threads_most": max(one.threads for one in samples),
        "threads_last": samples[-1].threads,
        "grows": [name for name, grew in grown.items() if grew],
        "too_short": [name for name, grew in grown.items() if grew is None],
    }


def of_latency(samples: Sequence[tuple[float, float, float]]) -> dict[str, float | None]:
    """How the frame-to-command latency went: from when it was looked at, s, and its p50 and p99 since before, us."""
    times_s, *each = zip(*samples, strict=True) if samples else ((), (), ())
    found: dict[str, float | None] = {}
    for name, latencies_us in zip(("p50_us", "p99_us"), each, strict=True):
        found[name] = float(np.median(latencies_us)) if latencies_us else None
        found |= _per_hour(name, slope(times_s, latencies_us))
    return found


def _per_hour(name: str, found: Slope | None) -> dict[str, float | None]:
    """A slope as JSON has it: null where it was too short to judge."""
    return {
        f"{name}_per_hour": None if found is None else found.per_hour,
        f"{name}_per_hour_error": None if found is None else found.error,
    }


def too_short(processes: Mapping[str, Mapping[str, Any]], latency: Mapping[str, float | None]) -> list[str]:
    """What the time was too short to judge."""
    found = [f"the {name}'s {what}" for name, one in processes.items() for what in one["too_short"]]
    return found + ["the latency"] * (latency["p50_us_per_hour"] is None)


def verdict(figures: Mapping[str, Any]) -> str:
    """Passed, failed and why, or too short to judge and of what."""
    if figures["why"]:
        return "FAILED: " + "; ".join(figures["why"])
    return f"{TOO_SHORT}: {', '.join(figures['too_short'])}" if figures["too_short"] else "passed"


def told_latency(latency: Mapping[str, float | None]) -> str:
    """The latencies and how they change, in words."""
    told = []
    for name in ("p50", "p99"):
        value_us, per_hour, error = (latency[f"{name}_us{end}"] for end in ("", "_per_hour", "_per_hour_error"))
        change = TOO_SHORT if per_hour is None else f"{per_hour:+.1f} +- {error:.1f} us per hour"
        told.append(f"{name} {TOO_SHORT}" if value_us is None else f"{name} {value_us:.0f} us, {change}")
    return "; ".join(told)


def render(figures: dict[str, Any]) -> str:
    """For people."""
    lines = [f"{'process':<11} {'memory, MB':>22} {'MB per hour':>20} {'handles':>14} {'threads':>10}"]
    for name, one in figures["processes"].items():
        slope_mb, error_mb = one["memory_mb_per_hour"], one["memory_mb_per_hour_error"]
        change = f"{TOO_SHORT:>20}" if slope_mb is None else f"{slope_mb:>11.2f} +- {error_mb:<5.2f}"
        lines.append(
            f"{name:<11} {one['memory_first_mb']:>9.1f} -> {one['memory_last_mb']:>9.1f} {change} "
            f"{one['handles_first']:>6} -> {one['handles_last']:<4} "
            f"{one['threads_first']:>3} -> {one['threads_last']:<3}"
        )
    lines += [
        f"frame to command: {told_latency(figures['latency'])}",
        f"{counted(figures['frames_published'], 'frame')}, {figures['frames_skipped']} skipped, "
        f"{figures['frames_missing']} missing; "
        f"{counted(figures['messages_recorded'], 'message')} in {counted(figures['logs'], 'log')}, "
        f"{figures['messages_lost']} lost, "
        f"{figures['gaps']} gaps",
        verdict(figures),
    ]
    return "\n".join(lines) + "\n"
