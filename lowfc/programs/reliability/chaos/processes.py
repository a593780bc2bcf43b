"""Chaos cases: processes that are killed or suspended."""

import contextlib
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.messages import TIMING, Role, wire
from lowfc.programs.reliability.chaos.bench import ChaosBench
from lowfc.programs.reliability.chaos.case import LOST, case

process_case = partial(case, allowed=LOST)

STALL_S = 10.0
CALM_S = STALL_S / 2
"""Duration of the measurement before a stall, and of the one after it; together they last as long as the stall."""
RANDOM_FAULTS = 6
_SETTLE_S = 0.3
_STATIC = {"disturbance.static_nm": {"4": 40.0}}

# Events that the log must have if the process of a role is killed, and if it is suspended.
_EVENTS: dict[Role, tuple[tuple[str, ...], tuple[str, ...]]] = {
    Role.CAMERA: (("CAMERA_RESTARTED",), ("NO_FRAMES", "FRAMES_BACK")),
    Role.CONTROLLER: (("STARTED controller",), ("COMMAND_EXPIRED", "COMMAND_BACK")),
    Role.MIRROR: (("STARTED mirror",), ()),
    Role.RECORDER: ((), ()),
    Role.VIEWER: ((), ()),
}


def kill_and_restart(bench: ChaosBench, role: Role, after_s: tuple[float, float] = (0.1, 1.0)) -> None:
    """Kill a process, and restart it after a random time in this range."""
    name = bench.process(role)
    bench.pause(0.0, 0.5)
    bench.kill(name)
    bench.pause(*after_s)
    bench.restart(name)


def suspend_and_continue(bench: ChaosBench, role: Role, for_s: tuple[float, float] = (0.5, 2.0)) -> None:
    """Suspend a process (SIGSTOP), and continue it after a random time in this range."""
    name = bench.process(role)
    bench.pause(0.0, 0.5)
    with bench.suspended(name):
        bench.pause(*for_s)


for _role, (_names, _) in _EVENTS.items():
    process_case(f"kill-{_role}", f"kill -9 of the {_role}, restarted up to 1 s later", expected=_names)(
        partial(kill_and_restart, role=_role)
    )
for _role, (_, _names) in _EVENTS.items():
    process_case(f"freeze-{_role}", f"SIGSTOP of the {_role}, SIGCONT 0.5 to 2 s later", expected=_names)(
        partial(suspend_and_continue, role=_role)
    )
process_case(
    "silent-camera",
    'kill -9 of the camera with `on_frame_timeout = "flat"` and 40 nm of static focus; restarted after 1 s',
    config={"control.on_frame_timeout": "flat", **_STATIC},
    expected=("NO_FRAMES", "CAMERA_RESTARTED"),
)(partial(kill_and_restart, role=Role.CAMERA, after_s=(1.0, 1.0)))
process_case(
    "lost-mirror",
    "kill -9 of the mirror with 40 nm of static focus; restarted after 3 s",
    config=_STATIC,
    expected=("MIRROR_LOST", "MIRROR_BACK"),
)(partial(kill_and_restart, role=Role.MIRROR, after_s=(3.0, 3.0)))


@process_case("random", "six kill -9 or SIGSTOP of random processes, at random times")
def _at_random(bench: ChaosBench) -> None:
    for _ in range(RANDOM_FAULTS):
        role = bench.rng.choice((Role.CAMERA, Role.CONTROLLER, Role.MIRROR, Role.RECORDER))
        if bench.rng.random() < 0.5:
            kill_and_restart(bench, role)
        else:
            suspend_and_continue(bench, role, (0.1, 1.0))
        bench.pause(0.0, 1.0)


@process_case("stall-recorder", "the recorder is suspended (SIGSTOP) for 10 s")
def _stalled_recorder(bench: ChaosBench) -> None:
    compare(bench, partial(bench.suspended, Role.RECORDER))


@process_case("stall-viewer", "the viewer is suspended (SIGSTOP) for 10 s")
def _stalled_viewer(bench: ChaosBench) -> None:
    name = bench.process(Role.VIEWER)
    bench.await_settled()
    compare(bench, partial(bench.suspended, name))


class CommandTimes:
    """Frame-to-command latencies of a running bench; percentiles of each phase are stored in the bench's `outcome`."""

    def __init__(self, bench: ChaosBench) -> None:
        assert bench.bus is not None  # noqa: S101  # the bench has begun
        self.phases: dict[str, dict[str, float]] = {}
        self._latencies_ns: list[int] = []
        bench.bus.subscribe(TIMING, self._receive)
        bench.outcome.measurements["frame_to_command"] = self.phases

    def drain(self) -> dict[str, float]:
        """Number of frames timed since the last call, p50 and p99 of their latencies; empty without frames."""
        latencies_ns, self._latencies_ns = self._latencies_ns, []
        if not latencies_ns:
            return {}
        p50, p99 = (np.percentile(latencies_ns, (50, 99)) / 1e3).round(1).tolist()
        return {"frames": len(latencies_ns), "p50_us": p50, "p99_us": p99}

    def measure(self, name: str, seconds: float) -> None:
        """Collect latencies for this time, as the phase `name`."""
        time.sleep(_SETTLE_S)  # timings still in transit belong to the phase before
        self.drain()
        time.sleep(seconds)
        if latencies := self.drain():
            self.phases[name] = latencies

    def _receive(self, sample: Sample) -> None:
        self._latencies_ns.extend(wire.ControlTiming.FromString(sample.payload).frame_to_command_ns)


def compare(bench: ChaosBench, stall: Callable[[], contextlib.AbstractContextManager[None]]) -> None:
    """Measure latencies before, during and after a stall; store them and the ratios of their p99 in the outcome."""
    times = CommandTimes(bench)
    times.measure("before", CALM_S)
    with stall():
        times.measure("during", STALL_S)
    times.measure("after", CALM_S)
    if len(times.phases) == 3:
        before, during, after = (phase["p99_us"] for phase in times.phases.values())
        bench.outcome.measurements["p99_during_over_calm"] = round(during / ((before + after) / 2), 2)
        bench.outcome.measurements["p99_after_over_before"] = round(after / before, 2)
