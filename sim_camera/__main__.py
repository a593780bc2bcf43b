"""Command line of the simulated camera."""

import typer

from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.device import run_camera
from lowfc.device.plugins import opened
from lowfc.device.run import PASSED_ON, Frames, WaitFor, driver_command
from sim_camera.driver import SimulatedCamera

app = new_app("The simulated sensor camera.\n\nExample: sim-camera --run bench --config lowfc.toml")


@app.command(cls=driver_command("camera", "sim"), context_settings=PASSED_ON)
def camera(
    context: typer.Context,
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    frames: Frames = None,
    wait_for: WaitFor = None,
) -> None:
    """Publish simulated frames in a run, with the mirror's shape from the bus and a disturbance drawn from the seed.

    Example: sim-camera --run bench --wait-for controller --wait-for mirror-dm
    """
    settings = configuration(config)
    driver = opened("camera", "sim", settings, context.args, SimulatedCamera)
    run_camera(driver, settings, run, frames, tuple(wait_for or ()))


def main() -> None:
    """Entry point."""
    run_app(app)


if __name__ == "__main__":
    main()
