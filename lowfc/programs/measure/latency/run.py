"""The live latency test: controller and mirror driven by a source of frames; then what they are set against.

Every repeat starts its processes anew: first the loop's, then those of the bare echo, which also time the control step
and the host's timer alone. Nothing else of ours runs beside either.
"""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import Run, mirror_role, new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.files.whole_file import write_whole
from lowfc.adapters.logs.columns import Columns, TimingRows
from lowfc.adapters.process.child import Child
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.terminal import INTERRUPTED
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError
from lowfc.contract.messages import FRAME, HEALTH, MIRROR_STATE, TIMING, Role, wire
from lowfc.programs.launch.processes import program, start_all, stop_all
from lowfc.programs.launch.sim_loop import children_of, deferred_signals, died, prepare
from lowfc.programs.launch.watch import Watch
from lowfc.programs.measure import bare_loop, echo
from lowfc.programs.measure.bare_loop import PROCESSES_FILE, TRACED, trace_file
from lowfc.programs.measure.frame_source import BEGIN_FILE, FRAMES_FILE, SENT_FILE, prepared_frames
from lowfc.programs.measure.latency.figures import (
    WARM_UP_S,
    controllers_account,
    join,
    percentiles,
    repeat_figures,
)
from lowfc.programs.measure.latency.stalls import Trace, stalls_of

_TURN_S = 0.25
_RING = 1 << 14
_SETTLE_S = 0.15
_LAST_WORDS_S = 0.1


@dataclass(frozen=True, slots=True)
class Asked:
    """What to run: the options of `lowfc latency`; with several `kernels`, each in turn."""

    config: Configuration
    duration_s: float
    repeats: int
    simulated: bool = False
    record: bool = False
    view: bool = False
    kernels: tuple[str, ...] = ()
    trace: bool = False


def fill(config: Configuration, run: Run) -> None:
    """Put into the run's directory what its processes share, the frames among it."""
    with threadpool_limits(limits=1):  # more spin, and are waited for where something else has their processor
        prepare(config, run, Console(stderr=True))
        np.save(run.path / FRAMES_FILE, prepared_frames(config))


@contextlib.contextmanager
def prepared(config: Configuration, fill: Callable[[Configuration, Run], None] = fill) -> Iterator[Run]:
    """A run with what its processes share; nothing is left of it afterwards."""
    run = open_run(new_run_id(), (config.mirror.name,), listeners=(Role.LAUNCHER,))
    try:
        fill(config, run)
        yield run
    finally:
        run.remove()


