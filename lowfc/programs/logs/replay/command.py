"""The command `lowfc replay`."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lowfc.adapters.logs.parts import in_order
from lowfc.adapters.logs.recovery import faults, no_end
from lowfc.adapters.process.progress import reading_bar
from lowfc.adapters.process.provenance import provenance
from lowfc.adapters.process.terminal import Json, Logs
from lowfc.contract.envelope import count_of
from lowfc.control.kernel.tables import KernelName
from lowfc.control.loop.wording import counted
from lowfc.programs.cli.output import put

_HOST = ("lowfc", "git", "python", "numpy", "numba", "scipy", "blas", "processor", "cpu_features")
"""What the same bytes may depend on; of the processor's features, those that only one of the two has."""


def verify(logs: list[Path], tolerance_nm: float, jobs: int, console: Console, kernel: str = "") -> dict[str, Any]:
    """Replay logs that follow each other; return the figures that `--json` prints."""
    from lowfc.programs.logs.replay.workers import replay_files

    total = sum(path.stat().st_size for path in logs if path.exists())
    begun_s = time.monotonic()
    with reading_bar(console) as count:
        outcome = replay_files(logs, tolerance_nm, jobs, lambda done: count("replaying", done, total), kernel)
    elapsed_s = time.monotonic() - begun_s
    return {
        **outcome.account.figures(),
        "version": outcome.recorded_on.get("lowfc", ""),
        "tolerance_nm": tolerance_nm,
        "log_s": round(outcome.log_s, 3),
        "speed": round(outcome.log_s / elapsed_s, 2),
        "complete": outcome.complete,
        "no_end": no_end(logs, finished=outcome.complete),
        "damaged": outcome.damage,
        "runs": outcome.runs,
        "stopped": outcome.stopped,
        "host_differs": _host_differs(outcome.recorded_on),
    }


def render(figures: dict[str, Any]) -> str:
    """The figures of a replay for a person."""
    frames, largest_nm = figures["frames"], figures["largest_difference_nm"]
    if not frames:
        verdict = "nothing could be replayed"
    elif figures["other_kernel"]:
        verdict = f"{frames} frames, computed by {figures['other_kernel']}: not the same kernel as the log's"
    elif figures["identical"] and figures["tolerance_nm"]:
        verdict = f"{frames} frames, commands identical within {figures['tolerance_nm']:g} nm"
    elif figures["identical"]:
        verdict = f"{frames} frames, commands identical"
    elif not figures["different"]:
        verdict = f"{frames} frames, steps identical, but no command is in the log"
    else:
        verdict = f"{frames} frames, {counted(figures['different'], 'message differs', 'messages differ')}"
    lines = [
        f"{verdict}, largest difference {largest_nm:.3g} nm",
        f"compared too       {counted(figures['commands'], 'command')}, {counted(figures['states'], 'state')}, "
        f"{counted(figures['requests'], 'answer')}",
    ]
    for rule, count in figures["rules_changed"].items():
        lines.append(f"answered otherwise {count} since {figures['version']}: {rule}")
    for why, count in figures["unchecked_because"].items():
        lines.append(f"unchecked          {counted(count, 'step')} {why}")
    for name, what in (("inputs_missing", "input"), ("commands_missing", "command")):
        if figures[name]:
            lines.append(f"missing            the log lacks {counted(figures[name], what)} of the controller")
    lines += faults(figures["damaged"], figures["no_end"])
    lines += [f"recording stopped  {why}" for why in figures["stopped"]]
    if len(figures["runs"]) > 1:
        lines.append(f"of several runs    {', '.join(figures['runs'])}")
    first = figures["first_difference"]
    if first:
        lines.append(
            f"first difference   {first['message']} of frame {count_of(first['frame_sequence'])} "
            f"(sequence {first['frame_sequence']}), input {first['taken']} of the controller"
        )
        lines += [f"                   {line}" for line in first["fields"]]
    for key, (there, here) in figures["host_differs"].items():
        lines.append(f"{key:18} {there or 'none'} in the log, {here or 'none'} here")
    lines.append(f"speed              {figures['log_s']:.1f} s of log, {figures['speed']:.1f} times as fast as it was")
    return "\n".join(lines)


def _host_differs(there: dict[str, str]) -> dict[str, tuple[str, str]]:
    """What of versions and processor is not as it was when the log was recorded: the log's, and here."""
    here = provenance()
    found = {key: (there[key], here.get(key, "")) for key in _HOST if key in there and there[key] != here.get(key, "")}
    if "cpu_features" in found:
        before, now = (set(features.split()) for features in found["cpu_features"])
        found["cpu_features"] = " ".join(sorted(before - now)), " ".join(sorted(now - before))
    return found


def replay_log(
    logs: Logs,
    tolerance: Annotated[
        float, typer.Option(min=0, help="Largest difference that is none, nm: for a log of another processor.")
    ] = 0.0,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes, at most; default: one on every processor.")
    ] = None,
    kernel: Annotated[
        KernelName | None, typer.Option(help="Arithmetic of the usual frame; default: the log's own.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Run the loop again on what it took in, and compare every step and command with the log, to the bit.

    Exit status 0 only if they are identical; under another kernel they never count as that. Logs may be complete,
    rotated, truncated or damaged.

    Example: lowfc replay last
    """
    figures = verify(in_order(logs), tolerance, jobs or 0, Console(stderr=True), kernel or "")
    put(figures, render(figures), as_json=as_json)
    if not figures["identical"]:
        raise typer.Exit(1)
