"""The command `lowfc`: arguments only; every command is a function elsewhere."""

import json
import os
import sys
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from lowfc import __version__
from lowfc.adapters.terminal import DEFAULT_RUN, AnyRun, ConfigFile, Json, RunId, configuration, new_app, run_app
from lowfc.contract.configuration import Preset
from lowfc.contract.errors import ConfigurationError
from lowfc.programs.acceptance.command import acceptance_app
from lowfc.programs.bench.record import bench_record
from lowfc.programs.bench.view import bench_view
from lowfc.programs.calibrate.command import calibrate_app
from lowfc.programs.chaos.command import chaos
from lowfc.programs.commission.command import commission
from lowfc.programs.conformance.command import conformance_app
from lowfc.programs.ctl.command import ctl_app
from lowfc.programs.design.command import design_app
from lowfc.programs.doctor.command import doctor
from lowfc.programs.export.command import export
from lowfc.programs.hosts import certs, hosts, router
from lowfc.programs.latency.command import latency
from lowfc.programs.log.info import info
from lowfc.programs.log.recover import recover
from lowfc.programs.output import put
from lowfc.programs.replay.command import replay_log
from lowfc.programs.report.command import report
from lowfc.programs.runs import runs
from lowfc.programs.soak.command import soak
from lowfc.programs.tune.command import tune
from lowfc.programs.validate.commands import validate
from lowfc.programs.view.command import view

app = new_app("Low-order wavefront control for coronagraphs.\n\nExample: lowfc sim-loop --duration 20")
bench_app = new_app("Measure the parts.\n\nExample: lowfc bench twin")
config_app = new_app("Show and check the configuration.\n\nExample: lowfc config show")
app.add_typer(ctl_app, name="ctl")
app.add_typer(config_app, name="config")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(acceptance_app, name="acceptance")
app.add_typer(conformance_app, name="conformance")
app.add_typer(bench_app, name="bench")
app.add_typer(design_app, name="design")
app.command("replay")(replay_log)
bench_app.command("record")(bench_record)
bench_app.command("view")(bench_view)
app.command()(info)
app.command()(recover)
app.command()(report)
app.command()(export)
app.command()(doctor)
app.command()(latency)
app.command()(validate)
app.command()(tune)
app.command()(commission)
app.command()(chaos)
app.command()(soak)
app.command()(certs)
app.command()(router)
app.command()(hosts)
app.command()(runs)
app.command()(view)


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    """Low-order wavefront control for coronagraphs."""
    if version:
        _print(__version__)
    elif context.invoked_subcommand is None:
        _print(context.get_help())


