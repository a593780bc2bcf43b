"""The live latency test: controller and mirror driven by a frame source, then the references.

Every repeat starts its processes anew: first those of the loop, then those of the bare echo, which also time the
control step and the host's timer alone. The two groups never run at the same time.
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
from lowfc.adapters.files.whole_file import being_written, write_whole
from lowfc.adapters.logs.columns import Columns, TimingRows
from lowfc.adapters.process.child import Child
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.terminal import INTERRUPTED
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError
from lowfc.contract.messages import FRAME, HEALTH, MIRROR_STATE, TIMING, Role, wire
from lowfc.programs.launch.processes import program, stop_all
from lowfc.programs.launch.sim_loop import children_of, deferred_signals, died, prepare
from lowfc.programs.launch.watch import Watch
from lowfc.programs.measure import bare_loop, echo
from lowfc.programs.measure.bare_loop import PROCESSES_FILE, TRACED, trace_file
from lowfc.programs.measure.frame_source import BEGIN_FILE, FRAMES_FILE, SENT_FILE, prepared_frames
from lowfc.programs.measure.latency.frame_statistics import (
    WARM_UP_S,
    controller_counts,
    frame_outcomes,
    percentiles,
    repeat_statistics,
)
from lowfc.programs.measure.latency.stalls import Trace, stalls_of

_POLL_S = 0.25
_RING_SIZE = 1 << 14  # messages
_SETTLE_S = 0.15  # for the last command and mirror state to arrive
_LAST_HEALTH_S = 0.1  # for the last Health to arrive


@dataclass(frozen=True, slots=True)
class LatencyOptions:
    """Options of `lowfc latency`; several `kernels` run in turns."""

    config: Configuration
    duration_s: float
    repeats: int
    simulated: bool = False
    record: bool = False
    view: bool = False
    kernels: tuple[str, ...] = ()
    trace: bool = False


def write_shared_files(config: Configuration, run: Run) -> None:
    """Write the files that the processes share to the run's directory: calibration, configuration, frames."""
    with threadpool_limits(limits=1):  # with more threads, some would spin until others get a processor
        prepare(config, run, Console(stderr=True))
        with being_written(run.path / FRAMES_FILE) as part, part.open("wb") as file:
            np.save(file, prepared_frames(config))


@contextlib.contextmanager
def prepared(
    config: Configuration, write_files: Callable[[Configuration, Run], None] = write_shared_files
) -> Iterator[Run]:
    """A run with the files that its processes share; the run is removed at the end."""
    run = open_run(new_run_id(), (config.mirror.name,), listeners=(Role.LAUNCHER,))
    try:
        write_files(config, run)
        yield run
    finally:
        run.remove()


