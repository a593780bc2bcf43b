"""The command `lowfc replay`."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from lowfc.adapters.log_parts import WholeLog, in_order, the_one
from lowfc.adapters.progress import passing_bar
from lowfc.adapters.provenance import provenance
from lowfc.adapters.terminal import DEFAULT_RUN, INTERRUPTED, Logs
from lowfc.contract.envelope import count_of
from lowfc.contract.errors import ConfigurationError
from lowfc.programs.output import put
from lowfc.programs.replay.account import Account

_HOST = ("lowfc", "git", "python", "numpy", "scipy", "blas", "processor", "cpu_features")
"""What the same bytes may depend on; of the processor's features, those that only one of the two has."""


def verify(logs: list[Path], tolerance_nm: float, jobs: int, console: Console) -> dict[str, Any]:
    """Replay logs that follow each other; return the figures that `--json` prints.

    Raises:
        DataFileError: a log cannot be read, or cannot be replayed.
    """
    from lowfc.programs.replay.workers import replay_files

    total = sum(path.stat().st_size for path in logs if path.exists())
    begun_s = time.monotonic()
    with passing_bar(console) as bar:
        task = bar.add_task("replaying", total=total)
        outcome = replay_files(logs, tolerance_nm, jobs, lambda done: bar.update(task, completed=done))
    elapsed_s = time.monotonic() - begun_s
    return {
        **_figures(outcome.account),
        "version": outcome.recorded_on.get("lowfc", ""),
        "tolerance_nm": tolerance_nm,
        "log_s": round(outcome.log_s, 3),
        "speed": round(outcome.log_s / elapsed_s, 2),
        "complete": outcome.complete,
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
    elif figures["identical"] and figures["tolerance_nm"]:
        verdict = f"{frames} frames, commands identical within {figures['tolerance_nm']:g} nm"
    elif figures["identical"]:
        verdict = f"{frames} frames, commands identical"
    elif not figures["different"]:
        verdict = f"{frames} frames, steps identical, but no command is in the log"
    else:
        verdict = f"{frames} frames, {figures['different']} messages differ"
    lines = [
        f"{verdict}, largest difference {largest_nm:.3g} nm",
        f"with them          {figures['commands']} commands, {figures['states']} states, {figures['requests']} answers",
    ]
    for rule, count in figures["rules_changed"].items():
        lines.append(f"answered otherwise {count} since {figures['version']}: {rule}")
    for why, count in figures["unchecked_because"].items():
        lines.append(f"not checked        {count} steps {why}")
    for name, what in (("inputs_missing", "inputs of the controller"), ("commands_missing", "commands that it sent")):
        if figures[name]:
            lines.append(f"not in the log     {figures[name]} {what}")
    lines += [f"damaged            {damage}" for damage in figures["damaged"]]
    if not figures["complete"]:
        lines.append("truncated          the log has no end: its recorder was killed, or is still writing")
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
        "rules_changed": account.changed,
        "inputs_missing": account.missing,
        "commands_missing": account.commands_missing,
    }


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
        float | None, typer.Option(min=0, help="Largest difference that is none, nm: for a log of another processor.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes, at most; default: one on every processor.")
    ] = None,
    what_if: Annotated[
        str | None,
        typer.Option("--what-if", metavar="KEY=VALUE,...", help="Other gains: gain, leak, limit_nm, tilt_gain, ..."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="What if: the [control] section of this file.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="What if: another calibration (FITS).")] = None,
    controller: Annotated[
        str | None,
        typer.Option(metavar="FILE.py:NAME", help="What if: your step(state, error_nm) -> (state, command_nm)."),
    ] = None,
    publish: Annotated[bool, typer.Option("--publish", help="Put the recorded traffic on the bus again.")] = False,
    run: Annotated[str | None, typer.Option("--run", help="Publish: name of the run.")] = None,
    speed: Annotated[float | None, typer.Option(help="Publish: times as fast as it was.")] = None,
    topics: Annotated[list[str] | None, typer.Option(help="Publish: only these keys or patterns; repeat.")] = None,
    allow_commands: Annotated[
        bool, typer.Option("--allow-commands", help="Publish: commands too, which a live mirror obeys.")
    ] = False,
    wait_for: Annotated[list[str] | None, typer.Option(help="Publish: begin when this role is there; repeat.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Run the loop again on what it took in, and compare every step and command with the log, to the bit.

    Exit status 0 only if they are identical. Logs may be complete, rotated, truncated or damaged. With --what-if (or
    --config, --calibration, --controller): what another controller would have made of the same night. With --publish:
    the night on the bus again, for a viewer or a controller under test.

    Example: lowfc replay last
    """
    console = Console(stderr=True)
    another = any(option is not None for option in (what_if, config, calibration, controller))
    _only_with("--publish", publish, run, speed, topics, allow_commands, wait_for)
    if (publish or another) and (tolerance is not None or jobs is not None or publish is another):
        raise ConfigurationError(
            "--publish, --what-if and the comparison (--tolerance, --jobs) are three different things"
        )
    if publish:
        from lowfc.programs.replay import publish as publishing

        figures = publishing.publish(
            in_order(logs),
            run or DEFAULT_RUN,
            speed=1.0 if speed is None else speed,
            topics=topics or (),
            allow_commands=allow_commands,
            wait_for=wait_for or (),
            console=console,
        )
        _show(figures, publishing.render, as_json)
        if figures["interrupted"]:
            raise typer.Exit(INTERRUPTED)
    elif another:
        from lowfc.programs.what_if import compare as counterfactual

        wanted = counterfactual.wanted(what_if, config, calibration, controller)
        reader = WholeLog(the_one(logs), skip_damaged=True)
        _show(counterfactual.what_if(reader, wanted), counterfactual.render, as_json)
    else:
        figures = verify(in_order(logs), tolerance or 0.0, jobs or 0, console)
        _show(figures, render, as_json)
        if not figures["identical"]:
            raise typer.Exit(1)


def _only_with(name: str, given: bool, *options: object) -> None:
    if not given and any(options):
        raise ConfigurationError(f"--run, --speed, --topics, --allow-commands and --wait-for belong to {name}")


def _show(figures: dict[str, Any], text: Callable[[dict[str, Any]], str], as_json: bool) -> None:
    put(figures, text(figures), as_json=as_json)
