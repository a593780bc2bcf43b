"""The command `lowfc info`: contents of a log, and what is missing or damaged."""

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

import typer

from lowfc.adapters.process.terminal import Json, Logs
from lowfc.programs.cli.output import print_result
from lowfc.programs.cli.result import table

_STATES = {
    "complete": "complete",
    "recording": "being recorded; `lowfc ctl record stop` finishes it",
    "truncated": "truncated, for example because its recorder was killed; `lowfc recover` completes it",
    "damaged": "damaged; `lowfc recover` saves the intact messages",
}


def info(
    logs: Logs,
    digest: Annotated[
        bool,
        typer.Option("--digest", help="SHA-256 of the deterministic topics: equal for lockstep runs of the same seed."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Summarise a log: times, loop modes, events, messages of each topic, and what is missing or damaged.

    Example: lowfc info last --digest
    """
    from rich.console import Console

    from lowfc.adapters.logs.parts import named_logs, titled
    from lowfc.adapters.process.progress import reading_bar
    from lowfc.programs.logs.survey import survey

    for number, log in enumerate(named_logs(logs, as_json=as_json)):
        with reading_bar(Console(stderr=True)) as count:
            contents = survey(log, partial(count, f"reading {titled(log)}"), digest=digest)
        print_result(contents, ("\n" if number else "") + render(contents), as_json=as_json)


def render(contents: Mapping[str, Any]) -> str:
    """The summary of a log as text."""
    lines = [f"{name:14}" + value.replace("\n", "\n" + " " * 14) for name, value in _summary(contents).items()]
    rows = [
        [
            key,
            str(line["messages"]),
            "" if line["rate_hz"] is None else f"{line['rate_hz']:.1f}",
            f"{line['bytes'] / 1e6:.2f}",
            str(line["restarts"]),
            "?" if line["missing"] is None else str(line["missing"]),
            line["schema"],
        ]
        for key, line in contents["topics"].items()
    ]
    if rows:
        lines += ["", *table(["topic", "messages", "Hz", "MB", "restarts", "missing", "schema"], rows)]
    return "\n".join(lines)


def _summary(contents: Mapping[str, Any]) -> dict[str, str]:
    from lowfc.adapters.logs.selection import SELECTION
    from lowfc.adapters.logs.writer import PART
    from lowfc.programs.logs.survey import recovery_in_words

    metadata, recording = contents["metadata"], contents["metadata"].get("recording", {})
    digest = contents.get("digest", "")
    if digest and contents["lockstep"] is False:  # None if unknown
        digest += " (not a lockstep run: cannot be reproduced)"
    damage = [f"byte {one['position']}, {one['length']} bytes: {one['why']}" for one in contents["damage"]]
    lost = [f"{contents['messages_missing']} missing by their sequence numbers"]
    if "messages_lost" in recording:
        lost.append(f"{recording['messages_lost']} counted as lost by the recorder")
    lost += [f"all {count} of {key}" for key, count in contents["missing_topics"].items()]
    if contents["unreadable"]:
        lost.append(f"{contents['unreadable']} unreadable, because their channel record was damaged")
    lines = {
        "log": f"{', '.join(contents['files'])}, {contents['bytes'] / 1e6:.1f} MB",
        "digest": digest,
        "selection": contents["selection"],
        "state": _STATES[contents["state"]],
        "stopped": f"recording stopped: {recording['stopped']}" if recording.get("stopped") else "",
        "recovery": recovery_in_words(metadata),
        "damage": "\n".join(damage),
        "start": "" if contents["start"] is None else f"{contents['start']}, {contents['duration_s']:.3f} s",
        "lockstep": "messages have simulated time; start, duration and rates are in host time"
        if contents["lockstep"]
        else "",
        "messages": f"{contents['messages']}; {', '.join(lost)}",
        "loop": ", ".join(contents["loop_modes"]),
        "events": ", ".join(f"{name} {count}" for name, count in contents["events"].items()),
        "configuration": "\n".join(contents["remarks"]),
        "attachments": ", ".join(f"{name} ({size} bytes)" for name, size in contents["attachments"].items()),
        **{
            name: ", ".join(f"{key} {value}" for key, value in entries.items())
            for name, entries in metadata.items()
            if name not in ("recording", "recovery", PART, SELECTION)
        },
    }
    return {name: value for name, value in lines.items() if value}