def run_repeats(options: LatencyOptions, run: Run, progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """Statistics of each repeat and kernel: those of `one_loop`, and percentiles of echo, step and timer."""
    repeats, kernels = [], options.kernels or (options.config.realtime.kernel,)
    for number in range(options.repeats):
        for kernel in kernels[:: -1 if number % 2 else 1]:  # in alternating order
            realtime = options.config.realtime.model_copy(update={"kernel": kernel})
            kernel_options = replace(options, config=options.config.model_copy(update={"realtime": realtime}))
            write_whole(run.path / "config.toml", kernel_options.config.to_toml().encode())
            progress(f"{number + 1} of {options.repeats}: the loop with kernel {kernel}")
            loop = one_loop(kernel_options, run)
            progress(f"{number + 1} of {options.repeats}: the bare echo, the step with kernel {kernel}, and the timer")
            repeats.append(loop | _references(kernel_options, run) | {"kernel": kernel})
    return repeats


def one_loop(options: LatencyOptions, run: Run, children: list[Child] | None = None) -> dict[str, Any]:
    """One repeat of the loop alone: statistics of its frames, and the last reports of its processes.

    Only timing (10 Hz), Health and a poll (4 Hz) wake this process; frames and mirror states wait in rings.

    Args:
        options: options of `lowfc latency`.
        run: run with the files that the processes share.
        children: processes in place of those of `lowfc latency`; the first ends by itself, and one of them writes
            `SENT_FILE`.

    Raises:
        ProcessDiedError: a process ended unexpectedly or with an error.
        BusError: the controller did not report its timing, or the recording stopped early.
    """
    watch, timings = Watch({}, []), TimingRows()
    states, frames = (Columns(sequence="Q", publish_ns="q") for _ in range(2))

    def add_timing(sample: Sample) -> None:
        timings.add(wire.ControlTiming.FromString(sample.payload))

    def drain() -> None:
        for sample in state_ring.drain():
            sequence = wire.MirrorState.FromString(sample.payload).frame_sequence
            states.add(sequence=sequence, publish_ns=sample.publish_time_ns)
        for sample in frame_ring.drain() if frame_ring is not None else ():
            frames.add(sequence=sample.sequence, publish_ns=sample.publish_time_ns)

    children = children or _children(options, run)
    traced = TRACED if options.trace else ()
    for file in (BEGIN_FILE, PROCESSES_FILE):
        (run.path / file).unlink(missing_ok=True)  # left by the previous repeat
    with contextlib.ExitStack() as stack:
        bus = ZenohBus(run.links, Role.LAUNCHER, HostClock())
        stack.callback(bus.close)
        bus.subscribe(HEALTH, watch.add_health)
        bus.subscribe(TIMING, add_timing)
        state_ring = bus.ring(MIRROR_STATE, _RING_SIZE)
        frame_ring = bus.ring(FRAME, _RING_SIZE) if options.simulated else None
        stack.callback(stop_all, children)
        _run_children(children, children[: 1 + len(traced)], drain, partial(_write_pids, run, children))
        time.sleep(_SETTLE_S)
        stop_all([*children[1:], children[0]])
        time.sleep(_LAST_HEALTH_S)
        drain()
        _check_ends(children)
    received = timings.values(), (states.values("sequence"), states.values("publish_ns"))
    if options.simulated:
        outcomes = frame_outcomes(frames.values("sequence"), frames.values("publish_ns"), None, *received)
    else:
        with np.load(run.path / SENT_FILE) as sent:
            outcomes = frame_outcomes(sent["sequence"], sent["put_ns"], sent["due_ns"], *received)
    statistics = repeat_statistics(outcomes)
    if traced:
        traces: dict[str, Trace] = {role: Trace(*np.load(run.path / trace_file(role)).T) for role in traced}
        statistics["stalls"] = stalls_of(outcomes, options.config.period_ns, traces)
    if "frame_to_command" not in statistics["latency_us"]:
        raise BusError("the controller reported no timing after the warm-up: use a longer --duration")
    controller, recording = watch.health_of(Role.CONTROLLER), watch.health_of(Role.RECORDER).recording
    if recording.failure:
        raise BusError(f"the recorder stopped: {recording.failure}")
    roles = Role.CAMERA, Role.CONTROLLER, mirror_role(options.config.mirror.name)
    reports = {
        "memory_mb": {str(role): watch.health_of(role).memory_bytes / 1e6 for role in roles},
        "granted": list(controller.realtime_granted),
        "refused": list(controller.realtime_refused),
        "logs": list(recording.files),
        "messages_lost": recording.lost if options.record else None,
        "commands_late": watch.health_of(Role.CAMERA).commands_late if options.simulated else None,
    }
    return statistics | controller_counts(controller) | reports


def _children(options: LatencyOptions, run: Run) -> list[Child]:
    """The loop's processes: the camera, which ends by itself, then the others in the order in which they stop."""
    config, seconds = options.config, WARM_UP_S + options.duration_s
    children = children_of(config, run, seconds, options.record)
    if options.view:
        arguments = ["-m", "lowfc", "view", "--run", run.run_id, "--web"]
        view = program(str(Role.VIEWER), arguments, run.path / f"{Role.VIEWER}.stderr")
        children.insert(len(children) - options.record, view)  # a recorder is stopped after it
    if not options.simulated:
        waits = [argument for child in children[1:] for argument in ("--wait-for", child.name)]
        arguments = ["-m", "lowfc.programs.measure.frame_source", *_options(run), "--seconds", str(seconds), *waits]
        children[0] = program(str(Role.CAMERA), arguments, run.path / f"{Role.CAMERA}.stderr")
    elif options.view:  # the simulated camera already waits for the others
        children[0].command += ["--wait-for", str(Role.VIEWER)]
    if options.trace:
        for role in reversed(TRACED):
            arguments = ["-m", bare_loop.__name__, str(role), *_options(run), "--seconds", str(seconds)]
            name = f"bare loop beside the {role}"
            children.insert(1, program(name, arguments, run.path / f"bare-{role}.stderr"))
    return children


def _write_pids(run: Run, children: list[Child]) -> None:
    """Write `PROCESSES_FILE`."""
    pids = {child.name: child.process.pid for child in children if child.process is not None}
    write_whole(run.path / PROCESSES_FILE, json.dumps(pids).encode())


def _references(options: LatencyOptions, run: Run) -> dict[str, Any]:
    """Percentiles of the bare echo, the control step alone and the host's timer, and the number of lost echoes."""
    arguments = [*_options(run), "--seconds", str(options.duration_s / 2)]
    children = [
        program(f"echo ({verb})", ["-m", echo.__name__, verb, *arguments], run.path / f"echo-{verb}.stderr")
        for verb in ("ask", "answer")
    ]
    try:
        _run_children(children, children, lambda: None)
    finally:
        stop_all(children)
    with np.load(run.path / echo.ECHO_FILE) as echoed, np.load(run.path / echo.ALONE_FILE) as alone:
        round_trip_ns = echoed["round_trip_ns"]
        durations_ns = {"echo_us": round_trip_ns[round_trip_ns >= 0]}
        durations_ns |= {name: alone[name.replace("_us", "_ns")] for name in ("step_us", "hot_step_us", "timer_us")}
    if not durations_ns["echo_us"].size:
        raise BusError("the bare echo returned no answer: use a longer --duration")
    percentiles_us = {name: percentiles(values_ns / 1e3) for name, values_ns in durations_ns.items()}
    return percentiles_us | {"echo_lost": int(np.sum(round_trip_ns < 0))}


def _options(run: Run) -> list[str]:
    """Command-line options that name the run and its configuration file."""
    return ["--run", run.run_id, "--config", str(run.path / "config.toml")]


def _run_children(
    children: list[Child],
    awaited: list[Child],
    meanwhile: Callable[[], None],
    started: Callable[[], None] = lambda: None,
) -> None:
    """Start the processes, call `started`, then call `meanwhile` repeatedly until the awaited ones have ended."""
    # Signals are deferred: while a process forks, Python may swallow an exception of a signal handler.
    with deferred_signals() as interrupted:
        for child in children:
            child.start()
        started()
        while any(child.status is None for child in awaited) and not interrupted():
            for child in children:
                if child.status is not None and (child.status != 0 or child not in awaited):
                    raise died(child)
            meanwhile()
            time.sleep(_POLL_S)
    if interrupted():
        raise KeyboardInterrupt
    _check_ends(awaited)


def _check_ends(children: list[Child]) -> None:
    """Raise ProcessDiedError if a process ended with an error."""
    for child in children:
        if child.status not in (0, INTERRUPTED):
            raise died(child)
