"""The drawings of a report."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array
from lowfc.contract.printable import printable
from lowfc.control.loop.safety import Limit
from lowfc.programs.logs.report.residual import bin_starts, binned_rms
from lowfc.programs.logs.report.results import Report
from lowfc.programs.logs.report.svg import COLOURS, svg
from lowfc.programs.logs.report.timing import intervals_ns, latencies_ns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


INK, FAINT, OPEN, CLOSED = (COLOURS[name] for name in ("ink", "faint", "open", "closed"))
_MODES = {"open": OPEN, "closed": CLOSED, "safe": COLOURS["safe"], "idle": FAINT}
_BESIDE_TRUTH: dict[str, Any] = {"linestyle": ":", "linewidth": 0.9, "alpha": 0.7}
"""Style of measured curves if the log also has the true values."""
_LIMIT_DRAWN_FROM = 0.25
"""The stroke limit is drawn if more than this fraction of it is used."""
_MAX_MARKS = 300  # of one kind in a drawing
_SECONDS = "seconds since the first step"


def drawings(report: Report, progress: Callable[[str], None] = lambda name: None) -> dict[str, str]:
    """SVG of every drawing for which the log has data, by name."""
    found = {}
    for name, (height_in, draw) in _DRAWINGS.items():
        progress(name)
        drawn = svg(name, height_in, draw, report)
        if drawn is not None:
            found[name] = drawn
    return found


def _overview(figure: "Figure", report: Report) -> bool:
    run = report.run
    if not run.history.steps.sequence.size:
        return False
    band, plot = figure.subplots(2, 1, sharex=True, height_ratios=(1, 6))
    _mode_band(band, report)
    binned = binned_rms(run)
    time_s = binned["time_s"]
    true = "disturbance" in binned
    names = (
        ("disturbance", "before: true disturbance", OPEN),
        ("residual", "after: true residual", CLOSED),
        ("pseudo_open_loop", "before: pseudo-open-loop", OPEN),
        ("error", "after: measured error", CLOSED),
    )
    for name, label, colour in names:
        if name in binned and np.isfinite(binned[name]).any():
            style = _BESIDE_TRUTH if true and name in ("pseudo_open_loop", "error") else {}
            plot.plot(time_s, binned[name], label=label, color=colour, **style)
    plot.set(ylabel="all modes, nm rms", xlabel=_SECONDS)
    plot.set_ylim(bottom=0)
    if plot.lines:
        plot.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=4)
    return True


def _mode_band(axes: "Axes", report: Report) -> None:
    shown: set[str] = set()
    end_s = max(float(report.run.step_s[-1]), 1e-9)
    for span in report.results["mode_spans"]:
        name, width_s = span["mode"], span["to_s"] - span["from_s"]
        axes.broken_barh([(span["from_s"], width_s)], (0, 1), facecolor=_MODES.get(name, FAINT))
        if width_s > 0.06 * end_s:
            middle_s = span["from_s"] + width_s / 2
            axes.text(middle_s, 0.45, name, ha="center", va="center", fontweight="bold", color=COLOURS["paper"])
        elif name not in shown:
            axes.text(span["from_s"], 1.1, name, ha="left", va="bottom", fontsize=8)
        shown.add(name)
    axes.set(ylim=(0, 1), yticks=[], ylabel="loop")
    axes.grid(visible=False)
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(axis="x", length=0)


def _intervals(figure: "Figure", report: Report) -> bool:
    found = {name: values * 1e-3 for name, values in intervals_ns(report.run).items() if values.size}
    stages = {name: values * 1e-3 for name, values in latencies_ns(report.run.history).items() if values.size}
    if not found and not stages:
        return False
    left, right = figure.subplots(1, 2)
    if found:
        everything = np.concatenate(list(found.values()))
        low, high = np.percentile(everything, [0.1, 99.9])
        edges = np.linspace(low, max(high, low + 1.0), 80)
        for (name, values), colour, style in zip(found.items(), (INK, COLOURS["other"]), ("-", "--"), strict=False):
            counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
            left.stairs(counts, edges, label=name, color=colour, linestyle=style, linewidth=1.2)
        left.set(yscale="log", xlabel="interval, µs (outer bins: all values beyond)", ylabel="intervals")
        left.legend()
    colours = (COLOURS["other"], COLOURS["another"], FAINT, COLOURS["error"], INK, INK)
    styles = ("-", "--", "-.", ":", "-", "--")
    for (name, values), colour, style in zip(stages.items(), colours, styles, strict=False):
        ordered = np.sort(values)
        ranks = np.geomspace(1, ordered.size, min(400, ordered.size)).astype(np.int64)
        keep = ordered.size - np.unique(ranks)[::-1]  # denser towards the longest latency, which is kept
        beyond = 1 - keep / ordered.size
        right.plot(np.maximum(ordered[keep], 0.1), beyond, label=name.replace("_", " "), color=colour, linestyle=style)
    if stages:
        right.set(xscale="log", yscale="log", xlabel="latency, µs", ylabel="fraction of frames that take longer")
        right.legend(loc="lower left")
    return True


def _residual(figure: "Figure", report: Report) -> bool:
    """Bars of each mode, before and after correction; true values are filled, measured values hatched."""
    modes = report.results["residual"]["modes"]
    kinds = (
        ("disturbance", "true disturbance", OPEN, True),
        ("residual", "true residual", CLOSED, True),
        ("pseudo_open_loop", "pseudo-open-loop", OPEN, False),
        ("error", "measured error", CLOSED, False),
        ("open_error", "measured error, loop open", OPEN, False),
    )
    present = [kind for kind in kinds if modes and modes[0][f"{kind[0]}_rms_nm"] is not None]
    if len(present) > 1:
        present = [kind for kind in present if kind[0] != "open_error"]
    if not present:
        return False
    axes = figure.subplots()
    width = 0.8 / len(present)
    for place, (key, label, colour, filled) in enumerate(present):
        heights = [mode[f"{key}_rms_nm"] for mode in modes]
        left = np.arange(len(modes)) - 0.4 + (place + 0.5) * width
        style: dict[str, Any] = {"facecolor": colour}
        if not filled:
            style = {"facecolor": "none", "edgecolor": colour, "hatch": "//////"}
        axes.bar(left, heights, 0.92 * width, label=label, **style)
    names = [f"Z{mode['noll']} {mode['name']}" for mode in modes]
    axes.set_xticks(range(len(modes)), names, rotation=35, ha="right", rotation_mode="anchor")
    axes.set_ylabel("nm rms")
    axes.grid(visible=False, axis="x")
    axes.legend(ncols=len(present), loc="upper right")
    return True


def _spectra(figure: "Figure", report: Report) -> bool:
    groups = report.results["spectra"].get("groups")
    if not groups:
        return False
    grid = figure.subplots(2, len(groups), sharex=True, squeeze=False, height_ratios=(3, 2))
    for column, group in enumerate(groups):
        above, below = grid[0][column], grid[1][column]
        frequency_hz, power = group["frequency_hz"], {k: np.array(v) for k, v in group["power_nm2_hz"].items()}
        true = "disturbance" in power
        style = _BESIDE_TRUTH if true else {}
        above.plot(frequency_hz, power["pseudo_open_loop"], color=OPEN, label="open: pseudo-open-loop", **style)
        above.plot(frequency_hz, power["error"], color=CLOSED, label="closed: measured error", **style)
        ratio = np.sqrt(_ratio(power["error"], power["pseudo_open_loop"]))
        theory = np.sqrt(_ratio(power["error_predicted"], power["pseudo_open_loop"]))
        below.plot(frequency_hz, ratio, color=CLOSED, label="measured error / pseudo-open-loop", **style)
        below.plot(frequency_hz, theory, color=INK, linestyle="--", linewidth=0.9, label="theory: rejection")
        if true:
            above.plot(frequency_hz, power["disturbance"], color=OPEN, label="open: true disturbance")
            above.plot(frequency_hz, power["residual"], color=CLOSED, label="closed: true residual")
            lowest = 1e-3 * min(power["residual"].min(), power["error"].min())
            above.set_ylim(bottom=max(lowest, 1e-2 * power["residual"].min()))
        if "residual_predicted" in power:
            style = {"color": INK, "linestyle": "--", "linewidth": 0.9}
            above.plot(frequency_hz, power["residual_predicted"], label="closed: theory, rejection and noise", **style)
            above_noise = power["disturbance_left"] > 0.5 * power["residual_predicted"]
            rejected = np.where(above_noise, np.sqrt(_ratio(power["residual"], power["disturbance"])), np.nan)
            label = "true residual / disturbance, where noise is lower"
            below.plot(frequency_hz, rejected, "o", color=CLOSED, markersize=4, markerfacecolor="none", label=label)
        above.set(title=group["name"], xscale="log", yscale="log")
        below.set(xscale="log", yscale="log", xlabel="frequency, Hz")
        below.set_ylim(bottom=min(0.1, 0.8 * float(np.nanmin(theory))))
        for axes in (above, below):
            axes.yaxis.set_minor_formatter("")
    grid[0][0].set_ylabel("nm²/Hz")
    grid[1][0].set_ylabel("closed / open, amplitude")
    (handles, labels), (below_handles, below_labels) = (row[0].get_legend_handles_labels() for row in grid)
    figure.legend(handles + below_handles, labels + below_labels, loc="outside lower center", ncols=3)
    return True


def _ratio(numerator: Array, denominator: Array) -> Array:
    return np.divide(numerator, denominator, out=np.full_like(numerator, np.nan), where=denominator > 0)


def _budget(figure: "Figure", report: Report) -> bool:
    budget = report.results["error_budget"]
    if "why_not" in budget:
        return False
    rows = [(term["name"], term["rms_nm"], term["upper_limit"]) for term in budget["terms"] if not term["missing"]]
    rows.append(("sum of the terms", budget["sum"]["rms_nm"], []))
    if report.results["closed_stretch"]["true"] and not report.results["residual"]["shaped"]:
        rows.append(("true residual", budget["true_residual"]["rms_nm"], []))
    groups = [name for name in budget["sum"]["rms_nm"] if name != "all modes"]
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axes, group in zip(panels, groups, strict=True):
        for place, (name, values, upper_limits) in enumerate(rows):
            if values[group] is None:
                continue
            colour = {"sum of the terms": INK, "true residual": CLOSED}.get(name, COLOURS["other"])
            is_upper_limit = group in upper_limits
            style: dict[str, Any] = {"facecolor": colour}
            if is_upper_limit:
                style = {"facecolor": "none", "edgecolor": colour, "linestyle": "--"}
            axes.barh(place, values[group], 0.6, **style)
            axes.text(
                values[group], place, f" {'< ' if is_upper_limit else ''}{values[group]:.2g}", va="center", fontsize=8
            )
        axes.set(title=group, xlabel="nm rms")
        axes.grid(visible=False, axis="y")
        axes.margins(x=0.2)
    panels[0].set_yticks(range(len(rows)), [name for name, _, _ in rows])
    panels[0].invert_yaxis()
    return True


def _light(figure: "Figure", report: Report) -> bool:
    steps, time_s = report.run.history.steps, report.run.step_s
    if not time_s.size:
        return False
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    starts = bin_starts(time_s.size, 600)
    flux = np.where(steps.flux_dn > 0, steps.flux_dn, np.nan)
    _envelope(upper, time_s[starts], flux, starts, INK)
    refused = (steps.reasons & ((1 << Limit.MODAL_LIMIT) - 1)) != 0
    if refused.any():
        marks = time_s[refused][bin_starts(int(refused.sum()), _MAX_MARKS)]
        style: dict[str, Any] = {"color": COLOURS["error"], "markersize": 5, "clip_on": False}
        upper.plot(marks, np.zeros(marks.size), "x", label="frame refused", **style)
    expected = report.results["light"]["flux_expected_dn"]
    if expected is not None:
        upper.axhline(expected, color=FAINT, linestyle="--", linewidth=1.0, label="expected by the calibration")
    upper.set_ylim(bottom=0)
    upper.set_ylabel("flux, DN")
    if upper.get_legend_handles_labels()[0]:
        upper.legend(loc="lower right", ncols=2)
    most = np.maximum.reduceat(steps.saturated_pixels, starts)
    lower.fill_between(time_s[starts], most, step="post", color=INK, alpha=0.7, linewidth=0)
    lower.set(ylabel="saturated\npixels", xlabel=_SECONDS, ylim=(0, max(1, 1.1 * float(most.max()))))
    return True


def _timeline(figure: "Figure", report: Report) -> bool:
    events, requests = report.results["events"], report.results["requests"]
    if not events and not report.results["mode_spans"]:
        return False
    band, axes = figure.subplots(2, 1, sharex=True, height_ratios=(1, 4))
    if report.results["mode_spans"]:
        _mode_band(band, report)
    else:
        band.set_axis_off()
    levels = ("request", "info", "warning", "error")
    markers = {"info": ("o", INK, "none"), "warning": ("^", INK, OPEN), "error": ("X", INK, COLOURS["error"])}
    for level, (marker, edge, face) in markers.items():
        included = (level, "fatal") if level == "error" else (level,)
        found = [event["time_s"] for event in events if event["level"] in included]
        times_s = np.array(found)[bin_starts(len(found), _MAX_MARKS)]
        place = np.full(times_s.size, levels.index(level))
        axes.plot(times_s, place, marker, markeredgecolor=edge, markerfacecolor=face, markersize=7, linestyle="none")
    shown = [requests[place] for place in bin_starts(len(requests), _MAX_MARKS)]
    for number, request in enumerate(shown):
        axes.axvline(request["time_s"], color=FAINT, linewidth=0.8, linestyle=":")
        values = " ".join(f"{value:g}" for value in request["values"][:2])
        text = f"{printable(request['name'])} {values}{'' if request['accepted'] else ' refused'}".strip()
        height = 0.25 * (number % 3 - 1)
        axes.text(request["time_s"], height, f" {text}", va="center", fontsize=8, parse_math=False)
        axes.plot(request["time_s"], 0, "|", color=INK, markersize=9)
    axes.set(ylim=(-0.7, 3.6), xlabel=_SECONDS)
    axes.set_yticks(range(len(levels)), levels)
    return True


def _stroke(figure: "Figure", report: Report) -> bool:
    mirror = report.run.history.mirror
    if not mirror.sequence.size:
        return False
    plot, image = figure.subplots(1, 2, width_ratios=(2, 1))
    time_s = report.run.seconds(mirror.publish_time_ns)
    starts = bin_starts(time_s.size, 600)
    _envelope(plot, time_s[starts], mirror.stroke_nm, starts, CLOSED)
    results = report.results["mirror"]
    limit_nm, title = results["stroke_limit_nm"], "over time"
    if limit_nm is not None:
        title += f"; the limit is {limit_nm:g} nm"
        if results["stroke_most_share"] > _LIMIT_DRAWN_FROM:  # otherwise it would flatten the curve
            plot.axhline(limit_nm, color=COLOURS["error"], linestyle="--")
    plot.set(ylabel="largest |actuator|, nm of surface", xlabel=_SECONDS, title=title)
    plot.set_ylim(bottom=0)
    extremes = np.maximum(np.abs(mirror.highest_nm), np.abs(mirror.lowest_nm))  # from flat
    shown = image.imshow(extremes, cmap="cividis", vmin=0, interpolation="nearest", origin="lower")
    figure.colorbar(shown, ax=image, label="nm of surface")
    share = f",\nat most {results['stroke_most_share']:.1%} of the limit" if limit_nm is not None else ""
    image.set(title=f"extreme of each actuator{share}", xlabel="column", ylabel="row")
    image.locator_params(integer=True)
    image.grid(visible=False)
    return True


def _envelope(axes: "Axes", time_s: Array, values: npt.NDArray[np.floating], starts: Any, colour: str) -> None:
    """Draw the range of the values in each bin, and the middle of the range as a line."""
    least, most = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    axes.fill_between(time_s, least, most, color=colour, alpha=0.25, linewidth=0)
    axes.plot(time_s, (least + most) / 2, color=colour, linewidth=1.0)


_DRAWINGS: dict[str, tuple[float, Callable[["Figure", Report], bool]]] = {
    "overview": (3.2, _overview),
    "intervals": (3.4, _intervals),
    "residual": (3.6, _residual),
    "spectra": (5.6, _spectra),
    "budget": (3.0, _budget),
    "light": (3.0, _light),
    "timeline": (3.0, _timeline),
    "stroke": (3.6, _stroke),
}
