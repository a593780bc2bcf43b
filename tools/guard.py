"""The guard of a law in the simulated loop: a table of docs/howto/tuning.md.

In one part the vibration lines shift in frequency after the law was identified; in the other they do not.
"""

import timeit
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from rich.progress import track
from threadpoolctl import threadpool_limits

from lowfc.adapters.files.factory import frame_noise_nm2
from lowfc.arrays import Array
from lowfc.contract.configuration import Configuration
from lowfc.control.laws.integrator import TIP_TILT, Integrator
from lowfc.control.laws.linear_law import LinearLaw, at_rest
from lowfc.control.laws.tuning import best_gains
from lowfc.control.loop.guard import Group, LawGuard
from lowfc.control.loop.wording import counted
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from sim_camera.driver import disturbance_of
from tools.law_bench import RATE_HZ, calibrated, configured, timing_of, tuned
from tools.modal_bench import ModalBench
from tools.shared import Results, formatted_table

SEEDS = tuple(range(1, 21))
MOVED = (("reaction-wheel-ideal", 1.02), ("reaction-wheel", 1.05), ("reaction-wheel", 1.10))
MAGNITUDES = (0.0, 2.0, 5.0)
AMPLITUDE_MAS = 5.0
"""Amplitude of a square wave of period 4 s in tip and tilt; its steps, every 2 s, are twice as large."""
MINUTES = 10.0
_IDENTIFY, _SETTLE, _BEFORE = 48_000, 12_000, 2_000
"""Frames: for identification of a law, in open loop, and in closed loop before the lines move."""

LawOf = Callable[[Configuration, Array, ModalBench], tuple[LinearLaw, Array]]
"""Makes a law and integrator gains (modes,) from a configuration, the covariance of a frame's noise and a loop."""


def identified_law(config: Configuration, covariance_nm2: Array, bench: ModalBench) -> tuple[LinearLaw, Array]:
    """LQG law and integrator gains identified from the closed loop, as `lowfc tune` does."""
    bench.settle(1_000)
    bench.run(_IDENTIFY)
    run, timing = bench.pol(), timing_of(config)
    return tuned(run, config)["lqg"].law, best_gains(run, RATE_HZ, timing, np.zeros(len(config.noll))).gain


class Case:
    """A star and a disturbance, with a law and the best gains for them."""

    def __init__(self, preset: str, magnitude: float, law_of: LawOf = identified_law) -> None:
        self.keys: dict[str, Any] = {"disturbance.preset": preset, "star.magnitude": magnitude}
        config = configured(**self.keys)
        self.covariance_nm2: Array = frame_noise_nm2(config, calibrated(config))
        bench = ModalBench(config, self.covariance_nm2, watch=False)
        self.law, self.gains = law_of(config, self.covariance_nm2, bench)

    def configured(self, seed: int, **changed: Any) -> Configuration:
        """The configuration of a run."""
        return configured(seed=seed, **self.keys, **changed)

    def bench(self, config: Configuration, law: LinearLaw | None, steps_mas: float = 0.0) -> ModalBench:
        """A closed loop of this case; its law observed the open loop before, long enough for narrow lines."""
        disturbance = disturbance_of(config)
        step_nm: Array = (
            steps_mas * tilt_nm_per_mas(config.star.diameter_m) * np.isin(config.noll, TIP_TILT).astype(float)
        )
        bench = ModalBench(config, self.covariance_nm2, replace(disturbance, step_nm=step_nm), watch=False)
        bench.ask("gain", modes=config.noll, values=tuple(self.gains.tolist()))
        if law is not None:
            bench.ask("law", law=law)
        bench.run(_SETTLE, record=False)
        bench.ask("close")
        return bench


def tilt_after_move(
    case: Case, factor: float, seed: int, *, with_guard: bool = True, with_law: bool = True
) -> tuple[float, list[float]]:
    """Tilt from 1 s to 3 s after lines have moved, mas rms per axis, and times of LAW_OVERRULED, s after the move."""
    bench = case.bench(case.configured(seed, **{"control.guard": with_guard}), case.law if with_law else None)
    bench.run(_BEFORE)
    if any(event.name == "LAW_OVERRULED" for _, event in bench.events):
        raise RuntimeError(f"the law was overruled before its lines moved: {bench.events}")
    bench.new_record()
    bench.move_lines(factor)
    bench.run(3 * int(RATE_HZ))
    first = _SETTLE + _BEFORE
    return bench.tilt_mas(2 * int(RATE_HZ)), [
        (index - first) / RATE_HZ for index, event in bench.events if event.name == "LAW_OVERRULED"
    ]


