"""The command `lowfc recover`: what is whole of a truncated or damaged log, as a log."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.terminal import Json, Logs
from lowfc.programs.output import put

if TYPE_CHECKING:
    from lowfc.adapters.log_recovery import Recovery


def recover(
    logs: Logs,
    out: Annotated[
        Path | None, typer.Option(help="The new log; default: NAME-recovered.mcap beside it.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a complete, indexed log of what is whole in a truncated or damaged one, which is not changed.

    Each file of a recording is recovered by itself; of a whole one nothing is made.

    Example: lowfc recover logs/20270101T220000Z.mcap.part
    """
    from rich.console import Console

    from lowfc.adapters.log_parts import in_order
    from lowfc.adapters.log_recovery import recover as run
    from lowfc.adapters.log_recovery import recovered_path
    from lowfc.adapters.progress import reading_bar

    for log in in_order(logs, out, as_json=as_json):
        with reading_bar(Console(stderr=True)) as bar:
            task = bar.add_task(f"recovering {log.name}", total=None)
            done = run(
                log,
                recovered_path(log) if out is None else out,
                lambda position, size: bar.update(task, completed=position, total=size),  # noqa: B023  # not kept
            )
        put(figures(done), report(done), as_json=as_json)


def figures(done: "Recovery") -> dict[str, Any]:
    """A recovery for a program."""
    return {
        "log": str(done.source),
        "bytes": done.size,
        "finished": done.finished,
        "recovered": None if done.recovered is None else str(done.recovered),
        "messages": done.messages,
        "unreadable": done.unreadable,
        "damage": [dataclasses.asdict(damage) for damage in done.damage],
    }


def report(done: "Recovery") -> str:
    """A recovery for a person."""
    from lowfc.adapters.log_recovery import in_words
    from lowfc.adapters.log_writer import UNFINISHED

    if done.recovered is None:
        name = done.source.name.removesuffix(UNFINISHED)
        advice = "there is nothing to recover" if name == done.source.name else f"only rename it to {name}"
        return f"{done.source} is whole; {advice}"
    lines = [f"left out {in_words(damage)}" for damage in done.damage]
    if done.unreadable:
        lines.append(f"left out {done.unreadable} messages: what declares them was in a damaged chunk")
    if not done.finished:
        lines.append(f"{done.source} had not been finished")
    return "\n".join([*lines, f"{done.recovered}: {done.messages} messages"])
