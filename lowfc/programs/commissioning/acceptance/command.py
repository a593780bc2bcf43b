"""`lowfc acceptance`: arguments only; each test has a module of its own."""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from lowfc.adapters.process.terminal import AnyRun, Json, LogsIfAny, configuration, new_app
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.programs.cli.modes import Modes, noll_of
from lowfc.programs.cli.result import put

if TYPE_CHECKING:
    from lowfc.contract.configuration import Acceptance, Configuration
    from lowfc.control.calibration.calibration import Calibration
    from lowfc.programs.commissioning.acceptance.judged import AcceptanceResult
    from lowfc.programs.commissioning.acceptance.live import Live
    from lowfc.programs.commissioning.acceptance.played import Kind, Played

acceptance_app = new_app(
    "Measure whether a loop does what it must: live, or again from the log of it.\n\n"
    "Exit status 0 only where it passed.\n\nExample: lowfc acceptance rejection"
)

Plot = Annotated[Path | None, typer.Option(help="Draw it into this file (PNG).", show_default=False)]
Required = Annotated[
    Path | None,
    typer.Option("--config", help="Configuration with the requirements; default: the loop's own.", show_default=False),
]


@acceptance_app.command()
def rejection(
    logs: LogsIfAny = None,
    duration: Annotated[float, typer.Option(min=0.1, max=1e5, help="Seconds of the multisine.")] = 60.0,
    rms_nm: Annotated[float, typer.Option(min=1e-3, max=1e3, help="Wavefront rms of each mode.")] = 5.0,
    lines: Annotated[int, typer.Option(min=1, max=1000, help="Frequencies of each mode.")] = 12,
    modes: Modes = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the multisine's phases.")] = 1,
    config: Required = None,
    run: AnyRun = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Measure rejection and noise transfer under a multisine, and compare them with theory.

    Example: lowfc acceptance rejection --duration 60 --plot rejection.png
    """
    from lowfc.programs.commissioning.acceptance import rejection as test

    how = test.Excitation(duration, rms_nm, lines, noll_of(modes), seed)
    of = _measured(test.KIND, Where(logs, run, config, plot), lambda live, must: test.play(live, how, must))
    _say(test.judge(of.every, of.required), test.draw, plot, as_json)


@acceptance_app.command()
def linearity(
    logs: LogsIfAny = None,
    hold: Annotated[int, typer.Option(min=2, help="Frames at each level.")] = 10,
    cycles: Annotated[int, typer.Option(min=2, help="Times that each amplitude is pushed and pulled.")] = 20,
    modes: Modes = None,
    config: Required = None,
    run: AnyRun = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Measure gain and cross-talk of each mode against its size, with the loop open.

    Example: lowfc acceptance linearity --modes 2,3
    """
    from lowfc.programs.commissioning.acceptance import linearity as test

    how = test.Staircase(hold, cycles, noll_of(modes))
    of = _measured(test.KIND, Where(logs, run, config, plot), lambda live, must: test.play(live, how, must))
    _say(test.judge(of.every, of.required), test.draw, plot, as_json)


@acceptance_app.command("capture-range")
def capture_range(
    logs: LogsIfAny = None,
    modes: Modes = None,
    config: Required = None,
    run: AnyRun = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Measure from how large a wavefront the loop closes.

    Example: lowfc acceptance capture-range --modes 2-6
    """
    from lowfc.programs.commissioning.acceptance import capture as test

    wanted = noll_of(modes)
    of = _measured(test.KIND, Where(logs, run, config, plot), lambda live, must: test.play(live, wanted, must))
    _say(test.judge(of.every, of.required), test.draw, plot, as_json)


@acceptance_app.command("noise-floor")
def noise_floor(
    logs: LogsIfAny = None,
    duration: Annotated[float, typer.Option(min=0.01, max=1e5, help="Seconds open, and seconds closed.")] = 10.0,
    config: Required = None,
    run: AnyRun = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Measure the white noise of each mode, and compare it with that of photons and read-out.

    Example: lowfc acceptance noise-floor --duration 10
    """
    from lowfc.programs.commissioning.acceptance import noise as test

    of = _measured(test.KIND, Where(logs, run, config, plot), lambda live, must: test.play(live, duration))
    _say(test.judge(of.every, of.required, of.configuration, of.calibration), test.draw, plot, as_json)


class Where(NamedTuple):
    """The log, or the run, that is measured; the configuration with the requirements; what is drawn into."""

    logs: list[Path] | None
    run: str | None
    config: Path | None
    plot: Path | None


class Measured(NamedTuple):
    """What was played, what is required of it, and of which instrument."""

    every: "list[Played]"
    required: "Acceptance"
    configuration: "Configuration"
    calibration: "Calibration"


def _measured(kind: "Kind", where: Where, play: "Callable[[Live, Acceptance], list[Played]]") -> Measured:
    """What was played: in a log, or now."""
    from rich.console import Console
    from rich.progress import TimeRemainingColumn

    from lowfc.adapters.files.drawing import figure_class
    from lowfc.adapters.files.whole_file import require_folder
    from lowfc.adapters.logs.history import read_history
    from lowfc.adapters.logs.parts import WholeLog, the_one
    from lowfc.adapters.process.progress import counting_bar
    from lowfc.client import Client
    from lowfc.programs.commissioning.acceptance.live import Live
    from lowfc.programs.commissioning.acceptance.played import logged
    from lowfc.programs.logs.guard import refuse_log

    logs, run, config, plot = where
    required = configuration(config).acceptance if config is not None else None
    require_folder(plot)
    if plot is not None:
        figure_class()  # says before the measurement that it could not be drawn
    if logs:
        if run is not None:
            raise ConfigurationError("a log, or a running loop (--run): choose one")
        log = WholeLog(the_one(logs), skip_damaged=True)
        if plot is not None:
            refuse_log(plot, log.path)
        history = read_history(log)
        for remark in history.remarks:
            sys.stderr.write(f"warning: {remark}\n")
        every = logged(history, kind)
        known, calibration = history.configuration, history.calibration
        if known is None or calibration is None:
            raise DataFileError(f"{log.path}: has no configuration, which says what is required")
        return Measured(every, required or known.acceptance, known, calibration)
    with Client(run) as client, counting_bar(Console(stderr=True), TimeRemainingColumn()) as count:
        live = Live(client, partial(count, kind))
        required = required or live.configuration.acceptance
        with client.reserved("lowfc acceptance"), live.kept():
            return Measured(play(live, required), required, live.configuration, live.calibration)


def _say(
    result: "AcceptanceResult", draw: Callable[[dict[str, Any], Any], None], plot: Path | None, as_json: bool
) -> None:
    """Draw the result, print it, and end with the verdict."""
    from lowfc.adapters.files.drawing import figure_class, png
    from lowfc.adapters.files.whole_file import write_whole

    if plot is not None:
        figure = figure_class()(figsize=(10, 5), layout="constrained")
        draw(result.figures(), figure)
        figure.suptitle(result.verdict)
        write_whole(plot, png(figure))
    put(result, as_json=as_json)
    if not result.passed:
        raise typer.Exit(1)
