"""The command `lowfc publish`: republish a recorded run on the bus."""

from typing import Annotated

import typer

from lowfc.adapters.process.terminal import DEFAULT_RUN, INTERRUPTED, Json, Logs, RunId
from lowfc.programs.cli.output import print_result


def publish(
    logs: Logs,
    run: RunId = DEFAULT_RUN,
    speed: Annotated[float, typer.Option(help="Speed relative to the recorded run.")] = 1.0,
    topics: Annotated[
        list[str] | None, typer.Option(help="Publish only this key or pattern; repeat for several.")
    ] = None,
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Publish commands, too: a live mirror will follow them.")
    ] = False,
    wait_for: Annotated[
        list[str] | None, typer.Option(help="Wait for this role before starting; repeat for several.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Republish recorded messages on the bus, for a viewer or a controller under test.

    Example: lowfc publish last --speed 2
    """
    from lowfc.adapters.logs.parts import named_files
    from lowfc.programs.logs.publish.player import publish as play
    from lowfc.programs.logs.publish.player import render

    results = play(
        named_files(logs), run, speed=speed, topics=topics or (), allow_commands=allow_commands, wait_for=wait_for or ()
    )
    print_result(results, render(results), as_json=as_json)
    if results["interrupted"]:
        raise typer.Exit(INTERRUPTED)
