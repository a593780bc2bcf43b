"""The command `lowfc commission`: command-line arguments."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.process.terminal import AnyRun, Json
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.programs.cli.output import print_result
from lowfc.programs.commissioning.calibrate.command import Cycles, Resume


def commission(
    out: Annotated[Path, typer.Option("--out", help="Output file (FITS).")] = Path("calibration.fits"),
    run: AnyRun = None,
    frames: Annotated[
        int, typer.Option(min=16, max=100_000, help="Number of frames for the dark, and for the reference image.")
    ] = 400,
    dark: Annotated[Path | None, typer.Option(help="Dark frames: a FITS or .npy cube (frames, rows, columns).")] = None,
    no_dark: Annotated[
        bool, typer.Option("--no-dark", help="Use the camera's bias as the dark, and treat all pixels as good.")
    ] = False,
    snr: Annotated[
        float | None,
        typer.Option(
            min=1, max=1e4, help="Signal-to-noise ratio to reach in each mode; default: 50, or 20 with --cycles."
        ),
    ] = None,
    cycles: Cycles = None,
    resume: Resume = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    close: Annotated[bool, typer.Option("--close", help="Close the loop at the end.")] = False,
    as_json: Json = False,
) -> None:
    """Commission a new camera and mirror: measure a calibration and load it.

    Camera, mirror and controller must be running (`lowfc controller --calibration none`); the light must be on the
    sensor. Steps: camera, dark and bad pixels, reference image, delay, orientation and sign, poke amplitude, response,
    verdict, prediction, closed loop. After each probe sequence the mirror returns to the shape that it had.

    Example: lowfc commission --run bench --out calibration.fits --close
    """
    from rich.console import Console

    from lowfc.adapters.files.whole_file import require_folder
    from lowfc.adapters.process.progress import percentage_bar
    from lowfc.client import Client, configuration_of
    from lowfc.programs.commissioning.analytic import analytic
    from lowfc.programs.commissioning.calibrate.run import partial_path
    from lowfc.programs.commissioning.calibrate.tasks import reporter
    from lowfc.programs.commissioning.commission.commissioning import Commissioning, CommissionOptions, provisional_path

    if dark is not None and no_dark:
        raise ConfigurationError("--dark FILE and --no-dark exclude each other: use one")
    will_resume = resume and (provisional_path(out).exists() or out.exists())
    if dark is None and not no_dark and not will_resume and not sys.stdin.isatty():
        raise ConfigurationError(
            "without a terminal nobody can be asked to block the star for a dark: give dark frames with --dark FILE, "
            "or use the camera's bias with --no-dark"
        )
    if out.exists() and not (resume or force):
        raise DataFileError(f"{out} already exists; use another name (--out), or replace it with --force")
    require_folder(out, provisional_path(out), partial_path(out))
    console = Console(stderr=True)
    report = reporter(console)
    options = CommissionOptions(out, frames, dark, no_dark, snr, cycles, resume, close)

    def confirm(question: str) -> None:
        typer.confirm(question, default=True, abort=True, err=True)

    with Client(run) as loop, loop.reserved("lowfc commission") as lease, percentage_bar(console) as bar:
        config = configuration_of(loop)
        progress = lease.expecting(bar, config.camera.rate_hz)
        results, text = Commissioning(loop, config, analytic(config, console), options, report, progress, confirm).run()
    print_result(results, text, as_json=as_json)