@app.command("sim-loop")
def sim_loop(
    config: ConfigFile = None,
    duration: Annotated[float | None, typer.Option(min=0.01, max=1e7, help="Seconds; default: until Ctrl-C.")] = None,
    rate: Annotated[float | None, typer.Option(help="Frames per second.")] = None,
    disturbance: Annotated[Preset | None, typer.Option(help="What shakes the wavefront.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of every random number.")] = None,
    sensor: Annotated[
        str | None,
        typer.Option(help="sam, bowtie, clowfs, zwfs, bar, lyot, aplc; or a layout, FILE.json or FILE.json:NAME."),
    ] = None,
    star_magnitude: Annotated[float | None, typer.Option(help="V magnitude of the star.")] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Deterministic: each frame waits for the mirror.")
    ] = False,
    no_record: Annotated[bool, typer.Option("--no-record", help="Write no log.")] = False,
    open_loop: Annotated[bool, typer.Option("--open", help="Start with the loop open.")] = False,
    view_: Annotated[bool, typer.Option("--view", help="Look at it in a window.")] = False,
    web: Annotated[bool, typer.Option("--web", help="Look at it in a browser.")] = False,
    name: Annotated[str | None, typer.Option("--run", help="Name of the run; default: a new one.")] = None,
    as_json: Json = False,
) -> None:
    """Start the simulated loop: camera, mirror, controller and recorder; show its status, end with a summary.

    Example: lowfc sim-loop --rate 1000 --duration 20 --disturbance reaction-wheel --star-magnitude 2
    """
    from lowfc.adapters.realtime import spread
    from lowfc.adapters.rerun_viewer import Show, has_screen
    from lowfc.contract.configuration import sensor_keys
    from lowfc.programs.recording.volume import outlook
    from lowfc.programs.sim_loop import sim_loop as run
    from lowfc.programs.start_up import check_files
    from lowfc.programs.status import summary_text

    overrides: dict[str, Any] = {
        "camera.rate_hz": rate,
        "disturbance.preset": disturbance,
        "seed": seed,
        **({f"sensor.{key}": value for key, value in sensor_keys(sensor).items()} if sensor else {}),
        "star.magnitude": star_magnitude,
        "lockstep": lockstep or None,
        "control.start_mode": "open" if open_loop else None,
    }
    settings = configuration(config, overrides, {"control.start_mode": "closed", **spread(os.sched_getaffinity(0))})
    check_files(settings)
    if settings.control.start_mode == "open":
        chosen = "--open" if open_loop else f"control.start_mode of {config}"
        _print(f"the loop starts open ({chosen}): `lowfc ctl close` closes it", error=True)
    if view_ and web:
        raise ConfigurationError("a view is in one place: choose --view or --web")
    if has_screen() and not (view_ or web):
        _print("to look at it: lowfc view", error=True)
    if not no_record:
        _print(outlook(settings), error=True)
    show = Show.NATIVE if view_ else Show.WEB if web else None
    figures = run(settings, duration, not no_record, show, name)
    put(figures, summary_text(figures), as_json=as_json)
    if figures["recording_failure"]:
        raise typer.Exit(1)


@app.command()
def controller(
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration file (FITS), or none; default: computed from the configuration."),
    ] = None,
) -> None:
    """Run the controller: frames from the bus, commands to it.

    Example: lowfc controller --run bench --calibration calibration.fits
    """
    import signal

    from rich.console import Console

    from lowfc.adapters.calibration_file import load
    from lowfc.adapters.join import join
    from lowfc.adapters.latch import Latch, latch_files
    from lowfc.adapters.run import open_run
    from lowfc.contract.messages import Role
    from lowfc.programs.analytic import analytic
    from lowfc.programs.controller import Controller

    signalled: list[int] = []  # before there is a loop to be made safe
    signal.signal(signal.SIGUSR1, lambda number, _: signalled.append(number))
    settings = configuration(config)
    found = None
    if calibration is None:
        found = analytic(settings, Console(stderr=True))
    elif str(calibration) != "none":
        found = load(calibration)
    service = join(settings, run, Role.CONTROLLER, settings.realtime.controller_cpus)
    source = calibration.name if calibration is not None else "the configuration"
    latch = Latch(
        latch_files(open_run(run, (settings.mirror.name,))), lambda why: service.event("LATCH_FAILED", why=why)
    )
    process = Controller(settings, service, found, source, latch)
    signal.signal(signal.SIGUSR1, lambda number, _: process.safe_by_signal())
    if signalled:
        process.safe_by_signal()
    service.fill = process.fill
    service.catch_signals()
    with closing(service.bus):  # a callback on zenoh's threads must not outlive the interpreter
        process.run()


