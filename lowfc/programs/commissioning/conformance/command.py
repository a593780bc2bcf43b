"""The command `lowfc conformance`: command-line arguments."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from lowfc.adapters.process.terminal import ConfigFile, Json, configuration, new_app
from lowfc.contract.errors import BusError, ConfigurationError
from lowfc.programs.commissioning.checks import Check, Status, print_report

if TYPE_CHECKING:
    from lowfc.adapters.bus.run import Run
    from lowfc.programs.commissioning.conformance.connection import Connection

CONNECT_S = 3.0
"""Longest wait for a device."""

STATUSES = (Status.WRONG, Status.WARNING, Status.OK)
FIELDS = {name: name for name in ("name", "status", "expected", "got", "advice")}

conformance_app = new_app(
    "Check a camera or mirror driver against the message contract.\n\nExample: lowfc conformance camera --run bench"
)

RunName = Annotated[
    str | None, typer.Option("--run", help="Name of the run; default: the only run with such a device.")
]


@conformance_app.command()
def camera(
    run: RunName = None,
    config: ConfigFile = None,
    duration: Annotated[float, typer.Option(min=0.2, max=3600, help="Seconds of messages to check.")] = 5.0,
    as_json: Json = False,
) -> None:
    """Check the messages of a camera driver against the contract; exit status 1 if a check fails.

    The check publishes nothing, so the loop may be running. With --config it also compares the camera's settings with
    the loop's configuration.

    Example: lowfc conformance camera --run bench --config bench.toml
    """
    from rich.console import Console

    from lowfc.adapters.process.progress import passing_bar
    from lowfc.contract.messages import Role
    from lowfc.programs.commissioning.conformance.camera import watch
    from lowfc.programs.commissioning.conformance.frames import camera_checks
    from lowfc.programs.commissioning.conformance.settings import agreement_checks

    settings = None if config is None else configuration(config)
    joined = _run_with(Role.CAMERA, run)
    with _connection(joined, Role.OPERATOR) as connection, passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task(f"observing the camera for {duration:g} s", total=duration)
        observed = watch(connection, duration, lambda done_s: bar.update(task, completed=done_s))
    checks = list(camera_checks(observed))
    if settings is not None and observed.settings is not None:
        checks += agreement_checks(settings, observed.settings)
    _report_and_exit("camera", joined.run_id, checks, as_json)


@conformance_app.command()
def mirror(
    run: RunName = None,
    config: ConfigFile = None,
    duration: Annotated[float, typer.Option(min=0.05, max=3600, help="Seconds of ordinary commands.")] = 5.0,
    gentle: Annotated[bool, typer.Option("--gentle", help="Neither raise the mirror nor test its limits.")] = False,
    as_json: Json = False,
) -> None:
    """Send commands to a mirror and check its states against the contract; exit status 1 if a check fails.

    The check takes the place of the controller, which must not be running. Ordinary commands are at most 5 % of the
    smallest limit, with alternating sign. Unless --gentle, the mirror is also raised by up to 10 nm, to see it relax;
    if no check fails, commands then exceed its stroke, slew and neighbour limits. The initial shape is restored.

    Example: lowfc conformance mirror --run bench --config lowfc.toml
    """
    from rich.console import Console

    from lowfc.adapters.bus.run import mirror_role
    from lowfc.adapters.process.progress import passing_bar
    from lowfc.contract.messages import Role
    from lowfc.programs.commissioning.conformance.dialogue import Dialogue, Expected
    from lowfc.programs.commissioning.conformance.mirror import mirror_checks

    settings = configuration(config)
    if settings.lockstep:
        raise ConfigurationError("lockstep = true: in simulated time a mirror has no command timeout; remove the key")
    joined = _run_with(mirror_role(settings.mirror.name), run)
    if Role.CONTROLLER in joined.links.live():
        raise BusError(
            f"run {joined.run_id!r} has a controller, but only one process may command the mirror: stop the controller"
        )
    with _connection(joined, Role.CONTROLLER) as connection, passing_bar(Console(stderr=True)) as bar:
        task, dialogue = bar.add_task("the mirror", total=None), Dialogue(connection, Expected(settings))
        checks = mirror_checks(dialogue, duration, lambda stage: bar.update(task, description=stage), gentle=gentle)
    _report_and_exit(f"mirror-{settings.mirror.name}", joined.run_id, checks, as_json)


def _run_with(role: str, name: str | None) -> "Run":
    """The run called `name`, or if None the only run that has a process with this role."""
    from lowfc.adapters.bus.run import open_run
    from lowfc.client.runs import live_runs, the_known_run

    if name is None:
        found = [run for run, roles in live_runs().items() if role in roles]
        if len(found) > 1:
            raise BusError(f"several runs have a {role} ({', '.join(found)}): choose one with --run")
        if not found:
            raise BusError(
                f"no run on this host has a {role}: start the device with the session file of "
                f"`lowfc config zenoh --role {role} --run NAME --make`, and name the run with --run"
            )
        name = found[0]
    run = open_run(the_known_run(name), ())
    if run.links.network.router:
        raise BusError(
            f"run {name!r} uses a router, and its times are on the router's clock: check the device on its own host, "
            "in a local run"
        )
    return run


@contextmanager
def _connection(run: "Run", role: str) -> "Iterator[Connection]":
    from lowfc.programs.commissioning.conformance.connection import Connection

    connection = Connection(run.links, role)
    try:
        deadline_s = time.monotonic() + CONNECT_S
        while not connection.peers() and time.monotonic() < deadline_s:
            time.sleep(0.02)
        yield connection
    finally:
        connection.close()


def _report_and_exit(device: str, run_id: str, checks: list[Check], as_json: bool) -> None:
    print_report(checks, STATUSES, FIELDS, {"device": device, "run": run_id} if as_json else None)
    if any(check.status is Status.WRONG for check in checks):
        raise typer.Exit(1)
