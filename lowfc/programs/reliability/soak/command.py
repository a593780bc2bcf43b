"""The command `lowfc soak`: check for growth of resources and for lost messages over hours."""

from typing import Annotated

import typer

from lowfc.adapters.process.terminal import INTERRUPTED, ConfigFile, Json, configuration
from lowfc.programs.cli.output import print_result


def soak(
    hours: Annotated[float, typer.Option(min=0.001, max=1000, help="Duration, hours.")],
    config: ConfigFile = None,
    as_json: Json = False,
) -> None:
    """Run the simulated loop for hours and check memory, handles, threads and losses; exit status 1 on growth or loss.

    Finished logs are checked for gaps and removed. Slopes are fitted to the last three quarters of the time. Memory
    grows if its slope exceeds three standard errors and it gains more than 1 MB in that time; handles (open files and
    sockets) and threads grow if their median rises from the second to the last quarter. The latency's slope is
    reported, not judged. The loop must be closed at the end. If the time is too short for a slope, the soak does not
    pass. Ctrl-C ends it early: the results so far are printed, with exit status 130.

    Example: lowfc soak --hours 0.5
    """
    import os

    from rich.console import Console

    from lowfc.adapters.process.progress import passing_bar
    from lowfc.adapters.process.realtime import spread
    from lowfc.programs.reliability.soak.evaluation import render
    from lowfc.programs.reliability.soak.run import soak_loop

    overrides = {"recorder.largest_mb": 200.0, "control.start_mode": "closed"}
    settings = configuration(config, overrides, spread(os.sched_getaffinity(0)))
    with passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task("soaking", total=hours * 3600)
        results = soak_loop(settings, hours * 3600, lambda elapsed_s: bar.update(task, completed=elapsed_s))
    print_result(results, render(results), as_json=as_json)
    if results["interrupted"]:
        raise typer.Exit(INTERRUPTED)
    if not results["passed"]:
        raise typer.Exit(1)
