"""The launcher of the simulated loop: starts and supervises camera, mirror, controller, recorder and view."""

import contextlib
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

from rich.console import Console
from rich.live import Live

from lowfc.adapters.bus.run import MODE, Run, free_ports, mirror_role, new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.files import calibration_file
from lowfc.adapters.files.whole_file import write_whole
from lowfc.adapters.process.child import Child
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.terminal import INTERRUPTED
from lowfc.adapters.viewer.rerun_viewer import Show, require_screen, stream_url, web_address
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError, LowfcError
from lowfc.contract.messages import EVENT, HEALTH, Role
from lowfc.programs.commissioning.analytic import analytic
from lowfc.programs.core.recording.volume import check_folder, estimate
from lowfc.programs.launch.processes import program, stop_all
from lowfc.programs.launch.status import screen, status_line
from lowfc.programs.launch.watch import Watch, summary

POLL_S = 0.02
SETTLE_S = 0.02
"""Time from the last frame to the stop of the controller, for the last command to arrive."""
LINE_PERIOD_S = 5.0  # between two status lines, if the output is not a terminal
SHOW_S = 0.1  # between two updates of the status on a terminal; also the wait for the last Health


class ProcessDiedError(LowfcError):
    """A process of the loop ended unexpectedly."""

    exit_status = 1


def sim_loop(
    config: Configuration, duration_s: float | None, record: bool, show: Show | None = None, name: str | None = None
) -> dict[str, Any]:
    """Run the simulated loop for a time, or until Ctrl-C; return the summary that `--json` prints.

    The loop continues if the view ends. ProcessDiedError if another process ended, BusError if the run is in use.
    """
    console = Console(stderr=True)
    require_screen(show)
    if record:
        check_folder(config)
    watch = Watch({}, [])
    children: list[Child] = []
    run = _new_run(config, name)
    cleanup = contextlib.ExitStack()
    try:
        cleanup.callback(run.remove)
        cleanup.callback(stop_all, children)
        console.print(f"run {run.run_id}", highlight=False)
        if record:
            console.print(estimate(config), highlight=False, markup=False, soft_wrap=True)
        try:
            bus = ZenohBus(run.links, Role.LAUNCHER, HostClock())  # its listener marks the run as starting
        except BusError:
            if run.links.live():  # another launcher of this run was faster: the directory is that launcher's
                cleanup.pop_all()
            raise
        cleanup.callback(bus.close)
        bus.subscribe(HEALTH, watch.add_health)
        bus.subscribe(EVENT, watch.add_event)
        prepare(config, run, console)
        children += children_of(config, run, duration_s, record)
        if show is not None:
            children.insert(len(children) - record, _view(run, show, console))  # a recorder is stopped after it
        for child in children:
            child.start()
        _supervise(config, children, watch, console, duration_s)
    except ProcessDiedError as fault:
        log = watch.health_of(Role.RECORDER).recording.file
        raise ProcessDiedError(f"{fault}\nrecorded until then: {log}" if log else str(fault)) from fault
    finally:
        cleanup.close()
    return {"run": run.run_id} | summary(watch, record, config.lockstep_hz)


def _new_run(config: Configuration, name: str | None) -> Run:
    """Open a run that no other launcher uses; a directory left by a killed launcher is reused."""
    run = open_run(new_run_id() if name is None else name, (config.mirror.name,), listeners=(Role.LAUNCHER,))
    if living := run.links.live():
        raise BusError(f"run {run.run_id!r} is already running ({', '.join(sorted(living))}): use another name")
    if Role.LAUNCHER not in run.links.ports:
        raise BusError(
            f"run {run.run_id!r} was created by processes started by hand: use another name, or remove its directory "
            f"{run.path}"
        )
    return run


def prepare(config: Configuration, run: Run, console: Console) -> None:
    """Write calibration and configuration to the run's directory."""
    calibration_file.save(analytic(config, console), run.path / "calibration.fits")
    write_whole(run.path / "config.toml", config.to_toml().encode(), mode=MODE)


