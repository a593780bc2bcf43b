"""Time of each stage of the control step, and of one matrix-vector product of the same size in the same run.

The step is the loop's own, from a frame's bytes to a command's, with a random calibration of 6400 pixels, 20 modes and
1156 actuators. The step and the product R x are timed separately, each call directly after the last (back to back), and
once per frame period as in the loop (paced). Then the step is timed stage by stage, which takes a little longer.

Example:
    python -m benchmarks step --seconds 5
"""

import argparse
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.runner import Lines, Report, Result, add_times
from benchmarks.sizes import Size, configuration, random_calibration
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.realtime import set_up
from lowfc.arrays import Long
from lowfc.contract.codecs import codec
from lowfc.control.kernel import stepping
from lowfc.control.loop import advance
from lowfc.control.loop.estimator import Estimator
from lowfc.control.loop.safety import LoopMode
from lowfc.programs.measure.control_step import ControlStep, time_alone
from lowfc.programs.measure.frame_source import Payloads
from lowfc.programs.measure.latency.frame_statistics import percentiles

RATE_HZ = 1000.0
STAGES: dict[str, tuple[Any, str]] = {
    "decode": (codec, "decode_frame"),
    "saturation": (advance, "saturated_pixels"),
    "estimate": (Estimator, "estimate"),
    "command seen": (stepping, "seen_nm"),
    "law": (stepping, "integrate"),
    "limits": (stepping, "limit"),
    "encode": (codec, "encode_command"),
}
"""Stages of the step: for each, the function that is timed, as its owner (module or class) and its name."""
REMAINDER, STEP, PRODUCT = "modes to actuators, state, step message", "the whole step", "one product R x"
_WARM_UP = 200  # steps before memory is measured, and again while it is traced
_TRACED = 1000  # steps whose memory is measured


def options(parser: argparse.ArgumentParser) -> None:
    """Add the option for the duration."""
    add_times(parser, seconds=5.0)


def measure(options: argparse.Namespace, report: Report) -> Result:
    """Time the stages: percentiles by stage, and the ratio of the step to the product; back to back and paced."""
    size = Size()
    config = configuration(size, RATE_HZ)
    calibration, frames = random_calibration(size, config)
    payloads = Payloads(frames)
    granted = set_up(config.realtime.priority or None, None, lock_memory=True, disable_cpu_idle=True)
    step = ControlStep(config, calibration, 0)
    memory = allocated(step, payloads)
    x = np.random.default_rng(1).standard_normal(size.pixels, np.float32)
    found: Result = {}
    for name, period_ns in (("hot_us", None), ("paced_us", config.period_ns)):
        report(name)
        durations = _timed(step, payloads, lambda _: calibration.reconstructor @ x, options.seconds, period_ns)
        found[name] = {stage: percentiles(each / 1e3) for stage, each in durations.items()}
    if step.state.mode is not LoopMode.CLOSED or step.state.counts:
        raise ValueError(f"frames were refused or limits acted: {dict(step.state.counts)}; this is not a normal step")
    found["over_product"] = {name: found[name][STEP]["p50"] / found[name][PRODUCT]["p50"] for name in found}
    return found | {"memory": memory, "rate_hz": RATE_HZ, "granted": list(granted.granted)}


def allocated(step: ControlStep, payloads: Payloads) -> dict[str, float]:
    """Memory allocated by a step after warm-up, bytes: peak, mean retained; and the size of a float32 frame."""
    for number in range(_WARM_UP):
        step(payloads.at(number, number))
    tracemalloc.start()
    try:
        for number in range(_WARM_UP):
            step(payloads.at(number, number))
        retained_before, highest = tracemalloc.get_traced_memory()[0], 0
        for number in range(_TRACED):
            payload = payloads.at(number, number)
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            step(payload)
            highest = max(highest, tracemalloc.get_traced_memory()[1] - before)
        del payload  # the last frame must not count as memory retained by the step
        retained = (tracemalloc.get_traced_memory()[0] - retained_before) / _TRACED
    finally:
        tracemalloc.stop()
    rows, columns = payloads.shape
    return {"peak_bytes": float(highest), "kept_bytes": retained, "frame_bytes": 4.0 * rows * columns}


def tables(found: Result) -> list[Lines]:
    """A table with a row for each stage, the whole step and the product."""
    columns = [(name, at) for name in ("hot_us", "paced_us") for at in ("p50", "p99")]
    conditions = {"hot_us": "back to back", "paced_us": f"at {found['rate_hz']:g} Hz"}
    head = ["stage, us", *(f"{conditions[name]}: {at}" for name, at in columns)]
    stages = (*STAGES, REMAINDER, STEP, PRODUCT)
    return [[head, *([stage, *(f"{found[name][stage][at]:.1f}" for name, at in columns)] for stage in stages)]]


def about(found: Result) -> str:
    """Duration of the step relative to one product, the size of the loop, and the memory that a step allocates."""
    ratios, memory, size = found["over_product"], found["memory"], Size()
    return (
        f"The step takes {ratios['hot_us']:.1f} times as long as one product back to back, "
        f"{ratios['paced_us']:.1f} times at {found['rate_hz']:g} Hz. {size.pixels} pixels, {size.modes} modes, "
        f"{size.actuators} actuators. A step's allocations reach {memory['peak_bytes'] / 1e3:.1f} kB at most "
        f"(a frame in float32 is {memory['frame_bytes'] / 1e3:.1f} kB); each step retains {memory['kept_bytes']:.1f} "
        "bytes."
    )


def _timed(
    step: ControlStep, payloads: Payloads, product: Callable[[bytes], object], seconds: float, period_ns: int | None
) -> dict[str, Long]:
    """Durations, ns, of the step, of the product, and of the stages of a step; `seconds` / 3 for each of the three."""

    def alone(work: Callable[[bytes], object]) -> Long:
        return time_alone(work, payloads, HostClock(), seconds / 3, period_ns)[1]

    durations: dict[str, list[int]] = {stage: [] for stage in STAGES}
    found = {STEP: alone(step), PRODUCT: alone(product)}
    with _clocked(durations):
        timed_step_ns = alone(step)
    stages = {stage: np.array(each, np.int64) for stage, each in durations.items()}
    return found | stages | {REMAINDER: timed_step_ns - np.sum([*stages.values()], axis=0)}


@contextmanager
def _clocked(durations: dict[str, list[int]]) -> Iterator[None]:
    with ExitStack() as stack:
        for stage, (owner, name) in STAGES.items():
            clocked = _clock(getattr(owner, name), durations[stage])
            stack.enter_context(patch.object(owner, name, clocked))
        yield


def _clock(original: Callable[..., Any], durations: list[int]) -> Callable[..., Any]:
    def clocked(*arguments: Any) -> Any:
        begun_ns = time.perf_counter_ns()
        found = original(*arguments)
        durations.append(time.perf_counter_ns() - begun_ns)
        return found

    return clocked
