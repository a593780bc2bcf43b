"""Time for each frame against the numbers of pixels, modes and actuators: the control step alone, and the loop.

Each size has a calibration of random numbers, and noisy frames to match. The step is timed back to back in this
process, from the bytes of a frame to the bytes of a command. The loop is the real one: frame source, controller and
mirror are processes connected by zenoh. The frames are prepared, so that any size is possible without an optical model.
For comparison, two lower bounds are timed: one read of every byte of the step's matrices and vectors (the memory
limit), and its two matrix-vector products.

Example:
    python -m benchmarks curves
    python -m benchmarks curves --pixels 80 256 --modes --actuators --no-loop
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import cycle
from statistics import median
from typing import Any

import numpy as np

from benchmarks.load import sampled_processes, shares
from benchmarks.runner import Lines, Report, Result, add_times, ranged, us
from benchmarks.sizes import FRAMES, Size, configuration, prepared_run, random_calibration
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.realtime import set_up
from lowfc.contract.errors import ConfigurationError, LowfcError
from lowfc.control.loop.safety import LoopMode
from lowfc.programs.measure.control_step import ControlStep
from lowfc.programs.measure.frame_source import Payloads
from lowfc.programs.measure.latency.frame_statistics import WARM_UP_S
from lowfc.programs.measure.latency.run import LatencyOptions, run_repeats

AXES = {
    "pixels": ((32, 48, 64, 80, 128, 192, 256, 384, 512), "side", "sides of square frames: 80 is 80 x 80 pixels"),
    "modes": ((5, 10, 20, 50, 100, 200, 500), "modes", "numbers of modes"),
    "actuators": ((10, 16, 23, 34, 48, 64), "mirror_side", "sides of square mirrors: 34 is 34 x 34 actuators"),
}
"""Sizes of each curve, their field of `Size`, and their description."""
RATE_HZ = 250.0

_STEP = ("step_us", "stream_us", "products_us")
_LOOP = ("frame_to_command_us", "echo_us")


def step_times(size: Size, seconds: float) -> Result:
    """Times of the control step of a loop of this size and of its two lower bounds, each repeated for `seconds`.

    stream_us: one read of `Size.bytes` bytes, by the dot product of their first half with their second; NumPy's sum,
    max, copy and other products read more slowly. products_us: R times a frame, and the modes' shapes times a command.

    Raises:
        RuntimeError: frames were refused or limits acted.
    """
    config = configuration(size, RATE_HZ)
    calibration, frames = random_calibration(size, config)
    step = ControlStep(config, calibration, HostClock().host_ns())
    prepared = Payloads(frames)
    payloads = cycle([prepared.at(index, HostClock().host_ns()) for index in range(FRAMES)])
    times: Result = {"step_us": timed(lambda: step(next(payloads)), seconds)}
    if step.state.mode is not LoopMode.CLOSED or step.state.counts:
        raise RuntimeError(f"{size}: loop {step.state.mode.name.lower()}, refused or limited: {step.state.counts}")
    one_half, other_half = np.ones((2, size.bytes // 8), np.float32)
    times["stream_us"] = timed(lambda: one_half.dot(other_half), seconds)
    R, shapes = calibration.reconstructor, calibration.modes_to_actuators
    pixels, command_nm = calibration.reference, np.ones(size.modes, np.float32)
    times["products_us"] = timed(lambda: (R @ pixels, shapes @ command_nm), seconds)
    return times


def timed(work: Callable[[], object], seconds: float) -> dict[str, float]:
    """p50, p99 and mean processor time (cpu), us, of a call of `work`; the call is repeated for `seconds`."""
    work()
    durations_ns = []
    end_ns = time.perf_counter_ns() + round(seconds * 1e9)
    cpu_ns, done_ns = time.thread_time_ns(), 0
    while done_ns < end_ns:
        begun_ns = time.perf_counter_ns()
        work()
        done_ns = time.perf_counter_ns()
        durations_ns.append(done_ns - begun_ns)
    cpu_ns = time.thread_time_ns() - cpu_ns
    p50_ns, p99_ns = np.percentile(durations_ns, (50, 99))
    return {"p50": p50_ns / 1e3, "p99": p99_ns / 1e3, "cpu": cpu_ns / len(durations_ns) / 1e3}


def loop_latency(size: Size, rate_hz: float, seconds: float) -> Result:
    """Latency of a loop of this size, and half the round trip of a bare echo of its messages; or the `failure`.

    `cpu`: processor time of the controller for each frame.
    """
    try:
        with sampled_processes() as samples, prepared_run(size, config := configuration(size, rate_hz)) as run:
            (measured,) = run_repeats(LatencyOptions(config, seconds, 1), run, lambda _: None)
    except LowfcError as fault:
        return {"failure": str(fault)}
    latency_us = {name: measured["latency_us"]["frame_to_command"][name] for name in ("p50", "p99")}
    used = shares(samples, WARM_UP_S + seconds)
    if "controller" in used:
        latency_us["cpu"] = used["controller"]["share"] * 1e6 / measured["rate_hz"]
    return {
        "frame_to_command_us": latency_us,
        "echo_us": {name: measured["echo_us"][name] / 2 for name in ("p50", "p99")},
        "frames": measured["frames"],
        "frames_without_command": measured["frames_without_command"],
    }


def options(parser: argparse.ArgumentParser) -> None:
    """Add the sizes, and whether the loop is measured too."""
    add_times(parser, seconds=2.0, repeats=3)
    parser.add_argument("--rate", type=float, default=RATE_HZ, help="frames per second of the loop (%(default)g)")
    parser.add_argument("--loop", action=argparse.BooleanOptionalAction, default=True, help="measure the loop too")
    for name, (sizes, _, what) in AXES.items():
        text = f"{what}; without a number, this curve is left out (default: {' '.join(map(str, sizes))})"
        parser.add_argument(f"--{name}", type=int, nargs="*", default=sizes, metavar="N", help=text)


def measure(options: argparse.Namespace, report: Report) -> Result:
    """Measure every point of every curve once in each repeat; `rate_hz` is None if the loop is not measured."""
    curves = {name: [Size(**{field: n}) for n in getattr(options, name)] for name, (_, field, _) in AXES.items()}
    sizes = list(dict.fromkeys(size for curve in curves.values() for size in curve))
    if not sizes:
        raise ConfigurationError("nothing to measure: name sizes of --pixels, --modes or --actuators")
    set_up(None, None, lock_memory=False, disable_cpu_idle=False)
    found: dict[Size, list[Result]] = {size: [] for size in sizes}
    for number in range(1, options.repeats + 1):
        for size in sizes:
            report(
                f"{number} of {options.repeats}: {size.pixels} pixels, {size.modes} modes, {size.actuators} actuators"
            )
            times = step_times(size, options.seconds)
            found[size].append(times | (loop_latency(size, options.rate, options.seconds) if options.loop else {}))
    return {
        "curves": {name: [point(size, found[size]) for size in curve] for name, curve in curves.items()},
        "default": asdict(Size()),
        "seconds": options.seconds,
        "repeats": options.repeats,
        "rate_hz": options.rate if options.loop else None,
        "failed": [f"{size}: {one['failure']}" for size in sizes for one in found[size] if "failure" in one],
    }


def point(size: Size, repeats: Sequence[Result]) -> Result:
    """One point of a curve: medians over the repeats, and the lowest and highest p50."""
    values: Result = {name: getattr(size, name) for name in ("pixels", "modes", "actuators", "bytes")} | asdict(size)
    for name in (*_STEP, *_LOOP):
        if each := [repeat[name] for repeat in repeats if name in repeat]:
            kinds = set.intersection(*map(set, each))
            values[name] = {kind: round(median(one[kind] for one in each), 2) for kind in sorted(kinds)}
            values[name]["spread"] = [round(end(one["p50"] for one in each), 2) for end in (min, max)]
    for name in ("frames", "frames_without_command"):
        if any(name in repeat for repeat in repeats):
            values[name] = sum(repeat.get(name, 0) for repeat in repeats)
    values["failures"] = [repeat["failure"] for repeat in repeats if "failure" in repeat]
    return values


HEADINGS = (
    "step p50, us",
    "step p99, us",
    "step's processor time, us",
    "products alone, us",
    "bytes, MB",
    "read rate, GB/s",
    "memory limit, us",
    "step / memory limit",
    "loop p50, us",
    "loop p99, us",
    "controller's processor time, us",
    "half a bare echo, us",
    "frames without a command",
)


def tables(result: Result) -> list[Lines]:
    """A table for each curve."""
    return [
        [[name, *HEADINGS], *([_label(name, one), *_cells(one)] for one in points)]
        for name, points in result["curves"].items()
        if points
    ]


def _label(name: str, point: Result) -> str:
    side = point[AXES[name][1]]
    return str(side) if AXES[name][1] == name else f"{point[name]} ({side} x {side})"


def _cells(point: Result) -> list[str]:
    step, stream_us, loop = point["step_us"], point["stream_us"]["p50"], point.get("frame_to_command_us")
    cells = [
        ranged([step["p50"], *step["spread"]]),
        *(us(step[kind]) for kind in ("p99", "cpu")),
        us(point["products_us"]["p50"]),
        f"{point['bytes'] / 1e6:.2f}",
        f"{point['bytes'] / stream_us / 1e3:.0f}",
        us(stream_us),
        f"{step['p50'] / stream_us:.1f}",
    ]
    if loop is None:
        return [*cells, "failed" if point["failures"] else "", *[""] * 4]
    return [
        *cells,
        ranged([loop["p50"], *loop["spread"]]),
        us(loop["p99"]),
        us(loop["cpu"]) if "cpu" in loop else "",
        us(point["echo_us"]["p50"]),
        f"{point['frames_without_command']} of {point['frames']}",
    ]


def about(result: Result) -> str:
    """Definitions of the measured quantities."""
    default = Size(**result["default"])
    loops = (
        f"The loop runs at {result['rate_hz']:g} Hz with its real-time set-up; its latency is from just before "
        "publishing a frame to just after sending its command. The controller's processor time is of all its "
        "threads, with telemetry, for each frame."
        if result["rate_hz"]
        else ""
    )
    failed = "".join(f" Failed, {fault}." for fault in result["failed"])
    return (
        f"Medians over {result['repeats']} repeats of {result['seconds']:g} s each; in brackets the range "
        f"of p50. Sizes that a table does not vary: {default.pixels} pixels, {default.modes} modes, "
        f"{default.actuators} actuators. The step: one thread, back to back, normal scheduling, warm caches. The "
        "memory limit: one read of as many bytes as a step must touch, by a float32 dot product of their first half "
        "with their second. "
        f"{loops}{failed}"
    )


# Okabe and Ito's colours, safe for colour blindness; each line also has its own mark and dash.
_DRAWN = (
    ("frame_to_command_us", "p50", "loop: frame to command", "#D55E00", "o", "-"),
    ("frame_to_command_us", "cpu", "loop: controller's processor time", "#E69F00", "^", "--"),
    ("echo_us", "p50", "half a bare echo", "#CC79A7", "v", ":"),
    ("step_us", "p50", "control step", "#0072B2", "s", "-"),
    ("step_us", "cpu", "step's processor time", "#56B4E9", "D", "--"),
    ("products_us", "p50", "two matrix-vector products", "#009E73", "x", "-."),
    ("stream_us", "p50", "memory limit: the step's bytes read once", "#000000", "", ":"),
)


def picture(result: Result) -> bytes:
    """PNG: a panel for each curve, all with the same time scale; ConfigurationError if matplotlib is not installed."""
    from lowfc.adapters.files.drawing import figure_class, png

    drawn = {name: points for name, points in result["curves"].items() if points}
    figure = figure_class()(figsize=(13, 5.5), layout="constrained")
    panels = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
    default = Size(**result["default"])
    lines: dict[str, Any] = {}
    for panel, (name, points) in zip(panels, drawn.items(), strict=True):
        for kind, at, label, color, mark, dash in _DRAWN:
            drawn_points = [(one[name], one[kind][at]) for one in points if at in one.get(kind, {})]
            if drawn_points:
                style = {"color": color, "marker": mark, "linestyle": dash, "markersize": 5}
                (lines[label],) = panel.plot(*zip(*drawn_points, strict=True), **style)
        others = ", ".join(f"{getattr(default, other)} {other}" for other in AXES if other != name)
        panel.set(xscale="log", yscale="log", xlabel=f"{name} (number)", title=others)
        panel.grid(visible=True, which="both", linewidth=0.3)
    panels[0].set_ylabel("us for each frame (p50; processor time: mean)")
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=4, frameon=False)
    return png(figure, dpi=110)
