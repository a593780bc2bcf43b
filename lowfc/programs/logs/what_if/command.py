"""The command `lowfc what-if`: the residual of a log with another controller."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.process.terminal import Json, Logs
from lowfc.programs.cli.output import print_result


def what_if(
    logs: Logs,
    assignments: Annotated[
        str | None,
        typer.Option("--set", metavar="KEY=VALUE,...", help="Other gains: gain, leak, limit_nm, tilt_gain, ..."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Use the [control] section of this file.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="Another calibration (FITS).")] = None,
    controller: Annotated[
        str | None, typer.Option(metavar="FILE.py:NAME", help="Your step(state, error_nm) -> (state, command_nm).")
    ] = None,
    as_json: Json = False,
) -> None:
    """Compute the residual of a log with other gains, another reconstructor or your own controller.

    Example: lowfc what-if last --set gain=0.3,leak=0.01
    """
    from rich.console import Console

    from lowfc.adapters.logs.history import read_history
    from lowfc.adapters.logs.parts import WholeLog, named_log, titled
    from lowfc.adapters.process.progress import reading_bar
    from lowfc.programs.logs.what_if.compare import render
    from lowfc.programs.logs.what_if.compare import what_if as predict
    from lowfc.programs.logs.what_if.options import requested_changes
    from lowfc.programs.logs.what_if.run import LoggedRun

    changes = requested_changes(assignments, config, calibration, controller)
    log = named_log(logs)
    with reading_bar(Console(stderr=True)) as count:
        history = read_history(WholeLog(log, partial(count, f"reading {titled(log)}")))
        results = predict(LoggedRun(history), changes)
    print_result(results, render(results), as_json=as_json)
