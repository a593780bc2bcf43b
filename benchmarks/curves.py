"""What a frame costs, against the numbers of pixels, modes and actuators: the control step alone, and the loop.

Of each size a calibration is made up, random numbers in arrays of its shape, and noisy frames to go with it. The step
is timed from a frame's bytes to a command's, one after the other, in this process. The loop is the real one: a source
of prepared frames, zenoh, controller and mirror, each a process; no optical model is needed, so every size can be had.
Beside them stand what the step cannot do without: reading every byte of its matrices and vectors once, which is the
limit that memory sets, and its two matrix-vector products.

Example:
    python -m benchmarks.curves --markdown --plot curves.png
    python -m benchmarks.curves --pixels 80 256 --modes --actuators --no-loop
"""

import argparse
import contextlib
import os
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from astropy.io.fits.verify import VerifyWarning
from rich.console import Console

from benchmarks import cells
from benchmarks.command import add_forms, occasion, run_main, say
from benchmarks.load import Watched
from benchmarks.sizes import FRAMES, Size, configuration, made_up
from lowfc.adapters import calibration_file
from lowfc.adapters.clock import HostClock
from lowfc.adapters.progress import passing_bar
from lowfc.adapters.realtime import set_up
from lowfc.adapters.run import Run, new_run_id, open_run
from lowfc.adapters.whole_file import require_folder, write_whole
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import Role
from lowfc.control.safety import LoopMode
from lowfc.programs.control_step import ControlStep
from lowfc.programs.frame_source import FRAMES_FILE, Payloads
from lowfc.programs.latency.figures import WARM_UP_S
from lowfc.programs.latency.run import Asked, run_repeats

Figures = dict[str, Any]

SIDES = (32, 48, 64, 80, 128, 192, 256, 384, 512)
MODES = (5, 10, 20, 50, 100, 200, 500)
MIRROR_SIDES = (10, 16, 23, 34, 48, 64)
RATE_HZ = 250.0

_STEP = ("step_us", "stream_us", "products_us")
_LOOP = ("frame_to_command_us", "echo_us")


