"""Chaos cases: processes that die or stand still."""

import signal
import time
from collections.abc import Callable

import numpy as np

from lowfc.adapters.bus import Sample
from lowfc.contract.messages import TIMING, Role, wire
from lowfc.programs.chaos.bench import ChaosBench

STALL_S = 10.0
CALM_S = STALL_S / 2
"""Before a stall, and after it: together as many frames as during it."""
STRIKES = 6
SILENT_S = 1.0
_READY_S = 60.0
_AFTER_S = 0.3


def role_of(bench: ChaosBench, role: str) -> str:
    """The process of a role."""
    return bench.mirror if role == Role.MIRROR else str(role)


def look_on(bench: ChaosBench) -> None:
    """Start a viewer that writes into a file."""
    bench.add(
        str(Role.VIEWER), ["-m", "lowfc", "view", "--run", bench.run.run_id, "--save", str(bench.folder / "view.rrd")]
    )
    bench.wait(lambda: bench.heard(Role.VIEWER), "the viewer", _READY_S)


def killed(role: str) -> Callable[[ChaosBench], None]:
    """Kill a process, start it anew, and wait for a quiet loop."""

    def act(bench: ChaosBench) -> None:
        if role == Role.VIEWER:
            look_on(bench)
        kill_and_restart(bench, role_of(bench, role))
        bench.settled()

    return act


def kill_and_restart(bench: ChaosBench, name: str) -> None:
    """Kill a process, and start it anew after a while."""
    bench.pause(0.0, 0.5)
    bench.kill(name)
    bench.pause(0.1, 1.0)
    bench.restart(name)
    bench.wait(lambda: bench.heard(name), f"{name} started anew", _READY_S)


def silenced(bench: ChaosBench) -> None:
    """Kill the camera, and leave the loop without for a while."""
    bench.kill(Role.CAMERA)
    time.sleep(SILENT_S)
    bench.restart(Role.CAMERA)
    bench.settled()


def frozen(role: str) -> Callable[[ChaosBench], None]:
    """Stop a process, let it go on, and wait for a quiet loop."""

    def act(bench: ChaosBench) -> None:
        if role == Role.VIEWER:
            look_on(bench)
        bench.pause(0.0, 0.5)
        bench.freeze(role_of(bench, role), 0.5, 2.0)
        bench.settled()

    return act


def at_random(bench: ChaosBench) -> None:
    """Kill or stop any of them, one after the other."""
    names = [str(Role.CAMERA), str(Role.CONTROLLER), bench.mirror, str(Role.RECORDER)]
    for _ in range(STRIKES):
        name = bench.rng.choice(names)
        if bench.rng.random() < 0.5:
            kill_and_restart(bench, name)
        else:
            bench.freeze(name, 0.1, 1.0)
        bench.pause(0.0, 1.0)
    bench.settled()


def stalled(role: str) -> Callable[[ChaosBench], None]:
    """Stop a process outside the loop for long, and compare latencies before, meanwhile and after, in one run."""

    def act(bench: ChaosBench) -> None:
        if role == Role.VIEWER:
            look_on(bench)
            bench.settled()
        latencies = Latencies(bench)
        name = role_of(bench, role)
        latencies.take("before", CALM_S)
        bench.signal(name, signal.SIGSTOP)
        try:
            latencies.take("during", STALL_S)
        finally:
            bench.signal(name, signal.SIGCONT)
        latencies.take("after", CALM_S)
        latencies.report()
        bench.settled()

    return act


class Latencies:
    """Frame-to-command latencies of a running loop, as its controller tells them."""

    def __init__(self, bench: ChaosBench) -> None:
        assert bench.bus is not None  # noqa: S101  # it has begun
        self._bench = bench
        self._taken: list[int] = []
        self._found: dict[str, dict[str, float]] = {}
        bench.bus.subscribe(TIMING, self._hear)

    def _hear(self, sample: Sample) -> None:
        self._taken += wire.ControlTiming.FromString(sample.payload).frame_to_command_ns

    def take(self, name: str, seconds: float) -> None:
        """Listen for so long."""
        time.sleep(_AFTER_S)  # what is on its way belongs to the time before
        self._taken = []
        time.sleep(seconds)
        taken = np.array(self._taken) / 1e3
        if taken.size:
            p50, p99 = np.percentile(taken, (50, 99))
            self._found[name] = {"frames": taken.size, "p50_us": round(float(p50), 1), "p99_us": round(float(p99), 1)}

    def report(self) -> None:
        """Put them among the case's figures, with the ratio of p99 during to that before and after together."""
        found = self._found
        self._bench.left.figures["frame_to_command"] = found
        if found.keys() >= {"before", "during", "after"}:
            calm_us = (found["before"]["p99_us"] + found["after"]["p99_us"]) / 2
            self._bench.left.figures["p99_during_over_calm"] = round(found["during"]["p99_us"] / calm_us, 2)
            self._bench.left.figures["p99_after_over_before"] = round(
                found["after"]["p99_us"] / found["before"]["p99_us"], 2
            )
