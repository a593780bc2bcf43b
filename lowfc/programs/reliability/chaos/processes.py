"""Chaos cases: processes that die or stand still."""

import contextlib
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.messages import TIMING, Role, wire
from lowfc.programs.reliability.chaos.bench import ChaosBench
from lowfc.programs.reliability.chaos.case import LOST, case

process_case = partial(case, "processes")

STALL_S = 10.0
CALM_S = STALL_S / 2
"""Before a stall, and after it: together as many frames as during it."""
STRIKES = 6
SILENT_S = 1.0
_AFTER_S = 0.3

# What the log must have of a process that was killed, and of one that stood still.
_EVENTS: dict[Role, tuple[tuple[str, ...], tuple[str, ...]]] = {
    Role.CAMERA: (("CAMERA_RESTARTED",), ("NO_FRAMES", "FRAMES_BACK")),
    Role.CONTROLLER: (("STARTED controller",), ("COMMAND_EXPIRED", "COMMAND_BACK")),
    Role.MIRROR: (("STARTED mirror",), ()),
    Role.RECORDER: ((), ()),
    Role.VIEWER: ((), ()),
}


def _name(bench: ChaosBench, role: Role) -> str:
    if role is Role.VIEWER:
        bench.view()
    return bench.mirror if role is Role.MIRROR else str(role)


def kill_and_restart(bench: ChaosBench, name: str) -> None:
    """Kill a process, and start it anew after a while."""
    bench.pause(0.0, 0.5)
    bench.kill(name)
    bench.pause(0.1, 1.0)
    bench.restart(name)


def _killed(bench: ChaosBench, role: Role) -> None:
    kill_and_restart(bench, _name(bench, role))


def _frozen(bench: ChaosBench, role: Role) -> None:
    name = _name(bench, role)
    bench.pause(0.0, 0.5)
    with bench.stopped(name):
        bench.pause(0.5, 2.0)


for _role, (_seen, _missed) in _EVENTS.items():
    _sentence = f"kill -9 of the {_role}, started anew up to 1 s later"
    process_case(f"kill-{_role}", _sentence, expected=_seen, allowed=LOST)(partial(_killed, role=_role))
for _role, (_seen, _missed) in _EVENTS.items():
    _sentence = f"SIGSTOP of the {_role}, SIGCONT 0.5 to 2 s later"
    process_case(f"freeze-{_role}", _sentence, expected=_missed, allowed=LOST)(partial(_frozen, role=_role))


@process_case(
    "silent-camera",
    "kill -9 of the camera, with the mirror to be relaxed meanwhile; started anew after a second",
    config={"control.on_frame_timeout": "flat", "disturbance.static_nm": {"4": 40.0}},
    expected=("NO_FRAMES", "CAMERA_RESTARTED"),
    allowed=LOST,
)
def _silenced(bench: ChaosBench) -> None:
    bench.kill(Role.CAMERA)
    time.sleep(SILENT_S)
    bench.restart(Role.CAMERA)


@process_case(
    "lost-mirror",
    "kill -9 of the mirror under a disturbance that stays; started anew after 3 s",
    config={"disturbance.static_nm": {"4": 40.0}},
    expected=("MIRROR_LOST", "MIRROR_BACK"),
    allowed=LOST,
)
def _lost_mirror(bench: ChaosBench) -> None:
    bench.kill(bench.mirror)
    time.sleep(3 * SILENT_S)
    bench.restart(bench.mirror)


@process_case("random", "six kills or stops of any of them, at random times", allowed=LOST)
def _at_random(bench: ChaosBench) -> None:
    names = [str(Role.CAMERA), str(Role.CONTROLLER), bench.mirror, str(Role.RECORDER)]
    for _ in range(STRIKES):
        name = bench.rng.choice(names)
        if bench.rng.random() < 0.5:
            kill_and_restart(bench, name)
        else:
            with bench.stopped(name):
                bench.pause(0.1, 1.0)
        bench.pause(0.0, 1.0)


@process_case("stall-recorder", "the recorder stands still for 10 s", allowed=LOST)
def _stalled_recorder(bench: ChaosBench) -> None:
    compare(bench, partial(bench.stopped, Role.RECORDER))


@process_case("stall-viewer", "the viewer stands still for 10 s", allowed=LOST)
def _stalled_viewer(bench: ChaosBench) -> None:
    bench.view()
    bench.settled()
    compare(bench, partial(bench.stopped, Role.VIEWER))


def compare(bench: ChaosBench, stall: Callable[[], contextlib.AbstractContextManager[None]]) -> None:
    """Note frame-to-command latencies before, during and after a stall among the case's figures, with ratios of p99."""
    latencies_ns: list[int] = []
    found: dict[str, dict[str, float]] = {}

    def receive(sample: Sample) -> None:
        latencies_ns.extend(wire.ControlTiming.FromString(sample.payload).frame_to_command_ns)

    def listen(name: str, seconds: float) -> None:
        time.sleep(_AFTER_S)  # what is on its way belongs to the time before
        latencies_ns.clear()
        time.sleep(seconds)
        if taken := list(latencies_ns):
            p50, p99 = (np.percentile(taken, (50, 99)) / 1e3).round(1).tolist()
            found[name] = {"frames": len(taken), "p50_us": p50, "p99_us": p99}

    assert bench.bus is not None  # noqa: S101  # it has begun
    bench.bus.subscribe(TIMING, receive)
    listen("before", CALM_S)
    with stall():
        listen("during", STALL_S)
    listen("after", CALM_S)
    bench.left.figures["frame_to_command"] = found
    if len(found) == 3:
        before, during, after = (one["p99_us"] for one in found.values())
        bench.left.figures["p99_during_over_calm"] = round(during / ((before + after) / 2), 2)
        bench.left.figures["p99_after_over_before"] = round(after / before, 2)
