"""The results of `lowfc latency` as text and as a picture."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lowfc.adapters.logs.recovery import faults
from lowfc.programs.measure.latency.frame_statistics import COUNTS, LOOP_SPANS, PERCENTILES, RATIOS, REFERENCES, SPANS
from lowfc.programs.measure.latency.stalls import Stalls
from lowfc.programs.measure.latency.summary import RATIO_ROW

_COMPARED = SPANS | {RATIO_ROW: "over echo and step"}
_ALWAYS = ("frames", "frames_without_command", "warm_up_frames", "messages_lost")
"""Counts shown even if they are 0."""
_HOST = ("processor", "processors", "kernel", "python", "clock_source", "load")
_BLOCKS = " ▁▂▃▄▅▆▇█"
_LINE = 32
"""Largest number of characters of a histogram in the table."""


def table(results: Mapping[str, Any]) -> str:
    """The result as text."""
    title = f"{'us':<22}" + "".join(f"{name.replace('_', '.'):>9}" for name in PERCENTILES)
    edges = results["histogram"]["edges_us"]
    lines = [f"{title}   log of counts, {edges[0]:.0f} to {edges[-1]:.0f} us"]
    for span, values in results["latency_us"].items():
        if span == "due_to_frame":
            lines.append("from the time the frame was due instead of the time it was published:")
        bars = sparkline(results["histogram"]["counts"][span])
        lines.append(f"{_row(SPANS[span], values)}   {bars}")
    for name, label in REFERENCES.items():
        values = results[name]
        if name == "echo_us" and values:
            values = {at: value / 2 for at, value in values["round_trip"].items()}
        if values:
            lines.append(_row(label, values))
    return "\n".join([*lines, *_remarks(results)])


def compared(comparison: Mapping[str, Any]) -> str:
    """The comparison of two results, named a and b, as text."""
    lines = [f"{name}: {comparison[name]}" for name in "ab"]
    lines.append(f"{'':<22}{'':>7}{'a':>10}{'b':>10}{'b/a':>8}{'b - a':>10}{'spread':>10}   better")
    for row in comparison["rows"]:
        digits = 1 if row["unit"] else 3
        spread = "-" if row["spread"] is None else f"{row['spread']:.{digits}f}"
        verdict = row["better"] if row["beyond_spread"] is not False else f"{row['better']}, within the spread"
        label = _COMPARED.get(row["name"], row["name"]).strip()
        ratio = "-" if row["ratio"] is None else f"{row['ratio']:.3f}"
        lines.append(
            f"{label:<22}{row['at'].replace('_', '.'):>7}{row['a']:>10.{digits}f}"
            f"{row['b']:>10.{digits}f}{ratio:>8}{row['difference']:>+10.{digits}f}{spread:>10}   {verdict}"
        )
    lines += [f"{COUNTS[name]}: a {a}, b {b}" for name, (a, b) in comparison["counts"].items() if a or b]
    lines.append(
        "in us, but `over echo and step` is a ratio; spread: the larger of the ranges of a and b over the "
        "repeats; -: a single repeat."
    )
    return "\n".join(lines)


def sparkline(counts: Sequence[int]) -> str:
    """Counts as at most `_LINE` blocks of logarithmic height; a block may combine several bins."""
    per_block = math.ceil(len(counts) / _LINE)  # bins
    sums = [sum(counts[start : start + per_block]) for start in range(0, len(counts), per_block)]
    highest = math.log1p(max(sums, default=0)) or 1.0
    return "".join(_BLOCKS[math.ceil(math.log1p(count) / highest * (len(_BLOCKS) - 1))] for count in sums).rstrip()


def picture(results: Mapping[str, Any]) -> bytes:
    """PNG: histograms of `LOOP_SPANS`, and frame to command against time."""
    from lowfc.adapters.files.drawing import figure_class, png

    figure = figure_class()(figsize=(9, 8), layout="constrained")
    histograms, over_time = figure.subplots(2, 1)
    edges = results["histogram"]["edges_us"]
    for span in LOOP_SPANS:
        if span in results["latency_us"]:
            histograms.stairs(results["histogram"]["counts"][span], edges, label=SPANS[span])
    histograms.set(xscale="log", yscale="log", xlabel="us", ylabel="frames", title=_title(results))
    histograms.legend()
    begun_s = 0.0
    for number, repeat in enumerate(results["over_time"]):
        seconds = [begun_s + second for second in repeat["seconds"]]
        labels = ("largest", "median") if number == 0 else (None, None)
        over_time.plot(seconds, repeat["max_us"], ".", color="tab:red", markersize=3, label=labels[0])
        over_time.plot(seconds, repeat["p50_us"], color="tab:blue", label=labels[1])
        begun_s = seconds[-1] if seconds else begun_s
    over_time.set(yscale="log", xlabel="s, one repeat after the other", ylabel="frame to command, us")
    over_time.legend()
    return png(figure)


def _row(label: str, values: Mapping[str, float]) -> str:
    return f"{label:<22}" + "".join(f"{values[at]:>9.1f}" for at in PERCENTILES)


def _ratios(results: Mapping[str, Any], name: str) -> list[str]:
    """Each percentile of a ratio, with its range."""

    def text(value: float) -> str:
        return f"{value:.2f}" if value >= 0.01 else f"{value:.1g}"

    spread = results[f"{name}_spread"].items()
    return [f"{at} {text(results[name][at])} ({text(low)} to {text(high)})" for at, (low, high) in spread]


def _remarks(results: Mapping[str, Any]) -> list[str]:
    """Lines below the table: ratios, counts, stalls, memory, settings and host."""
    lines = []
    for name, (_, suffix) in RATIOS.items():
        if results[name]:
            ratios = ", ".join(_ratios(results, name))
            lines.append(f"frame to command / (half a bare echo + one control step{suffix}): {ratios}")
    if results.get("kernel_ratio"):
        each = zip(_ratios(results, "kernel_ratio"), results["kernel_ratio_spread"], strict=True)
        ratios = ", ".join(f"{ratio}, numpy {results['numpy_us'][at]:.1f} us" for ratio, at in each)
        lines.append(f"all results are of the fused step; frame to command, fused / numpy, measured in turns: {ratios}")
    counts = {name: results.get(name) for name in COUNTS}
    shown = [name for name, count in counts.items() if count or (name in _ALWAYS and count is not None)]
    lines.append(", ".join(f"{counts[name]} {COUNTS[name]}" for name in shown))
    if results["reasons"]:
        reasons = ", ".join(f"{name} {count}" for name, count in results["reasons"].items())
        lines.append(f"frames refused or limited, including the warm-up: {reasons}")
    if "stalls" in results:
        lines.append(Stalls.model_validate(results["stalls"]).text())
    if results.get("memory_mb"):
        lines.append("memory: " + ", ".join(f"{name} {mb:.0f} MB" for name, mb in results["memory_mb"].items()))
    lines.append(_title(results))
    if results["settings"].get("log"):
        lines += faults(results["damaged"], results["no_end"])
    host = results["host"]
    lines.append(", ".join(f"{name} {host[name]}" for name in _HOST if host.get(name)))
    if "clock_error_us" in host:
        lines.append(
            f"on several hosts, with the measured offsets of their clocks: a span between hosts may have a systematic "
            f"error of {host['clock_error_us']:.0f} us"
        )
    return lines + [f"{word}: {', '.join(host[word])}" for word in ("granted", "refused") if host.get(word)]


def _title(results: Mapping[str, Any]) -> str:
    """The settings of the measurement in one line."""
    settings, count = results["settings"], len(results["repeats"])
    if settings.get("log"):
        recorded = f", {settings['selection']}" if settings["selection"] else ""
        return f"{Path(settings['log']).name}, {results['rate_hz']:.1f} Hz{recorded}"
    also = "".join(f", with --{name}" for name in ("record", "view", "trace") if settings.get(name))
    duration = f"{settings['duration_s']:g} s"
    times = f"{count} repeats of {duration}: medians, largest max" if count > 1 else duration
    reached = f" ({results['rate_hz']:.1f} Hz reached)" if results["rate_hz"] else ""  # a single frame has no rate
    return f"{settings['rate_hz']:g} Hz{reached}, {settings['camera']} frames{also}, {times}"