def children_of(config: Configuration, run: Run, duration_s: float | None, record: bool) -> list[Child]:
    """The processes in the order of the data flow, in which they are stopped; the camera ends by itself."""
    common_options = ["--run", run.run_id, "--config", str(run.path / "config.toml")]
    calibration = ["--calibration", str(run.path / "calibration.fits")]
    mirror = mirror_role(config.mirror.name)
    awaited = [Role.CONTROLLER, mirror, *([Role.RECORDER] if record else [])]
    camera = ["-m", "sim_camera", *common_options, *(part for name in awaited for part in ("--wait-for", str(name)))]
    if duration_s is not None:
        camera += ["--frames", str(max(1, math.ceil(duration_s * config.camera.rate_hz)))]
    # In lockstep, recording starts before the controller: all logs of one seed start with the same message.
    after_recorder = ["--wait-for", str(Role.RECORDER)] if record and config.lockstep else []
    commands = {
        str(Role.CAMERA): camera,
        str(Role.CONTROLLER): ["-m", "lowfc", "controller", *common_options, *calibration, *after_recorder],
        mirror: ["-m", "sim_dm", *common_options],
    }
    if record:
        commands[str(Role.RECORDER)] = ["-m", "lowfc", "record", *common_options, *calibration]
    return [program(name, arguments, run.path / f"{name}.stderr") for name, arguments in commands.items()]


def _view(run: Run, show: Show, console: Console) -> Child:
    """The view's process; prints its address for a browser."""
    port, web_port = free_ports(2)
    arguments = ["-m", "lowfc", "view", "--run", run.run_id, f"--{show}", "--port", str(port)]
    if show is Show.WEB:
        arguments += ["--web-port", str(web_port)]
        console.print(f"view: {web_address(stream_url(port), web_port)}", soft_wrap=True, highlight=False)
    return program(str(Role.VIEWER), arguments, run.path / f"{Role.VIEWER}.stderr")


def _supervise(
    config: Configuration, children: list[Child], watch: Watch, console: Console, duration_s: float | None
) -> None:
    """Show the status until the camera ends or a signal arrives, then stop all; ProcessDiedError if a process died."""
    camera = children[0]
    view = next((child for child in children if child.name == Role.VIEWER), None)
    display = (
        Live(console=console, refresh_per_second=4, transient=True) if console.is_terminal else contextlib.nullcontext()
    )
    due_s = period_s = SHOW_S if console.is_terminal else LINE_PERIOD_S
    with deferred_signals() as interrupted, display as live:
        begun_s = time.monotonic()
        while camera.status is None and watch.health_of(Role.CAMERA).state != "stopped" and not interrupted():
            raise_if_died(children[1:])
            if view is not None and view.status is not None:
                _report_view_ended(view, console)
                view = None
            elapsed_s = time.monotonic() - begun_s
            if elapsed_s >= due_s:
                due_s += period_s
                if live is not None:
                    live.update(screen(watch, config, duration_s, elapsed_s))
                else:
                    sys.stderr.write(status_line(watch, elapsed_s, config.lockstep_hz) + "\n")
            time.sleep(POLL_S)
        if not interrupted():
            raise_if_died(children)
        if interrupted():
            camera.stop(timeout_s=5.0)
        time.sleep(SETTLE_S)
        stop_all([*children[1:], camera])
        time.sleep(SHOW_S)  # for the last Health to arrive
    for child in children:
        if child.name == Role.VIEWER:
            continue
        if child.name == Role.RECORDER and watch.health_of(Role.RECORDER).recording.failure:
            continue  # the loop ended normally without a recorder; the summary gives the reason
        if child.status not in (0, -signal.SIGTERM, INTERRUPTED):  # the last two: stopped before it was ready
            raise died(child)


def died(child: Child) -> ProcessDiedError:
    """The error for a process that ended, with the end of its output."""
    tail = child.stderr_tail()
    return ProcessDiedError(child.exit_description() + (f"; the end of its output:\n{tail}" if tail else ""))


def raise_if_died(children: list[Child]) -> None:
    """Raise ProcessDiedError if a process ended unexpectedly; a view may end at any time, a camera after its frames."""
    for child in children:
        may_end = child.name == Role.VIEWER or (child.name == Role.CAMERA and child.status == 0)
        if child.status is not None and not may_end:
            raise died(child)


def _report_view_ended(view: Child, console: Console) -> None:
    """Report why the view ended, with the last line of its standard error, unless the user closed its window."""
    if view.status != 0:
        why = view.stderr_tail().splitlines()[-1:] if view.status is not None and view.status > 0 else []
        ending = "; ".join([view.exit_description(), *why])
        text = f"the loop continues without a view ({ending}); `lowfc view` opens another"
        console.print(text, markup=False, soft_wrap=True)


@contextlib.contextmanager
def deferred_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C or SIGTERM was received; a second signal raises KeyboardInterrupt."""
    caught: list[int] = []

    def catch(number: int, frame: FrameType | None) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    previous_handlers = {number: signal.signal(number, catch) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(caught)
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)
