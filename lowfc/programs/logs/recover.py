"""The command `lowfc recover`: write the intact parts of a truncated or damaged log to a new, complete log."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from lowfc.adapters.process.terminal import Json, Logs
from lowfc.programs.cli.output import print_result


def recover(
    logs: Logs,
    out: Annotated[
        Path | None, typer.Option(help="The new log; default: NAME-recovered.mcap next to NAME.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Write the intact parts of a truncated or damaged log to a new, complete, indexed log; the original is unchanged.

    Each file of a recording is recovered separately; intact files are skipped.

    Example: lowfc recover logs/20270101T220000Z.mcap.part
    """
    from rich.console import Console

    from lowfc.adapters.logs.parts import named_files
    from lowfc.adapters.logs.recovery import recover as recover_log
    from lowfc.adapters.logs.recovery import recovered_path
    from lowfc.adapters.process.progress import reading_bar

    for log in named_files(logs, out, as_json=as_json):
        with reading_bar(Console(stderr=True)) as count:
            done = recover_log(log, out or recovered_path(log), partial(count, f"recovering {log.name}"))
        print_result(done.json_object, str(done), as_json=as_json)