def step_figures(size: Size, seconds: float) -> Figures:
    """The control step of that size, and beside it what it cannot do without.

    Args:
        size: of the calibration and the frames.
        seconds: for which each of the three is done over and over.

    Returns:
        step_us, stream_us (as many bytes as `Size.bytes` read once, by the dot product of one half with the other: of
        NumPy's sum, max, copy and products the fastest reader) and products_us (R with a frame, the modes' shapes with
        a command); each p50, p99 and cpu.

    Raises:
        RuntimeError: the step did not go its usual way.
    """
    config = configuration(size, RATE_HZ)
    calibration, frames = made_up(size, config)
    step = ControlStep(config, calibration, HostClock().host_ns())
    made = Payloads(frames)
    payloads = cycle([made.at(index, HostClock().host_ns()) for index in range(FRAMES)])
    figures: Figures = {"step_us": timed(lambda: step(next(payloads)), seconds)}
    if step.state.mode is not LoopMode.CLOSED or step.state.counts:
        raise RuntimeError(f"{size}: the step is {step.state.mode.name.lower()}, and was {step.state.counts}")
    one_half, other_half = np.ones((2, size.bytes // 8), np.float32)
    figures["stream_us"] = timed(lambda: one_half.dot(other_half), seconds)
    R, shapes = calibration.reconstructor, calibration.modes_to_actuators
    pixels, command_nm = calibration.reference, np.ones(size.modes, np.float32)
    figures["products_us"] = timed(lambda: (R @ pixels, shapes @ command_nm), seconds)
    return figures


def timed(work: Callable[[], object], seconds: float) -> dict[str, float]:
    """p50 and p99 of doing it over and over for so long, and the processor time (cpu) that one takes, us."""
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


def loop_figures(size: Size, rate_hz: float, seconds: float) -> Figures:
    """The loop of that size, and a bare echo of its messages.

    Args:
        size: of the calibration and the frames.
        rate_hz: of the frames.
        seconds: for how long.

    Returns:
        frame_to_command_us (p50 and p99; cpu: the controller's, for each frame), echo_us (p50 and p99 of half a round
        trip), frames and frames_without_command; or failure, what was wrong.
    """
    config = configuration(size, rate_hz)
    try:
        with _prepared(size, config) as run, Watched(os.getpid()) as watched:
            (found,) = run_repeats(Asked(config, seconds, 1), run, lambda _: None)
    except LowfcError as fault:
        return {"failure": str(fault)}
    taken = {name: found["latency_us"]["frame_to_command"][name] for name in ("p50", "p99")}
    used = watched.shares(WARM_UP_S + seconds)
    if "controller" in used:
        taken["cpu"] = used["controller"].share * 1e6 / found["rate_hz"]
    return {
        "frame_to_command_us": taken,
        "echo_us": {name: found["echo_us"][name] / 2 for name in ("p50", "p99")},
        "frames": found["frames"],
        "frames_without_command": found["frames_without_command"],
    }


@contextlib.contextmanager
def _prepared(size: Size, config: Configuration) -> Iterator[Run]:
    """A run with a made-up calibration and frames in place of the instrument's."""
    run = open_run(new_run_id(), (config.mirror.name,), listeners=(Role.LAUNCHER,))
    try:
        calibration, frames = made_up(size, config)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", VerifyWarning)  # hundreds of modes leave no room for a card's comment
            calibration_file.save(calibration, run.path / "calibration.fits")
        (run.path / "config.toml").write_text(config.to_toml(), encoding="utf-8")
        np.save(run.path / FRAMES_FILE, frames)
        yield run
    finally:
        run.remove()


def measure(
    curves: dict[str, list[Size]], seconds: float, repeats: int, rate_hz: float | None, told: Callable[[str], None]
) -> dict[str, list[Figures]]:
    """Every point of every curve, the repeats around all of them; rate_hz None leaves the loop out.

    Returns:
        Of each curve its points: pixels, modes, actuators, bytes, and of `step_figures` and `loop_figures` the medians
        over the repeats, `spread` with the lowest and highest p50; failures where a loop failed.
    """
    sizes = list(dict.fromkeys(size for curve in curves.values() for size in curve))
    found: dict[Size, list[Figures]] = {size: [] for size in sizes}
    for number in range(1, repeats + 1):
        for size in sizes:
            told(f"{number} of {repeats}: {size.pixels} pixels, {size.modes} modes, {size.actuators} actuators")
            figures = step_figures(size, seconds)
            found[size].append(figures | (loop_figures(size, rate_hz, seconds) if rate_hz else {}))
    return {name: [point(size, found[size]) for size in curve] for name, curve in curves.items()}


def point(size: Size, repeats: Sequence[Figures]) -> Figures:
    """One point of a curve from its repeats."""
    made: Figures = {name: getattr(size, name) for name in ("pixels", "modes", "actuators", "bytes")}
    made |= asdict(size)
    for name in (*_STEP, *_LOOP):
        each = [repeat[name] for repeat in repeats if name in repeat]
        if each:
            kinds = [kind for kind in each[0] if all(kind in one for one in each)]
            made[name] = {kind: round(median(one[kind] for one in each), 2) for kind in kinds}
            p50 = [one["p50"] for one in each]
            made[name]["spread"] = [round(min(p50), 2), round(max(p50), 2)]
    for name in ("frames", "frames_without_command"):
        if any(name in repeat for repeat in repeats):
            made[name] = sum(repeat.get(name, 0) for repeat in repeats)
    made["failures"] = [repeat["failure"] for repeat in repeats if "failure" in repeat]
    return made


HEADINGS = (
    "step p50, us",
    "p99",
    "cpu",
    "products alone",
    "bytes, MB",
    "read at, GB/s",
    "memory's limit, us",
    "step of the limit",
    "loop p50, us",
    "p99",
    "controller's cpu",
    "half a bare echo",
    "frames without a command",
)
AXES = {"pixels": "side", "modes": "modes", "actuators": "mirror_side"}


def tables(result: Figures) -> dict[str, list[list[str]]]:
    """Of each curve its table, headings first."""
    return {
        name: [[name, *HEADINGS], *([_label(name, one), *_cells(one)] for one in points)]
        for name, points in result["curves"].items()
        if points
    }


def _label(name: str, one: Figures) -> str:
    return str(one[name]) if AXES[name] == name else f"{one[name]} ({one[AXES[name]]} x {one[AXES[name]]})"


def _cells(one: Figures) -> list[str]:
    step, stream_us, loop = one["step_us"], one["stream_us"]["p50"], one.get("frame_to_command_us")
    made = [
        _with_spread(step),
        *(_us(step[kind]) for kind in ("p99", "cpu")),
        _us(one["products_us"]["p50"]),
        f"{one['bytes'] / 1e6:.2f}",
        f"{one['bytes'] / stream_us / 1e3:.0f}",
        _us(stream_us),
        f"{step['p50'] / stream_us:.1f}",
    ]
    if loop is None:
        return [*made, "failed" if one["failures"] else "", *[""] * 4]
    return [
        *made,
        _with_spread(loop),
        _us(loop["p99"]),
        _us(loop["cpu"]) if "cpu" in loop else "",
        _us(one["echo_us"]["p50"]),
        f"{one['frames_without_command']} of {one['frames']}",
    ]


def _us(value: float) -> str:
    return f"{value:.{1 if value < 100 else 0}f}"


def _with_spread(figures: Figures) -> str:
    low, high = figures["spread"]
    return f"{_us(figures['p50'])} ({_us(low)} to {_us(high)})"


def about(result: Figures) -> str:
    """What the figures are, and of which host."""
    where, default = result["host"], Size(**result["default"])
    loops = (
        f"The loop runs at {result['rate_hz']:g} Hz, real-time set-up included; from just before a frame's put to just "
        "after its command's; the controller's cpu is that of all its threads, telemetry included, for each frame. "
        if result["rate_hz"]
        else ""
    )
    failures = "".join(
        f"Failed, {_label(name, one)} {name}: {fault}. "
        for name, points in result["curves"].items()
        for one in points
        for fault in one["failures"]
    )
    return (
        f"us; medians over {result['repeats']} repeats of {result['seconds']:g} s each, in brackets the lowest and "
        f"highest p50. What is not on the axis is {default.pixels} pixels, {default.modes} modes, {default.actuators} "
        "actuators. The step: one thread, one after the other, normal scheduling, matrices as warm as the caches keep "
        "them. The limit: as many bytes as a step must touch, read once, by a float32 dot product of one half with the "
        f"other. {loops}{failures}Measured {result['date']} on {where['processors']} processors of "
        f"{where['processor']}, Linux {where['kernel']}, Python {where['python']}, load {result['load_before']:g} "
        f"before, by `{result['command']}`."
    )


def text(result: Figures) -> str:
    """The result for a terminal."""
    return "\n\n".join([*(cells.text(lines) for lines in tables(result).values()), about(result)])


def markdown(result: Figures) -> str:
    """The result for a document."""
    return "\n\n".join([*(cells.markdown(lines) for lines in tables(result).values()), about(result)])


# Okabe and Ito's colours, told apart by every eye; and each line has a mark and a dash of its own.
_DRAWN = (
    ("frame_to_command_us", "p50", "loop: frame to command", "#D55E00", "o", "-"),
    ("frame_to_command_us", "cpu", "loop: controller's processor time", "#E69F00", "^", "--"),
    ("echo_us", "p50", "half a bare echo", "#CC79A7", "v", ":"),
    ("step_us", "p50", "control step", "#0072B2", "s", "-"),
    ("step_us", "cpu", "step's processor time", "#56B4E9", "D", "--"),
    ("products_us", "p50", "two matrix-vector products", "#009E73", "x", "-."),
    ("stream_us", "p50", "memory's limit: its bytes read once", "#000000", "", ":"),
)


def picture(result: Figures) -> bytes:
    """PNG: a panel for each curve, all on one scale of time.

    Raises:
        ConfigurationError: matplotlib is not installed.
    """
    from lowfc.adapters.drawing import figure_class, png

    drawn = {name: points for name, points in result["curves"].items() if points}
    figure = figure_class()(figsize=(13, 5.5), layout="constrained")
    panels = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
    default = Size(**result["default"])
    lines: dict[str, Any] = {}
    for panel, (name, points) in zip(panels, drawn.items(), strict=True):
        for kind, at, label, color, mark, dash in _DRAWN:
            known = [(one[name], one[kind][at]) for one in points if at in one.get(kind, {})]
            if known:
                style = {"color": color, "marker": mark, "linestyle": dash, "markersize": 5}
                (lines[label],) = panel.plot(*zip(*known, strict=True), **style)
        others = ", ".join(f"{getattr(default, other)} {other}" for other in AXES if other != name)
        panel.set(xscale="log", yscale="log", xlabel=f"{name} (number)", title=others)
        panel.grid(visible=True, which="both", linewidth=0.3)
    panels[0].set_ylabel("us for each frame (p50; processor time: mean)")
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=4, frameon=False)
    return png(figure, dpi=110)


def main() -> int:
    """The command line; returns its exit status."""
    asked = _parser().parse_args()
    curves = {
        "pixels": [Size(side=side) for side in asked.pixels],
        "modes": [Size(modes=modes) for modes in asked.modes],
        "actuators": [Size(mirror_side=side) for side in asked.actuators],
    }
    if not any(curves.values()):
        raise SystemExit("nothing to measure: name sizes of --pixels, --modes or --actuators")
    require_folder(asked.plot)
    measured = occasion("python -m benchmarks.curves")
    set_up(None, None, lock_memory=False, stay_awake=False)
    with passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task("curves", total=None)
        rate_hz = asked.rate if asked.loop else None
        found = measure(curves, asked.seconds, asked.repeats, rate_hz, lambda what: bar.update(task, description=what))
    result = {
        "curves": found,
        "default": asdict(Size()),
        "seconds": asked.seconds,
        "repeats": asked.repeats,
        "rate_hz": rate_hz,
        **measured,
    }
    if asked.plot is not None:
        write_whole(asked.plot, picture(result))
    say(result, asked, text, markdown)
    return 1 if any(one["failures"] for points in found.values() for one in points) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.curves", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement (%(default)g)")
    parser.add_argument("--repeats", type=int, default=3, help="of everything (%(default)s)")
    parser.add_argument("--rate", type=float, default=RATE_HZ, help="frames per second of the loop (%(default)g)")
    parser.add_argument("--loop", action=argparse.BooleanOptionalAction, default=True, help="the loop too")
    for name, values, what in (
        ("pixels", SIDES, "across the frame"),
        ("modes", MODES, "how many"),
        ("actuators", MIRROR_SIDES, "across the mirror"),
    ):
        parser.add_argument(f"--{name}", type=int, nargs="*", default=values, metavar="N", help=f"{what} (%(default)s)")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the curves")
    add_forms(parser, "the tables")
    return parser


if __name__ == "__main__":
    run_main(main)