@app.command()
def record(
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file to put into the log.")] = None,
    folder: Annotated[str | None, typer.Option(help="Where logs are written; default: recorder.folder.")] = None,
    largest_mb: Annotated[float | None, typer.Option(help="Size at which the next log is begun.")] = None,
    longest_s: Annotated[float | None, typer.Option(help="Age at which the next log is begun.")] = None,
    min_free_mb: Annotated[
        float | None, typer.Option(help="Free space on the disk below which nothing is recorded.")
    ] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Record every Nth frame and mirror state; steps and commands are whole.")
    ] = None,
    topics: Annotated[
        list[str] | None,
        typer.Option(help="Of frames, mirror state and surface, truth and timing, only these; repeat."),
    ] = None,
    words: Annotated[list[str] | None, typer.Argument(hidden=True)] = None,
    as_json: Json = False,
) -> None:
    """Record a run's messages into MCAP logs until told to stop.

    Example: lowfc record --run bench --folder logs --longest-s 600 --min-free-mb 2000
    """
    from lowfc.adapters.join import clock_of
    from lowfc.adapters.log_series import Limits
    from lowfc.adapters.run import open_run
    from lowfc.adapters.whole_file import write_whole
    from lowfc.programs.recording.process import record as run_recorder
    from lowfc.programs.recording.summary import figures, report
    from lowfc.programs.recording.volume import bytes_per_s, outlook, selected

    overrides = {
        "recorder.folder": folder,
        "recorder.largest_mb": largest_mb,
        "recorder.longest_s": longest_s,
        "recorder.min_free_mb": min_free_mb,
        "recorder.every": every,
        "recorder.topics": topics or None,
    }
    if words:
        hint = f"; `lowfc ctl record {words[0]}` asks a recorder that runs" if words[0] in ("start", "stop") else ""
        raise ConfigurationError(f"lowfc record takes options only, got {' '.join(words)!r}{hint}")
    settings = configuration(config, overrides)
    log, recorded = settings.recorder, selected(settings)
    joined = open_run(run, (settings.mirror.name,), network=settings.network)
    complete = joined.path / "config.toml"  # a file may name only what was chosen; the log names every value
    write_whole(complete, settings.to_toml().encode())
    done = run_recorder(
        joined,
        Path(log.folder),
        configuration=complete,
        calibration=calibration,
        seed=settings.seed,
        limits=Limits(round(log.largest_mb * 1e6), log.longest_s, round(log.min_free_mb * 1e6), int(log.file_mode, 8)),
        clock=clock_of(settings),
        priority=(settings.realtime.priority and settings.realtime.recorder_priority) or None,
        cpus=set(settings.realtime.recorder_cpus) or None,
        selection=recorded,
        expected_bytes_per_s=bytes_per_s(settings, recorded),
        begins=lambda: _print(outlook(settings), error=True),
    )
    if as_json:
        _print(json.dumps(figures(done)))
    else:
        _print(report(done), error=True)
    if done.failure:
        raise typer.Exit(1)


@config_app.command("show")
def config_show(config: ConfigFile = None) -> None:
    """Print every key with its value and its sentence, as TOML; keys that nobody chose are commented out.

    Example: lowfc config show > lowfc.toml
    """
    from lowfc.programs.config import commented

    _print(commented(configuration(config)))


@config_app.command("check")
def config_check(config: Annotated[Path, typer.Argument(help="Configuration file (TOML).")]) -> None:
    """Check a configuration file and the files it names; exit status 2 and one line per mistake where it is wrong.

    Example: lowfc config check lowfc.toml
    """
    from lowfc.programs.start_up import check_files

    check_files(configuration(config))
    _print(f"{config}: fine")


@config_app.command("zenoh")
def config_zenoh(
    role: Annotated[str, typer.Option(help="Role of your program, such as camera.")],
    run: AnyRun = None,
    make: Annotated[bool, typer.Option("--make", help="Make the run, if it is not there.")] = False,
) -> None:
    """Print the zenoh configuration for a program of your own that plays a role in a run.

    Example: lowfc config zenoh --role camera --run bench
    """
    from lowfc.programs.config import zenoh_session

    _print(zenoh_session(run, role, make=make))


@bench_app.command("twin")
def bench_twin(as_json: Json = False) -> None:
    """Time the real-time twin against the full optical chain, both on one thread, in the same run.

    Example: lowfc bench twin --json
    """
    from lowfc.programs.bench.twin import bench_twin as measure
    from lowfc.programs.bench.twin import render

    figures = measure()
    put(figures, render(figures), as_json=as_json)


def main() -> None:
    """Entry point."""
    run_app(app)


def _print(text: str, *, error: bool = False) -> None:
    (sys.stderr if error else sys.stdout).write(text + "\n")
