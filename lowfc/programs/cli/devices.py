"""The command-line options of `lowfc camera` and `lowfc mirror`; `lowfc.device` runs the drivers."""

from typing import Annotated

import typer

from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app
from lowfc.device import run_camera, run_mirror
from lowfc.device.plugins import opened
from lowfc.device.run import PASSED_ON, Frames, WaitFor, driver_command

_DRIVER = "Name of an installed driver, module:Class or file.py:Class."
Driver = Annotated[str, typer.Argument(help=_DRIVER, show_default=False)]

camera_app = new_app("")
mirror_app = new_app("")


@camera_app.command(cls=driver_command("camera"), context_settings=PASSED_ON)
def camera(
    context: typer.Context,
    driver: Driver,
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    frames: Frames = None,
    wait_for: WaitFor = None,
) -> None:
    """Run a camera: publish the frames and settings of its driver to a run.

    The driver's own options are in [drivers.DRIVER] of the configuration; those given here take precedence.
    `lowfc camera DRIVER --help` lists them.

    Example: lowfc camera sim --run bench --config lowfc.toml
    """
    settings = configuration(config)
    run_camera(opened("camera", driver, settings, context.args), settings, run, frames, tuple(wait_for or ()))


@mirror_app.command(cls=driver_command("mirror"), context_settings=PASSED_ON)
def mirror(context: typer.Context, driver: Driver, run: RunId = DEFAULT_RUN, config: ConfigFile = None) -> None:
    """Run a mirror: its driver applies the commands of a run, within the mirror's own limits.

    The driver's own options are in [drivers.DRIVER] of the configuration; those given here take precedence.
    `lowfc mirror DRIVER --help` lists them.

    Example: lowfc mirror sim --run bench --config lowfc.toml
    """
    settings = configuration(config)
    run_mirror(opened("mirror", driver, settings, context.args), settings, run)
