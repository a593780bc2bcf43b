"""Command line of the simulated camera."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.process.join import join
from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.contract.messages import Role
from sim_camera.contrast import contrast_of
from sim_camera.faulty import read_fault
from sim_camera.process import CameraProcess, scene

app = new_app("The simulated sensor camera.\n\nExample: sim-camera --run bench --config lowfc.toml")


@app.command()
def camera(
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after so many frames; default: when told to.")] = None,
    wait_for: Annotated[list[str] | None, typer.Option(help="Process that the first frame waits for; repeat.")] = None,
    fault: Annotated[Path | None, typer.Option(hidden=True, help="Fault of the frames (JSON).")] = None,
) -> None:
    """Expose frames of a run: the mirror's surface from the bus, a disturbance from the seed, full diffraction.

    Example: sim-camera --run bench --wait-for controller --wait-for mirror-dm
    """
    settings = configuration(config)
    optics = scene(settings)
    service = join(settings, run, Role.CAMERA, settings.realtime.camera_cpus)
    process = CameraProcess(
        settings, service, optics, frames, None if fault is None else read_fault(fault), contrast_of(settings)
    )
    service.fill = process.fill
    service.catch_signals()
    with closing(service.bus):  # a callback on zenoh's threads must not outlive the interpreter
        process.run(tuple(wait_for or ()))


def main() -> None:
    """Entry point."""
    run_app(app)


if __name__ == "__main__":
    main()
