"""The command `lowfc doctor`: is this host fit for a real-time loop?"""

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.terminal import ConfigFile, configuration
from lowfc.control.wording import counted

if TYPE_CHECKING:
    from rich.console import Console

    from lowfc.adapters.host import Host
    from lowfc.contract.configuration import Configuration
    from lowfc.programs.doctor.facts import Facts, Finding

TRIAL_S = 1.0
"""How long wake-ups are measured in each scheduling class."""

_WIDTH = 120  # where there is no terminal
_STYLES = {"ok": "green", "warning": "bold yellow", "note": "cyan"}


def doctor(
    config: ConfigFile = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit status 1 where there is a warning.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Say whether this host is fit for a real-time loop, what to do where it is not, and what it costs otherwise.

    Nothing is changed and nothing needs root: what the loop asks of the host is tried in a process of its own.

    Example: lowfc doctor --config lowfc.toml --strict
    """
    from rich.console import Console

    from lowfc.adapters.host import Host

    settings = configuration(config)
    sys.stderr.write(
        f"sleeping 1000 times a second for {TRIAL_S:g} s in each scheduling class, to see how late this host wakes\n"
    )
    facts = gather(Host(), settings, TRIAL_S)
    found = examine(facts)
    if as_json:
        sys.stdout.write(json.dumps(figures(facts, found)) + "\n")
    else:
        report(found, Console(width=None if sys.stdout.isatty() else _WIDTH, highlight=False))
    if strict and any(finding.status == "warning" for finding in found.values()):
        raise typer.Exit(1)


def gather(host: "Host", config: "Configuration", seconds: float) -> "Facts":
    """Try what the loop asks for and measure wake-ups for so long in each class; note who else is busy meanwhile."""
    from lowfc.adapters.trial import Trial, try_out
    from lowfc.programs.doctor.facts import Facts, named_cpus

    before, begun_s = host.used_s(), time.monotonic()
    trial: Trial | OSError
    try:
        trial = try_out(config.realtime, named_cpus(config), seconds)
    except OSError as fault:
        trial = fault
    elapsed_s = time.monotonic() - begun_s
    shares = [
        (f"{name} ({one[0]})", (used_s - before.get(one, ("", 0.0))[1]) / elapsed_s)
        for one, (name, used_s) in host.used_s().items()
        if one[0] != os.getpid()
    ]
    return Facts(host, config, trial, tuple(sorted(shares, key=lambda one: -one[1])))


def checks() -> "dict[str, Callable[[Facts], Finding]]":
    """All checks by name, in the order of the report."""
    from lowfc.programs.doctor import room as doctor_room
    from lowfc.programs.doctor import timing as doctor_timing

    return {**doctor_timing.CHECKS, **doctor_room.CHECKS}


def examine(facts: "Facts") -> "dict[str, Finding]":
    """What every check found; one that cannot read what it needs finds just that."""
    from lowfc.contract.errors import LowfcError
    from lowfc.programs.doctor.facts import note

    found = {}
    for name, check in checks().items():
        try:
            found[name] = check(facts)
        except (OSError, ValueError, LookupError, LowfcError) as fault:
            found[name] = note(f"not known: {fault}")
    return found


def figures(facts: "Facts", found: "Mapping[str, Finding]") -> dict[str, Any]:
    """What `--json` prints: checks, counts by status, percentiles of the wake-up by scheduling class, and the host."""
    from lowfc.adapters.provenance import provenance
    from lowfc.programs.doctor.timing import wake_up_us

    return {
        "checks": [{"name": name, **finding._asdict()} for name, finding in found.items()],
        "counts": counts(found),
        "wake_up_us": wake_up_us(facts) if not isinstance(facts.trial, OSError) else {},
        "host": provenance(),
    }


def counts(found: "Mapping[str, Finding]") -> dict[str, int]:
    """How many checks ended in which way."""
    ended = [str(finding.status) for finding in found.values()]
    return {status: ended.count(status) for status in _STYLES}


def report(found: "Mapping[str, Finding]", console: "Console") -> None:
    """Print what was found for a person."""
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for name, finding in found.items():
        table.add_row(Text(finding.status, style=_STYLES[finding.status]), Text(name), Text(finding.detail))
        for label, text in (("to do", finding.advice), ("otherwise", finding.cost)):
            if text:
                table.add_row("", Text(label, style="dim", justify="right"), Text(text, style="dim"))
    console.print(table)
    ended = counts(found)
    console.print(f"\n{counted(ended['warning'], 'warning')}, {counted(ended['note'], 'note')}, {ended['ok']} ok")
