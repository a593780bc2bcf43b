"""The command `lowfc tune`: find the best control law for a log or a running loop."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from lowfc.adapters.process.terminal import AnyRun, Json, LogsOrLive
from lowfc.contract.errors import ConfigurationError, DataFileError, LowfcError, RequestRefusedError, raised_as
from lowfc.programs.cli.result import print_result

if TYPE_CHECKING:
    from lowfc.client import Answer, Client

Kind = Literal["integrator", "pi-notch", "lqg"]


def tune(
    logs: LogsOrLive = None,
    controller: Annotated[Kind, typer.Option(help="Kind of law.")] = "integrator",
    live: Annotated[float | None, typer.Option(min=1.0, max=1e5, help="Seconds to observe a running loop.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the law to this file (FITS).")] = None,
    apply: Annotated[bool, typer.Option("--apply", help="Apply the gains or the law to the running loop.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Plot the spectra to this file (PNG).")] = None,
    run: AnyRun = None,
    as_json: Json = False,
) -> None:
    """Find the best gains, notches or Kalman filter for the measured disturbance, with stability margins.

    Example: lowfc tune last --controller lqg --out lqg.fits --plot lqg.png
    """
    from rich.console import Console

    from lowfc.adapters.files.drawing import figure_class
    from lowfc.adapters.files.law_file import save
    from lowfc.adapters.files.whole_file import require_folder, write_whole
    from lowfc.adapters.logs.parts import WholeLog, named_log
    from lowfc.adapters.process.progress import passing_bar, reading_bar
    from lowfc.client import Client, the_run
    from lowfc.programs.commissioning.tune.data import telemetry_from_log, telemetry_from_run
    from lowfc.programs.commissioning.tune.result import picture, result_of, tuned

    if bool(logs) == (live is not None):
        raise ConfigurationError("give one LOG, or observe a running loop with --live SECONDS")
    if logs and run is not None and not apply:
        raise ConfigurationError("--run has no effect on a LOG without --apply: omit it")
    console = Console(stderr=True)
    require_folder(out, plot)
    if apply:
        the_run(run)  # if there is no such loop, the error comes before the work, not after it
    if plot is not None:
        figure_class()  # likewise, if matplotlib is missing
    if logs:
        log = named_log(logs)
        with reading_bar(console) as count:
            telemetry = telemetry_from_log(WholeLog(log, partial(count, "reading")))
    else:
        with Client(run) as loop, passing_bar(console) as bar:
            task = bar.add_task("observing", total=live)
            telemetry = telemetry_from_run(loop, live or 0.0, lambda passed_s: bar.update(task, completed=passed_s))
    with passing_bar(console) as bar:
        bar.add_task(f"tuning {controller}", total=None)
        with raised_as(DataFileError, ValueError, telemetry.source):
            best, gains = tuned(telemetry, controller)
        result = result_of(telemetry, best, gains, controller)
    result.files = [str(file) for file in (out, plot) if file is not None]
    result.applied = None  # set, so that --json has it also without --apply
    if out is not None:
        save(best.law, out)
    if plot is not None:
        write_whole(plot, picture(telemetry, best))
    try:
        if apply:
            with Client(run) as loop:
                integrator = controller == "integrator"
                answer = apply_gains(loop, gains.gain.tolist(), telemetry.noll) if integrator else loop.law(best.law)
            result.applied = answer.sentence
    finally:  # also if the loop refuses the law: a warning may say why
        print_result(result, as_json=as_json)


def apply_gains(loop: "Client", gains: list[float], noll: tuple[int, ...]) -> "Answer":
    """Let the integrator drive the mirror with these gains; on refusal the previous law stays in force."""
    from lowfc.contract.codecs.law_codec import driving

    previous_law = driving(loop.status().state, loop.laws())
    if previous_law is None:
        return loop.gain(gains, noll)
    loop.law(None)  # only the integrator has gains
    try:
        return loop.gain(gains, noll)
    except BaseException as fault:
        try:
            loop.law(previous_law)
        except LowfcError as second_fault:
            raise RequestRefusedError(
                f"{fault}; the integrator now drives the mirror, because the law {previous_law.name!r} could not be "
                f"restored: {second_fault}"
            ) from None
        raise
