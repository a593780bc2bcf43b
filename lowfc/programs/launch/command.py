"""The command `lowfc sim-loop`."""

import os
from typing import Annotated, Any

import typer

from lowfc.adapters.process.terminal import ConfigFile, Json, configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.sections import Preset
from lowfc.programs.cli.output import print_result


def sim_loop(
    config: ConfigFile = None,
    duration: Annotated[
        float | None,
        typer.Option(min=0.01, max=1e7, help="Duration, s, in simulated time with --lockstep; default: until Ctrl-C."),
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Frames per second.")] = None,
    disturbance: Annotated[Preset | None, typer.Option(help="Preset of the disturbance.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.")] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="sam, bowtie, clowfs, zwfs, bar, lyot, aplc, ...; or a mask: NAME, FILE.json or FILE.json:NAME."
        ),
    ] = None,
    star_magnitude: Annotated[float | None, typer.Option(help="V magnitude of the star.")] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Reproducible: each frame waits for the mirror.")
    ] = False,
    no_record: Annotated[bool, typer.Option("--no-record", help="Write no log.")] = False,
    open_loop: Annotated[bool, typer.Option("--open", help="Start with the loop open.")] = False,
    view_: Annotated[bool, typer.Option("--view", help="Open the view in a window.")] = False,
    web: Annotated[bool, typer.Option("--web", help="Serve the view as a page for a browser.")] = False,
    name: Annotated[str | None, typer.Option("--run", help="Name of the run; default: a new one.")] = None,
    as_json: Json = False,
) -> None:
    """Run the simulated loop (camera, mirror, controller, recorder), show its status and print a summary at the end.

    Example: lowfc sim-loop --rate 1000 --duration 20 --disturbance reaction-wheel --star-magnitude 2
    """
    from lowfc.adapters.process.realtime import spread
    from lowfc.adapters.viewer.rerun_viewer import Show, has_screen
    from lowfc.contract.sections import sensor_keys
    from lowfc.programs.core.start_up import check_files
    from lowfc.programs.launch.sim_loop import sim_loop as run
    from lowfc.programs.launch.status import summary_text

    overrides: dict[str, Any] = {
        "camera.rate_hz": rate,
        "disturbance.preset": disturbance,
        "seed": seed,
        **({f"sensor.{key}": value for key, value in sensor_keys(sensor).items()} if sensor is not None else {}),
        "star.magnitude": star_magnitude,
        "lockstep": lockstep or None,
        "control.start_mode": "open" if open_loop else None,
    }
    settings = configuration(config, overrides, {"control.start_mode": "closed", **spread(os.sched_getaffinity(0))})
    check_files(settings)
    if settings.control.start_mode == "open":
        source = "--open" if open_loop else f"control.start_mode of {config}"
        typer.echo(f"the loop starts open ({source}): `lowfc ctl close` closes it", err=True)
    if view_ and web:
        raise ConfigurationError("--view and --web exclude each other: use one")
    if has_screen() and not (view_ or web):
        typer.echo("to view the run: lowfc view", err=True)
    show = Show.NATIVE if view_ else Show.WEB if web else None
    results = run(settings, duration, not no_record, show, name)
    print_result(results, summary_text(results, settings.lockstep_hz), as_json=as_json)
    if results["recording_failure"]:
        raise typer.Exit(1)