def run_repeats(asked: Asked, run: Run, progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """Figures of each repeat, and in it of each kernel: of `one_loop`, and percentiles of echo, step and timer."""
    repeats, kernels = [], asked.kernels or (asked.config.realtime.kernel,)
    for number in range(asked.repeats):
        for kernel in kernels[:: -1 if number % 2 else 1]:
            realtime = asked.config.realtime.model_copy(update={"kernel": kernel})
            turn = replace(asked, config=asked.config.model_copy(update={"realtime": realtime}))
            (run.path / "config.toml").write_text(turn.config.to_toml(), encoding="utf-8")
            progress(f"{number + 1} of {asked.repeats}: the loop by {kernel}")
            loop = one_loop(turn, run)
            progress(f"{number + 1} of {asked.repeats}: the bare echo, the step by {kernel} and the timer")
            repeats.append(loop | _alone(turn, run) | {"kernel": kernel})
    return repeats


def one_loop(asked: Asked, run: Run, children: list[Child] | None = None) -> dict[str, Any]:
    """One repeat of the loop alone: figures of its frames, and what its processes reported at their end.

    Python is woken ten times a second, and by Health; frames and mirror states wait in rings. `children` are the
    loop's processes where they are others; the first ends by itself, and they leave the times of frames as the source.

    Raises:
        ProcessDiedError: a process ended that should not have, or with an error.
        BusError: the controller did not report its timing.
    """
    watch, timings = Watch({}, []), TimingRows()
    states, frames = (Columns(sequence="Q", publish_ns="q") for _ in range(2))

    def time_frames(sample: Sample) -> None:
        timings.add(wire.ControlTiming.FromString(sample.payload))

    def drain() -> None:
        for sample in state_ring.drain():
            sequence = wire.MirrorState.FromString(sample.payload).frame_sequence
            states.add(sequence=sequence, publish_ns=sample.publish_time_ns)
        for sample in frame_ring.drain() if frame_ring is not None else ():
            frames.add(sequence=sample.sequence, publish_ns=sample.publish_time_ns)

    children, traced = _children(asked, run) if children is None else children, TRACED if asked.trace else ()
    for file in (BEGIN_FILE, PROCESSES_FILE):
        (run.path / file).unlink(missing_ok=True)  # of the last repeat
    with contextlib.ExitStack() as stack:
        bus = ZenohBus(run.links, Role.LAUNCHER, HostClock())
        stack.callback(bus.close)
        bus.subscribe(HEALTH, watch.add_health)
        bus.subscribe(TIMING, time_frames)
        state_ring = bus.ring(MIRROR_STATE, _RING)
        frame_ring = bus.ring(FRAME, _RING) if asked.simulated else None
        stack.callback(stop_all, children)
        _run(children, children[: 1 + len(traced)], drain, partial(_name_processes, run, children))
        time.sleep(_SETTLE_S)
        stop_all([*children[1:], children[0]])
        time.sleep(_LAST_WORDS_S)
        drain()
        _check_ends(children)
    received = timings.values(), (states.values("sequence"), states.values("publish_ns"))
    if asked.simulated:
        joined = join(frames.values("sequence"), frames.values("publish_ns"), None, *received)
    else:
        with np.load(run.path / SENT_FILE) as sent:
            joined = join(sent["sequence"], sent["put_ns"], sent["due_ns"], *received)
    figures = repeat_figures(joined)
    if traced:
        traces: dict[str, Trace] = {role: Trace(*np.load(run.path / trace_file(role)).T) for role in traced}
        figures["stalls"] = stalls_of(joined, asked.config.period_ns, traces)
    if "frame_to_command" not in figures["latency_us"]:
        raise BusError("the controller reported the timing of no frame after the warm-up; let the test last longer")
    controller, recording = watch.of(Role.CONTROLLER), watch.of(Role.RECORDER).recording
    if recording.failure:
        raise BusError(f"the recorder stopped: {recording.failure}")
    loop = {role: watch.of(role) for role in (Role.CAMERA, Role.CONTROLLER, mirror_role(asked.config.mirror.name))}
    account = {
        "memory_mb": {str(role): health.memory_bytes / 1e6 for role, health in loop.items()},
        "granted": list(controller.realtime_granted),
        "refused": list(controller.realtime_refused),
        "logs": list(recording.files),
        "messages_lost": recording.lost if asked.record else None,
        "commands_late": watch.of(Role.CAMERA).commands_late if asked.simulated else None,
    }
    return figures | controllers_account(controller) | account


def _children(asked: Asked, run: Run) -> list[Child]:
    """The loop's processes in the order in which they are stopped; the first one ends by itself."""
    config, seconds = asked.config, WARM_UP_S + asked.duration_s
    children = children_of(config, run, seconds, asked.record)
    if asked.view:
        words = ["-m", "lowfc", "view", "--run", run.run_id, "--web"]
        view = program(str(Role.VIEWER), words, run.path / f"{Role.VIEWER}.stderr")
        children.insert(len(children) - asked.record, view)  # the recorder ends last
    awaited = [str(Role.CONTROLLER), mirror_role(config.mirror.name)]
    awaited += [str(Role.RECORDER)] * asked.record + [str(Role.VIEWER)] * asked.view
    waits = [word for name in awaited for word in ("--wait-for", name)]
    if asked.simulated:
        children[0].command += waits[-2:] if asked.view else []
    else:
        words = ["-m", "lowfc.programs.measure.frame_source", *_shared(run), "--seconds", str(seconds), *waits]
        children[0] = program(str(Role.CAMERA), words, run.path / f"{Role.CAMERA}.stderr")
    if asked.trace:
        children[1:1] = [_bare_loop(run, role, seconds) for role in TRACED]
    return children


def _bare_loop(run: Run, role: Role, seconds: float) -> Child:
    words = ["-m", bare_loop.__name__, str(role), *_shared(run), "--seconds", str(seconds)]
    return program(f"bare loop beside the {role}", words, run.path / f"bare-{role}.stderr")


def _name_processes(run: Run, children: list[Child]) -> None:
    numbers = {child.name: child.process.pid for child in children if child.process is not None}
    write_whole(run.path / PROCESSES_FILE, json.dumps(numbers).encode())


def _alone(asked: Asked, run: Run) -> dict[str, Any]:
    words = [*_shared(run), "--seconds", str(asked.duration_s / 2)]
    children = [
        program(f"echo ({verb})", ["-m", echo.__name__, verb, *words], run.path / f"echo-{verb}.stderr")
        for verb in ("ask", "answer")
    ]
    try:
        _run(children, children, lambda: None)
    finally:
        stop_all(children)
    with np.load(run.path / echo.ECHO_FILE) as echoed, np.load(run.path / echo.ALONE_FILE) as alone:
        round_trip_ns = echoed["round_trip_ns"]
        durations_ns = {"echo_us": round_trip_ns[round_trip_ns >= 0]}
        durations_ns |= {name: alone[name.replace("_us", "_ns")] for name in ("step_us", "hot_step_us", "timer_us")}
    if not durations_ns["echo_us"].size:
        raise BusError("no answer of the bare echo came back; let the test last longer (--duration)")
    found = {name: percentiles(each_ns / 1e3) for name, each_ns in durations_ns.items()}
    return found | {"echo_lost": int(np.sum(round_trip_ns < 0))}


def _shared(run: Run) -> list[str]:
    return ["--run", run.run_id, "--config", str(run.path / "config.toml")]


def _run(
    children: list[Child],
    awaited: list[Child],
    meanwhile: Callable[[], None],
    started: Callable[[], None] = lambda: None,
) -> None:
    with deferred_signals() as interrupted:  # while a process forks, Python may swallow what signals would raise
        start_all(children)
        started()
        while any(child.status is None for child in awaited) and not interrupted():
            for child in children:
                if child.status is not None and (child.status != 0 or child not in awaited):
                    raise died(child)
            meanwhile()
            time.sleep(_TURN_S)
    if interrupted():
        raise KeyboardInterrupt
    _check_ends(awaited)


def _check_ends(children: list[Child]) -> None:
    for child in children:
        if child.status not in (0, INTERRUPTED):
            raise died(child)