def times_overruled(case: Case, seed: int, minutes: float = MINUTES) -> int:
    """Number of times a good law is overruled, with unmodelled steps and lines of finite width that are not moved."""
    bench = case.bench(case.configured(seed), case.law, AMPLITUDE_MAS)
    bench.run(round(minutes * 60 * RATE_HZ), record=False)
    if bench.frames_refused:
        raise RuntimeError(f"{bench.frames_refused} frames were refused")
    return sum(event.name == "LAW_OVERRULED" for _, event in bench.events)


def measure() -> Results:
    """Measure all cases with all seeds."""
    with threadpool_limits(1):
        cases = {preset: Case(preset, 0.0) for preset, _ in MOVED}
        rows = [_row(cases[preset], preset, factor) for preset, factor in track(MOVED, "moved lines")]
        good = {}
        for magnitude in MAGNITUDES:
            case = Case("reaction-wheel", magnitude)
            good[f"{magnitude:g}"] = [times_overruled(case, seed) for seed in track(SEEDS, f"V = {magnitude:g}")]
    return {"moved": rows, "good": good, "minutes": MINUTES, "cost_us": cost_us(cases["reaction-wheel"].law)}


def cost_us(law: LinearLaw) -> dict[str, float]:
    """Least time, us, that the guard adds to a frame while the law drives, and while the law is overruled."""
    modes = len(law.noll)
    zeros, value_nm = np.zeros(modes, np.float32), np.ones(modes, np.float32)
    integrator_and_history = (
        Integrator(zeros + np.float32(0.5), zeros, zeros + np.float32(150)),
        ((0, np.float32(1)),),
        (zeros,),
    )
    driving, x = LawGuard.of(law), at_rest(law)
    virtual = LawGuard.of(law, [Group(True, driving.spans.cross_fade, 1)] * 2)
    found = {}
    for name, guard in (("driving", driving), ("virtual", virtual)):
        begun, _ = guard.judged(law, x, *integrator_and_history, value_nm, value_nm, limited=False)
        step = partial(begun.judged, law, x, *integrator_and_history, value_nm, value_nm, limited=False)
        found[name] = 1e6 * min(timeit.repeat(step, repeat=1000, number=20)) / 20
    return found


def _row(case: Case, preset: str, factor: float) -> Results:
    guarded = [tilt_after_move(case, factor, seed) for seed in SEEDS]
    unguarded = np.array([tilt_after_move(case, factor, seed, with_guard=False)[0] for seed in SEEDS])
    integrator = np.array([tilt_after_move(case, factor, seed, with_law=False)[0] for seed in SEEDS])
    guarded_mas = np.array([mas for mas, _ in guarded])
    times = [times_s[0] for _, times_s in guarded if times_s]
    return {
        "preset": preset,
        "percent": 100 * (factor - 1),
        "guarded_mas": float(guarded_mas.mean()),
        "alone_mas": float(unguarded.mean()),
        "integrator_mas": float(integrator.mean()),
        "worst_ratio": float((guarded_mas / integrator).max()),
        "overruled": len(times),
        "seeds": len(SEEDS),
        "latest_s": max(times, default=None),
    }


def render(results: Results) -> str:
    """A row for each case, and the result for good laws."""
    rows = formatted_table(
        {
            "disturbance, frequency shift of its lines": "`{preset}`, {percent:.0f} %",
            "guarded law, mas rms per axis": "**{guarded_mas:.2f}**",
            "law without guard, mas": "{alone_mas:.2f}",
            "integrator, mas": "{integrator_mas:.2f}",
            "guarded law / integrator, worst seed": "{worst_ratio:.3f}",
            "runs with the law overruled": "{overruled} of {seeds}",
            "latest overruling, after the shift": "{after}",
        },
        [row | {"after": "" if row["latest_s"] is None else f"{row['latest_s']:.2f} s"} for row in results["moved"]],
    )
    good = "; ".join(
        f"V = {magnitude}: {sum(found)} times in {counted(len(found), 'run')}"
        for magnitude, found in results["good"].items()
    )
    cost = results["cost_us"]
    complete = all(len(found) == len(SEEDS) for found in results["good"].values())
    partly = "" if complete else f" For some V not all of the {len(SEEDS)} runs have been measured."
    return (
        f"{rows}\nTrue tilt from 1 s to 3 s after the lines moved, V = 0, 1 kHz. Laws are LQG, "
        f"identified from {_IDENTIFY / RATE_HZ:g} s of the closed loop; the integrator has the best gains for the same "
        f"frames. Without a shift, in runs of {results['minutes']:g} minutes with unmodelled steps of "
        f"{2 * AMPLITUDE_MAS:g} mas every 2 s, laws were overruled: {good}.{partly} With a law of 14 modes the guard "
        f"adds {cost['driving']:.1f} us to a frame while the law drives, {cost['virtual']:.1f} us while it is "
        "overruled. "
        "The live loop's own `advance` receives modes whose noise has the covariance of image noise after R; no images "
        "are simulated."
    )
