"""The command `lowfc doctor`: check whether this host is fit for a real-time loop."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.process.terminal import ConfigFile, Json, configuration, options_set
from lowfc.contract.errors import ConfigurationError, DataFileError, LowfcError
from lowfc.programs.commissioning.checks import Check, Status, print_report

if TYPE_CHECKING:
    from lowfc.programs.commissioning.doctor.facts import Facts

TRIAL_S = 1.0
"""Duration of the wake-up measurement in each scheduling class."""

STATUSES = (Status.WARNING, Status.NOTE, Status.OK)
FIELDS = {"name": "name", "status": "status", "detail": "got", "advice": "advice", "cost": "cost"}


def doctor(
    context: typer.Context,
    config: ConfigFile = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit status 1 if there is a warning.")] = False,
    device: Annotated[
        str | None,
        typer.Option(help="Check only what the driver of this name requires; exit status 1 if something is missing."),
    ] = None,
    setup: Annotated[
        bool, typer.Option("--setup", help="Show the settings of the host that grant a user real-time rights.")
    ] = False,
    apply: Annotated[bool, typer.Option("--apply", help="As root: apply these settings.")] = False,
    undo: Annotated[bool, typer.Option("--undo", help="As root: remove these settings.")] = False,
    as_json: Json = False,
) -> None:
    """Check this host for real-time operation; for each problem, show the remedy and the consequence.

    Only --apply and --undo change anything or require root. The checks request real-time settings as the loop does, in
    a separate process.

    Example: lowfc doctor --config lowfc.toml --strict
    """
    from lowfc.adapters.process.host import Host
    from lowfc.programs.commissioning.doctor.devices import device_checks
    from lowfc.programs.commissioning.doctor.facts import gather

    if apply and undo:
        raise ConfigurationError("--apply and --undo exclude each other: use one")
    if setup or apply or undo:
        for option in options_set(context):
            if option not in ("--setup", "--apply", "--undo"):
                raise ConfigurationError(
                    f"--setup, --apply and --undo print text and use no other option: leave out {option}"
                )
        from lowfc.programs.commissioning.doctor import permissions

        root = Path("/")
        user = os.environ.get("SUDO_USER", "")
        try:
            if undo:
                done = permissions.undo(root)
            else:
                done = permissions.apply(root, user) if apply else [permissions.settings_text(root)]
        except (OSError, LookupError) as fault:  # such as a read-only folder, or a user unknown to usermod
            raise DataFileError(f"the settings cannot be changed completely: {fault}") from fault
        sys.stdout.write("\n".join(done) + "\n")
        return
    settings = configuration(config)
    if device is not None:
        checks = list(device_checks(device, settings))
        print_report(checks, (Status.WRONG, Status.OK), FIELDS, {"device": device} if as_json else None)
        if any(check.status is Status.WRONG for check in checks):
            raise typer.Exit(1)
        return
    sys.stderr.write(f"measuring wake-up latency: 1000 sleeps per second for {TRIAL_S:g} s in each scheduling class\n")
    facts = gather(Host(), settings, TRIAL_S)
    checks = examine(facts)
    print_report(checks, STATUSES, FIELDS, measured(facts) if as_json else None)
    if strict and any(check.status is Status.WARNING for check in checks):
        raise typer.Exit(1)


def examine(facts: "Facts") -> list[Check]:
    """The result of every check; a note if a check cannot read its data."""
    from lowfc.programs.commissioning.doctor import resources, timing

    read_errors = (OSError, ValueError, LookupError, LowfcError)
    return [*timing.CHECKS.run(facts, read_errors), *resources.CHECKS.run(facts, read_errors)]


def measured(facts: "Facts") -> dict[str, Any]:
    """Values that `--json` prints besides the checks: wake-up percentiles by scheduling class, and the host's data."""
    from lowfc.adapters.process.provenance import provenance
    from lowfc.programs.commissioning.doctor.timing import wake_up_us

    return {"wake_up_us": {} if isinstance(facts.trial, OSError) else wake_up_us(facts.trial), "host": provenance()}
