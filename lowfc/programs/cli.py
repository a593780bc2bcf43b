"""The command `lowfc`: arguments only; every command is a function elsewhere."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from lowfc import __version__
from lowfc.adapters.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.contract.configuration import Preset

app = new_app("Low-order wavefront control for coronagraphs.\n\nExample: lowfc sim-loop --duration 20")
bench_app = new_app("Measure the parts.\n\nExample: lowfc bench twin")
app.add_typer(bench_app, name="bench")

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]


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
    duration: Annotated[float | None, typer.Option(min=0.01, help="Seconds; default: until Ctrl-C.")] = None,
    rate: Annotated[float | None, typer.Option(help="Frames per second.")] = None,
    disturbance: Annotated[Preset | None, typer.Option(help="What shakes the wavefront.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of every random number.")] = None,
    sensor: Annotated[
        str | None, typer.Option(help="Sparse aperture mask: a name, FILE.json or FILE.json:NAME.")
    ] = None,
    star_magnitude: Annotated[float | None, typer.Option(help="V magnitude of the star.")] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Deterministic: each frame waits for the mirror.")
    ] = False,
    no_record: Annotated[bool, typer.Option("--no-record", help="Write no log.")] = False,
    open_loop: Annotated[bool, typer.Option("--open", help="Start with the loop open.")] = False,
    as_json: Json = False,
) -> None:
    """Start the simulated loop: camera, mirror, controller and recorder; show its status, end with a summary.

    Example: lowfc sim-loop --rate 1000 --duration 20 --disturbance reaction-wheel --star-magnitude 2
    """
    from lowfc.programs.sim_loop import sim_loop as run
    from lowfc.programs.status import report

    overrides: dict[str, Any] = {
        "camera.rate_hz": rate,
        "disturbance.preset": disturbance,
        "seed": seed,
        "sensor.sam": sensor,
        "star.magnitude": star_magnitude,
        "lockstep": lockstep or None,
        "control.start_mode": "open" if open_loop else "closed",
    }
    figures = run(configuration(config, overrides), duration, record=not no_record)
    _print(json.dumps(figures) if as_json else report(figures))


@app.command()
def controller(
    calibration: Annotated[Path, typer.Option(help="Calibration file (FITS).")],
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
) -> None:
    """Run the controller: frames from the bus, commands to it.

    Example: lowfc controller --run bench --calibration calibration.fits
    """
    from lowfc.adapters.calibration_file import load
    from lowfc.adapters.join import join
    from lowfc.contract.messages import Role
    from lowfc.programs.controller import Controller

    settings = configuration(config)
    found = load(calibration)
    service = join(settings, run, Role.CONTROLLER, settings.realtime.controller_cpus)
    process = Controller(settings, service, found, calibration.name)
    service.fill = process.fill
    service.catch_signals()
    process.run()


@app.command()
def record(
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file to put into the log.")] = None,
    folder: Annotated[Path | None, typer.Option(help="Where logs are written; default: recorder.folder.")] = None,
) -> None:
    """Record a run's messages into MCAP logs until told to stop.

    Example: lowfc record --run bench --folder logs
    """
    from lowfc.adapters.run import open_run
    from lowfc.programs.recorder import record as run_recorder

    settings = configuration(config)
    joined = open_run(run, (settings.mirror.name,))
    target = folder if folder is not None else Path(settings.recorder.folder)
    done = run_recorder(joined, target, configuration=config, calibration=calibration, seed=settings.seed)
    lost = sum(done.lost.values())
    _print(f"{done.messages} messages in {', '.join(map(str, done.files))}; {lost} lost", error=True)
    if done.failure:
        raise typer.Exit(1)


@bench_app.command("twin")
def bench_twin(as_json: Json = False) -> None:
    """Time the real-time twin against the full optical chain, both on one thread, in the same run.

    Example: lowfc bench twin --json
    """
    from lowfc.programs.bench_twin import bench_twin as measure
    from lowfc.programs.bench_twin import render

    figures = measure()
    _print(json.dumps(figures) if as_json else render(figures))


def main() -> None:
    """Entry point."""
    run_app(app)


def _print(text: str, *, error: bool = False) -> None:
    (sys.stderr if error else sys.stdout).write(text + "\n")
