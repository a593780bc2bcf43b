"""The command `lowfc calibrate`: command-line arguments."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from lowfc.adapters.process.terminal import AnyRun, ConfigFile, Json, new_app, options_set
from lowfc.contract.errors import ConfigurationError
from lowfc.control.calibration.response_fit import MIN_CYCLES
from lowfc.programs.cli.result import print_result

calibrate_app = new_app("")

Method = Literal["analytic", "poke", "hadamard", "in-loop"]
Out = Annotated[Path, typer.Option("--out", help="Output file (FITS); an existing one is replaced.")]
Load = Annotated[bool, typer.Option("--load", help="Load the result into the loop, which must be open.")]
Snr = Annotated[float, typer.Option(min=1, max=1e4, help="Signal-to-noise ratio to reach in the noisiest mode.")]
_CYCLES = "Number of cycles; default: as many as --snr requires. If given, --snr (default 20) decides only the verdict."
Cycles = Annotated[int | None, typer.Option(min=MIN_CYCLES, help=_CYCLES)]
Resume = Annotated[bool, typer.Option("--resume", help="Continue an interrupted calibration.")]
Frames = Annotated[int, typer.Option(min=16, max=100_000, help="Number of frames to average.")]


@calibrate_app.callback(invoke_without_command=True)
def calibrate(
    context: typer.Context,
    method: Annotated[Method, typer.Option(help="Method by which H is measured or computed.")] = "hadamard",
    out: Out = Path("calibration.fits"),
    run: AnyRun = None,
    config: ConfigFile = None,
    snr: Snr = 70.0,
    amplitude: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            help="Poke amplitude, nm rms of wavefront; default: poke 8, hadamard 3, in-loop 2; less above --snr 70.",
        ),
    ] = None,
    cycles: Cycles = None,
    resume: Resume = False,
    truncate: Annotated[
        float, typer.Option(min=0, max=0.99, help="Discard singular values below this fraction of the largest.")
    ] = 0.0,
    tikhonov: Annotated[
        float, typer.Option(min=0, max=0.99, help="Damp singular values below about this fraction of the largest.")
    ] = 0.0,
    at: Annotated[
        str | None,
        typer.Option(
            help="Wavefront at which --method analytic computes I0 and H: modes in nm rms, as in 4=15,7=-10, or a file "
            "with a mirror shape, nm of surface. Default: flat.",
            show_default=False,
        ),
    ] = None,
    load: Annotated[
        bool,
        typer.Option(
            "--load",
            help="Load the result into the loop. A closed loop is opened for this and closed again; --method "
            "analytic requires an open loop.",
        ),
    ] = False,
    compare: Annotated[
        tuple[Path, Path] | None, typer.Option(help="Only compare two calibration files.", metavar="A.fits B.fits")
    ] = None,
    as_json: Json = False,
) -> None:
    """Calibrate a running loop by poking its mirror, or compute its calibration.

    The measured calibration is checked with separate frames. If it is not recommended, it is written as
    NAME.rejected.fits and not loaded, and the exit status is 1.

    The mirror returns to its previous shape, also after Ctrl-C; --resume then continues after the completed cycles.

    Example: lowfc calibrate --method poke --snr 300 --out night.fits
    """
    options = options_set(context)
    if context.invoked_subcommand is not None:
        if options:
            raise ConfigurationError(f"{options[0]} is before `{context.invoked_subcommand}`: put the options after it")
        return
    from lowfc.adapters.files.calibration_file import load as read
    from lowfc.programs.commissioning.calibrate import tasks
    from lowfc.programs.commissioning.calibrate.pokes import MIN_SNR, CalibrationRequest
    from lowfc.programs.commissioning.calibrate.result import comparison

    if compare is not None:
        if others := [option for option in options if option not in ("--compare", "--json")]:
            raise ConfigurationError(f"{others[0]} has no effect with --compare, which only compares: omit it")
        print_result(comparison(*map(read, compare)), as_json=as_json)
        return
    if cycles is not None and "--snr" not in options:
        snr = MIN_SNR
    request = CalibrationRequest(method, out, snr, cycles, amplitude, resume, truncate, tikhonov)
    if method == "analytic":
        for option in ("--snr", "--amplitude", "--cycles", "--resume"):
            if option in options:
                raise ConfigurationError(f"{option} is for pokes, but --method analytic computes H: omit it")
        if "--run" in options and not load:
            raise ConfigurationError("--run has no effect with --method analytic unless --load is given: omit it")
        print_result(tasks.compute_calibration(config, request, at, run, load=load), as_json=as_json)
        return
    for option in ("--config", "--at"):
        if option in options:
            raise ConfigurationError(
                f"{option} requires --method analytic: a running loop is measured at its present wavefront and with "
                "its own configuration"
            )
    result = tasks.calibrate_with_pokes(request, run, load=load)
    print_result(result, as_json=as_json)
    if not result.recommended:
        raise typer.Exit(1)


calibrate_app.info.help = calibrate.__doc__


@calibrate_app.command()
def dark(
    context: typer.Context,
    out: Out = Path("calibration.fits"),
    run: AnyRun = None,
    frames: Frames = 400,
    star_blocked: Annotated[
        bool, typer.Option("--star-blocked", help="The star is already blocked: do not ask.")
    ] = False,
    file: Annotated[
        Path | None,
        typer.Option("--file", help="Read the dark frames from a FITS or .npy cube (frames, rows, columns)."),
    ] = None,
    load: Load = False,
    as_json: Json = False,
) -> None:
    """Measure the dark and find bad pixels; write the calibration in use with the new dark and bad pixels.

    Block the star first.

    Example: lowfc calibrate dark --frames 1000 --out night.fits
    """
    from lowfc.programs.commissioning.calibrate.tasks import take_dark

    if file is not None and "--frames" in options_set(context):
        raise ConfigurationError("--frames has no effect with --file, whose frames are all used: omit it")
    if file is None and not star_blocked:
        typer.confirm("block the star; is it dark?", default=True, abort=True, err=True)
    print_result(take_dark(out, run, frames, file, load=load), as_json=as_json)


@calibrate_app.command()
def reference(
    out: Out = Path("calibration.fits"),
    run: AnyRun = None,
    frames: Frames = 1000,
    load: Load = False,
    as_json: Json = False,
) -> None:
    """Take the present wavefront as the zero point; write the calibration in use with the new reference image.

    The wavefront need not be flat. H does not change: far from flat, measure H there with --method poke or hadamard,
    or compute it with --method analytic --at.

    Example: lowfc calibrate reference --frames 5000 --out night.fits
    """
    from lowfc.programs.commissioning.calibrate.tasks import take_reference

    print_result(take_reference(out, run, frames, load=load), as_json=as_json)


@calibrate_app.command()
def align(
    out: Out = Path("calibration.fits"),
    run: AnyRun = None,
    frames: Frames = 1000,
    load: Load = False,
    as_json: Json = False,
) -> None:
    """Fit how the sensor is placed relative to the computed image; compute and write a calibration for its pixels.

    A rotation by 180 degrees does not change the image but reverses tip and tilt: a poke resolves the ambiguity.

    Example: lowfc calibrate align --out aligned.fits
    """
    from lowfc.programs.commissioning.calibrate.align import align_sensor

    print_result(align_sensor(out, run, frames, load=load), as_json=as_json)
