"""The command `lowfc tune`: the best control law for a log, or for a loop that is running."""

from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.process.terminal import AnyRun, Json, LogsIfAny
from lowfc.contract.errors import ConfigurationError, DataFileError, LowfcError, RequestRefusedError
from lowfc.programs.cli.output import put

if TYPE_CHECKING:
    from rich.console import Console

    from lowfc.adapters.logs.parts import LogFiles
    from lowfc.client import Answer, Client


class ControllerKind(StrEnum):
    """What can be tuned."""

    INTEGRATOR = "integrator"
    PI_NOTCH = "pi-notch"
    LQG = "lqg"


def tune(
    logs: LogsIfAny = None,
    controller: Annotated[ControllerKind, typer.Option(help="Kind of law.")] = ControllerKind.INTEGRATOR,
    live: Annotated[float | None, typer.Option(min=1.0, help="Listen to a running loop, for seconds.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the law to this file (FITS).")] = None,
    apply: Annotated[bool, typer.Option("--apply", help="Give the gains, or the law, to the running loop.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw spectra into this file (PNG).")] = None,
    run: AnyRun = None,
    as_json: Json = False,
) -> None:
    """Find the best gains, notches or Kalman filter for what shakes the wavefront, with margins.

    Example: lowfc tune last --controller lqg --out lqg.fits --plot lqg.png
    """
    from rich.console import Console

    from lowfc.adapters.logs.parts import the_one
    from lowfc.programs.commissioning.tune.figures import render

    if bool(logs) == (live is not None):
        raise ConfigurationError("name one LOG, or listen to a running loop with --live SECONDS")
    log = the_one(logs) if logs else None
    found = tune_run(log, str(controller), live, out, apply=apply, plot=plot, run=run, console=Console(stderr=True))
    done = [f"written: {file}" for file in found["files"]] + ([found["applied"]] if found["applied"] else [])
    put(found, "\n".join([render(found), *done]), as_json=as_json)


def tune_run(
    log: "LogFiles | None",
    controller: str,
    live: float | None = None,
    out: Path | None = None,
    *,
    apply: bool = False,
    plot: Path | None = None,
    run: str | None = None,
    console: "Console",
) -> dict[str, Any]:
    """Tune a law; return the figures that `--json` prints.

    Raises:
        DataFileError: the log cannot be read or has too little in it, or a file cannot be written.
        ConfigurationError: no law of this kind is stable, or there is no matplotlib.
        BusError: there is no such run, or it does not answer.
        RequestRefusedError: the controller refused what was applied.
    """
    from lowfc.adapters.files.law_file import save
    from lowfc.adapters.files.whole_file import require_folder, write_whole
    from lowfc.adapters.logs.parts import WholeLog
    from lowfc.adapters.process.progress import passing_bar, reading_bar
    from lowfc.client import Client
    from lowfc.programs.commissioning.tune.data import of_log, of_run
    from lowfc.programs.commissioning.tune.figures import figures, picture, tuned
    from lowfc.programs.logs.guard import refuse_log

    require_folder(out, plot)
    reader = None if log is None else WholeLog(log, skip_damaged=True)
    for file in (out, plot):
        if file is not None and reader is not None:
            refuse_log(file, reader.path)
    if reader is None:
        with Client(run) as loop, passing_bar(console) as bar:
            task = bar.add_task("listening", total=live)
            telemetry = of_run(loop, live or 0.0, lambda passed_s: bar.update(task, completed=passed_s))
    else:
        with reading_bar(console) as count:
            reader.progress = partial(count, "reading")
            telemetry = of_log(reader)
    with passing_bar(console) as bar:
        bar.add_task(f"tuning {controller}", total=None)
        try:
            best, gains = tuned(telemetry, controller)
        except ValueError as error:
            raise DataFileError(f"{telemetry.source}: {error}") from None
        found = figures(telemetry, best, gains, controller)
    found |= {"files": [], "applied": None}
    if out is not None:
        save(best.law, out)
        found["files"].append(str(out))
    if plot is not None:
        write_whole(plot, picture(telemetry, best))
        found["files"].append(str(plot))
    if apply:
        with Client(run) as loop:
            given = controller == ControllerKind.INTEGRATOR
            answer = integrate(loop, gains.gain.tolist(), telemetry.noll) if given else loop.law(best.law)
        found["applied"] = answer.sentence
    return found


def integrate(loop: "Client", gains: list[float], noll: tuple[int, ...]) -> "Answer":
    """Let the integrator drive the mirror with these gains; where they are not taken, the law before it goes on.

    Raises:
        RequestRefusedError: the gains were refused.
        BusError: the controller did not answer.
    """
    from lowfc.contract.codecs.law_codec import driving

    before = driving(loop.status().state, loop.laws())
    if before is None:
        return loop.gain(gains, noll)
    loop.law(None)  # another law has no gains
    try:
        return loop.gain(gains, noll)
    except BaseException as fault:
        try:
            loop.law(before)
        except LowfcError as another:
            raise RequestRefusedError(
                f"{fault}; the integrator drives the mirror now, for the law {before.name!r} could not be put back: "
                f"{another}"
            ) from None
        raise
