"""`lowfc acceptance`: command-line arguments; each test is in a separate module."""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.process.terminal import AnyRun, Json, LogsIfAny, configuration, new_app, options_set
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.programs.cli.modes import Modes, noll_of
from lowfc.programs.cli.result import print_result

if TYPE_CHECKING:
    from lowfc.programs.commissioning.acceptance.live import Live
    from lowfc.programs.commissioning.acceptance.probe import ProbeResponse

acceptance_app = new_app(
    "Test a loop against its requirements, live or from its log.\n\n"
    "Exit status 0 only if the test passed.\n\nExample: lowfc acceptance rejection"
)

Plot = Annotated[Path | None, typer.Option(help="Plot the result to this file (PNG).", show_default=False)]
Required = Annotated[
    Path | None,
    typer.Option("--config", help="Configuration with the requirements; default: the loop's own.", show_default=False),
]


@acceptance_app.command()
def rejection(
    context: typer.Context,
    logs: LogsIfAny = None,
    duration: Annotated[float, typer.Option(min=0.1, max=1e5, help="Seconds of the multisine.")] = 60.0,
    rms_nm: Annotated[float, typer.Option(min=1e-3, max=1e3, help="Rms of the multisine in each mode, nm.")] = 5.0,
    lines: Annotated[int, typer.Option(min=1, max=1000, help="Number of multisine frequencies in each mode.")] = 12,
    modes: Modes = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the multisine's phases.")] = 1,
    config: Required = None,
    run: AnyRun = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Measure rejection and noise transfer with a multisine, and compare them with theory.

    Example: lowfc acceptance rejection --duration 60 --plot rejection.png
    """
    from lowfc.programs.commissioning.acceptance import rejection as test

    play = partial(test.play, duration_s=duration, rms_nm=rms_nm, lines_per_mode=lines, modes=noll_of(modes), seed=seed)
    _carry_out(context, test, logs, run, config, plot, as_json, play)


@acceptance_app.command()
def linearity(
    context: typer.Context,
    logs: LogsIfAny = None,
    hold: Annotated[int, typer.Option(min=2, max=1000, help="Frames at each level.")] = 10,
    cycles: Annotated[int, typer.Option(min=2, max=1000, help="Push-pull cycles of each amplitude.")] = 20,
    modes: Modes = None,
    config: Required = None,
    run: AnyRun = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Measure gain and cross-talk of each mode against its amplitude, with the loop open.

    Example: lowfc acceptance linearity --modes 2,3
    """
    from lowfc.programs.commissioning.acceptance import linearity as test

    play = partial(test.play, hold_frames=hold, cycles=cycles, modes=noll_of(modes))
    _carry_out(context, test, logs, run, config, plot, as_json, play)


@acceptance_app.command("capture-range")
def capture_range(
    context: typer.Context,
    logs: LogsIfAny = None,
    modes: Modes = None,
    config: Required = None,
    run: AnyRun = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Measure the largest static wavefront error from which the loop converges.

    Example: lowfc acceptance capture-range --modes 2-6
    """
    from lowfc.programs.commissioning.acceptance import capture as test

    _carry_out(context, test, logs, run, config, plot, as_json, partial(test.play, modes=noll_of(modes)))


@acceptance_app.command("noise-floor")
def noise_floor(
    context: typer.Context,
    logs: LogsIfAny = None,
    duration: Annotated[float, typer.Option(min=0.01, max=1e5, help="Seconds of each of the two recordings.")] = 10.0,
    config: Required = None,
    run: AnyRun = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """Record the open and the closed loop, and compare the white noise of each mode with photon and read noise.

    Example: lowfc acceptance noise-floor --duration 10
    """
    from lowfc.programs.commissioning.acceptance import noise as test

    _carry_out(context, test, logs, run, config, plot, as_json, partial(test.play, duration_s=duration))


def _carry_out(
    context: typer.Context,
    test: Any,
    logs: list[Path] | None,
    run: str | None,
    config: Path | None,
    plot: Path | None,
    as_json: bool,
    play: "Callable[[Live], list[ProbeResponse]]",
) -> None:
    """Evaluate a test from a log or run it now; plot and print the result, and exit with the verdict."""
    from rich.console import Console
    from rich.progress import TimeRemainingColumn

    from lowfc.adapters.files.drawing import figure_class, png
    from lowfc.adapters.files.whole_file import require_folder, write_whole
    from lowfc.adapters.logs.history import read_history
    from lowfc.adapters.logs.parts import WholeLog, named_log
    from lowfc.adapters.process.progress import counting_bar
    from lowfc.client import Client
    from lowfc.programs.commissioning.acceptance.live import Live
    from lowfc.programs.commissioning.acceptance.probe import logged_responses

    if logs:
        for option in options_set(context):
            if option not in ("logs", "--config", "--plot", "--json"):
                raise ConfigurationError(f"{option} has no effect on the evaluation of a log: omit it")
    requirements = {} if config is None else {"acceptance": configuration(config).acceptance}
    require_folder(plot)
    # if matplotlib is missing, the error comes before the test, not after it
    figure = None if plot is None else figure_class()(figsize=(10, 5), layout="constrained")
    if logs:
        log = WholeLog(named_log(logs))
        history = read_history(log)
        for remark in history.remarks:
            sys.stderr.write(f"warning: {remark}\n")
        responses = logged_responses(history, test.KIND)
        if history.configuration is None:
            raise DataFileError(f"{log.path}: has no configuration, so camera and requirements are unknown")
        config_in_use = history.configuration.model_copy(update=requirements)
    else:
        with Client(run) as client, counting_bar(Console(stderr=True), TimeRemainingColumn()) as count:
            live = Live(client, partial(count, test.KIND), partial(print, file=sys.stderr))
            config_in_use = live.configuration = live.configuration.model_copy(update=requirements)
            with client.reserved("lowfc acceptance"), live.restored():
                responses = play(live)
    result = test.judge(responses, config_in_use)
    if plot is not None and figure is not None:
        test.draw(result.json_object(), figure)
        figure.suptitle(result.verdict)
        write_whole(plot, png(figure))
    print_result(result, as_json=as_json)
    if not result.passed:
        raise typer.Exit(1)
