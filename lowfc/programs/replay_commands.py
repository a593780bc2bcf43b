"""The command `lowfc replay`."""

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lowfc.adapters.envelope import count_of
from lowfc.adapters.progress import passing_bar
from lowfc.adapters.provenance import provenance
from lowfc.programs.replay_account import Account

_HOST = ("lowfc", "git", "python", "numpy", "scipy", "blas", "processor", "cpu_features")
"""What the same bytes may depend on."""


def verify(logs: list[Path], tolerance_nm: float, jobs: int, console: Console) -> dict[str, Any]:
    """Replay logs that follow each other; return the figures that `--json` prints.

    Raises:
        DataFileError: a log cannot be read, or cannot be replayed.
    """
    from lowfc.programs.replay_workers import replay_files

    total = sum(path.stat().st_size for path in logs if path.exists())
    begun_s = time.monotonic()
    with passing_bar(console) as bar:
        task = bar.add_task("replaying", total=total)
        outcome = replay_files(logs, tolerance_nm, jobs, lambda done: bar.update(task, completed=done))
    elapsed_s = time.monotonic() - begun_s
    return {
        **_figures(outcome.account),
        "tolerance_nm": tolerance_nm,
        "log_s": round(outcome.log_s, 3),
        "speed": round(outcome.log_s / elapsed_s, 2),
        "complete": outcome.complete,
        "damaged": outcome.damage,
        "host_differs": _host_differs(outcome.recorded_on),
    }


def render(figures: dict[str, Any]) -> str:
    """The figures of a replay for a person."""
    frames, largest_nm = figures["frames"], figures["largest_difference_nm"]
    if not frames:
        verdict = "nothing could be replayed"
    elif figures["identical"] and figures["tolerance_nm"]:
        verdict = f"{frames} frames, commands identical within {figures['tolerance_nm']:g} nm"
    elif figures["identical"]:
        verdict = f"{frames} frames, commands identical"
    else:
        verdict = f"{frames} frames, {figures['different']} messages differ"
    lines = [
        f"{verdict}, largest difference {largest_nm:.3g} nm",
        f"with them          {figures['commands']} commands, {figures['states']} states, {figures['requests']} answers",
    ]
    for why, count in figures["unchecked_because"].items():
        lines.append(f"not checked        {count} steps {why}")
    lines += [f"damaged            {damage}" for damage in figures["damaged"]]
    if not figures["complete"]:
        lines.append("truncated          the log has no end: its recorder was killed, or is still writing")
    first = figures["first_difference"]
    if first:
        lines.append(
            f"first difference   {first['message']} of frame {count_of(first['frame_sequence'])} "
            f"(sequence {first['frame_sequence']}), input {first['taken']} of the controller"
        )
        lines += [f"                   {line}" for line in first["fields"]]
    for key, (there, here) in figures["host_differs"].items():
        lines.append(f"{key:18} {there} in the log, {here} here")
    lines.append(f"speed              {figures['log_s']:.1f} s of log, {figures['speed']:.1f} times as fast as it was")
    return "\n".join(lines)


def _figures(account: Account) -> dict[str, Any]:
    first = account.first
    return {
        "frames": account.frames,
        "commands": account.commands,
        "unchecked": sum(account.unchecked.values()),
        "identical": account.identical,
        "largest_difference_nm": account.largest_nm,
        "first_difference": first
        and {
            "message": first.what,
            "frame_sequence": first.frame_sequence,
            "taken": first.taken,
            "fields": first.fields,
        },
        "different": account.different,
        "states": account.states,
        "requests": account.requests,
        "unchecked_because": account.unchecked,
    }


def _host_differs(there: dict[str, str]) -> dict[str, tuple[str, str]]:
    """What of versions and processor is not as it was when the log was recorded: the log's, and here."""
    here = provenance()
    return {key: (there[key], here.get(key, "none")) for key in _HOST if key in there and there[key] != here.get(key)}


def replay_log(
    logs: Annotated[
        list[Path], typer.Argument(help="Log (MCAP); or several that follow each other.", metavar="LOG...")
    ],
    tolerance: Annotated[
        float, typer.Option(min=0, help="Largest difference that is none, nm: for a log of another processor.")
    ] = 0.0,
    jobs: Annotated[int, typer.Option(min=0, help="Processes, at most; 0 for one on every processor.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Run the loop again on what it took in, and compare every step and command with the log, to the bit.

    Exit status 0 only if they are identical. Logs may be complete, rotated, truncated or damaged.

    Example: lowfc replay logs/20261122T020834Z.mcap
    """
    figures = verify(logs, tolerance, jobs, Console(stderr=True))
    sys.stdout.write((json.dumps(figures) if as_json else render(figures)) + "\n")
    if not figures["identical"]:
        raise typer.Exit(1)
