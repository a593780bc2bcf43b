"""Time of the control step with each kernel, and its ratio to one product R x and to one read of the same memory.

Each turn times, one after the other: the numpy step, the fused step, the product R x, and one read of every byte that a
step must touch. Ratios are taken within a turn.

Example:
    python -m benchmarks kernels --side 80 256 --repeats 9
"""

import argparse
from collections.abc import Callable
from itertools import cycle, product
from statistics import median

import numpy as np

from benchmarks.curves import RATE_HZ, timed
from benchmarks.runner import Lines, Report, Result, add_times, ranged
from benchmarks.sizes import FRAMES, Size, configuration, random_calibration
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.realtime import set_up
from lowfc.control.kernel.tables import KERNELS
from lowfc.programs.measure.control_step import ControlStep
from lowfc.programs.measure.frame_source import Payloads

SIDES = (80, 256, 512)
PRODUCT, MEMORY = "product", "memory"


def options(parser: argparse.ArgumentParser) -> None:
    """Add the sizes, the duration and the repeats."""
    add_times(parser, seconds=0.3, repeats=9)
    parser.add_argument(
        "--side", type=int, nargs="+", default=SIDES, metavar="N", help="pixels across the square frame (%(default)s)"
    )


def measure(options: argparse.Namespace, report: Report) -> Result:
    """Measure each size in turns: p50 of numpy, fused, product and memory in us, and their ratios."""
    set_up(None, None, lock_memory=False, disable_cpu_idle=False)
    sizes = []
    for side in options.side:
        size = Size(side)
        calls = _timed_calls(size)
        turns = []
        for number in range(options.repeats):
            report(f"{size.pixels} pixels, {number + 1} of {options.repeats}")
            turns.append({name: timed(call, options.seconds)["p50"] for name, call in calls.items()})
        numpy_kernel, fused = KERNELS
        pairs = (*product(KERNELS, (PRODUCT, MEMORY)), (fused, numpy_kernel))
        ratios = {f"{one} over {other}": [turn[one] / turn[other] for turn in turns] for one, other in pairs}
        numbers = {"pixels": size.pixels, "modes": size.modes, "actuators": size.actuators}
        sizes.append(numbers | {"turns": turns, "ratios": ratios})
    return {"sizes": sizes}


def tables(found: Result) -> list[Lines]:
    """A row for each size and ratio."""
    head = ["pixels", "ratio of times", "median (range)"]
    lines = [
        [str(one["pixels"]), name.replace(" over ", " / "), ranged(ratios, "{:.2f}".format)]
        for one in found["sizes"]
        for name, ratios in one["ratios"].items()
    ]
    return [[head, *lines]]


def about(found: Result) -> str:
    """Median times, in us, and the sizes, as sentences."""
    first = found["sizes"][0]
    each = [
        f"{one['pixels']} pixels: "
        + ", ".join(f"{name} {median(turn[name] for turn in one['turns']):.1f}" for name in one["turns"][0])
        for one in found["sizes"]
    ]
    return (
        f"p50 in us, medians over {len(first['turns'])} turns: {'; '.join(each)}. {first['modes']} modes, "
        f"{first['actuators']} actuators."
    )


def _timed_calls(size: Size) -> dict[str, Callable[[], object]]:
    calibration, frames = random_calibration(size, configuration(size, RATE_HZ))
    prepared = Payloads(frames)
    payloads = cycle([prepared.at(index, HostClock().host_ns()) for index in range(FRAMES)])
    R, x = calibration.reconstructor, np.random.default_rng(1).standard_normal(size.pixels, np.float32)
    one_half, other_half = np.ones((2, size.bytes // 8), np.float32)

    def step(kernel: str) -> Callable[[], object]:
        control_step = ControlStep(configuration(size, RATE_HZ, kernel=kernel), calibration, HostClock().host_ns())
        return lambda: control_step(next(payloads))

    steps = {kernel: step(kernel) for kernel in KERNELS}
    return steps | {PRODUCT: lambda: R @ x, MEMORY: lambda: one_half.dot(other_half)}
