"""The command `lowfc conformance`: what a driver's author still has to put right."""

import json
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.terminal import ConfigFile, configuration, new_app
from lowfc.control.wording import counted

if TYPE_CHECKING:
    from rich.console import Console

    from lowfc.adapters.run import Run
    from lowfc.programs.conformance.checks import Check

CONNECT_S = 3.0
"""How long a device is waited for."""

_WIDTH = 120  # where there is no terminal
_STYLES = {"ok": "green", "warning": "bold yellow", "wrong": "bold red"}

conformance_app = new_app(
    "Hold your own camera or mirror against the message contract.\n\nExample: lowfc conformance camera --run bench"
)

RunName = Annotated[
    str | None, typer.Option("--run", help="Name of the run; default: the only one with such a device.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]


@conformance_app.command()
def camera(
    run: RunName = None,
    config: ConfigFile = None,
    duration: Annotated[float, typer.Option(min=0.2, max=3600, help="Seconds to look at it.")] = 5.0,
    as_json: Json = False,
) -> None:
    """Look at a camera's messages for a while and say what is wrong with them; exit status 1 where something is.

    The loop may be running meanwhile: nothing is published. With --config, the camera's settings are compared with the
    loop's configuration, too.

    Example: lowfc conformance camera --run bench --config bench.toml
    """
    from lowfc.contract.messages import Role
    from lowfc.programs.conformance.agreement import agreement_checks
    from lowfc.programs.conformance.camera import camera_checks, watch
    from lowfc.programs.conformance.line import ZenohLine

    settings = None if config is None else configuration(config)
    found = _run_with(Role.CAMERA, run)
    line = ZenohLine(found.links, Role.OPERATOR)
    try:
        _connect(line.peers)
        with _bar(f"looking at the camera for {duration:g} s", duration) as show:
            watched = watch(line, duration, lambda done_s: show(completed=done_s))
    finally:
        line.close()
    checks = list(camera_checks(watched))
    states = [state for state in watched.states if state is not None]
    if settings is not None and states:
        checks += agreement_checks(settings, states[-1])
    _end("camera", found.run_id, checks, as_json)


@conformance_app.command()
def mirror(
    run: RunName = None,
    config: ConfigFile = None,
    duration: Annotated[float, typer.Option(min=0.05, max=3600, help="Seconds of ordinary commands.")] = 5.0,
    gentle: Annotated[bool, typer.Option("--gentle", help="Do not try its limits.")] = False,
    as_json: Json = False,
) -> None:
    """Command a mirror and say what is wrong with its answers; exit status 1 where something is.

    It takes the controller's place, so none may be running. The commands are a twentieth of what the configuration
    allows in one move; only where all of them were answered rightly, and without --gentle, stroke, slew and neighbour
    limits are exceeded by a little, to see them kept. The mirror ends where it was.

    Example: lowfc conformance mirror --run bench --config lowfc.toml
    """
    from lowfc.adapters.run import mirror_role
    from lowfc.contract.errors import BusError, ConfigurationError
    from lowfc.contract.messages import Role
    from lowfc.programs.conformance.dialogue import Dialogue, expected_of
    from lowfc.programs.conformance.line import ZenohLine
    from lowfc.programs.conformance.mirror import mirror_checks

    settings = configuration(config)
    if settings.lockstep:
        raise ConfigurationError("lockstep = true: time stands still there, and a mirror has no dead-man; leave it out")
    found = _run_with(mirror_role(settings.mirror.name), run)
    if Role.CONTROLLER in found.links.live():
        raise BusError(
            f"run {found.run_id!r} has a controller, which commands the mirror: stop it first, so that this one can"
        )
    line = ZenohLine(found.links, Role.CONTROLLER)
    try:
        _connect(line.peers)
        dialogue = Dialogue(line, expected_of(settings))
        with _bar("the mirror", None) as show:

            def tell(what: str) -> None:
                show(description=f"the mirror: {what}")

            with closing(mirror_checks(dialogue, duration, tell, gentle=gentle)) as checking:
                checks = list(checking)
    finally:
        line.close()
    _end(f"mirror-{settings.mirror.name}", found.run_id, checks, as_json)


def _run_with(role: str, name: str | None) -> "Run":
    """The run of that name, or the only one in which such a role listens.

    Raises:
        BusError: there is no such run, or none or several to choose from.
    """
    from lowfc.adapters.run import open_run, runtime_base
    from lowfc.contract.errors import BusError
    from lowfc.programs.ctl.which_run import the_known_run

    if name is not None:
        named = open_run(the_known_run(name), ())
        if named.links.network.router:
            raise BusError(
                f"run {name!r} goes by a router, whose clock its times are of: try the device on its own host, in a "
                "run of that host alone"
            )
        return named
    runs = sorted(path.parent.name for path in runtime_base().glob("*/links.json"))
    links = [open_run(run, ()).links for run in runs]
    found = [one.run_id for one in links if not one.network.router and role in one.live()]
    if len(found) == 1:
        return open_run(found[0], ())
    if found:
        raise BusError(f"say which run with --run: {role} is in {', '.join(found)}")
    raise BusError(
        f"no {role} listens in any run of this host: start yours with the session file of "
        f"`lowfc config zenoh --role {role} --run NAME --make`, and name the run with --run"
    )


def _connect(peers: Callable[[], int]) -> None:
    """Wait until somebody is there."""
    import time

    deadline_s = time.monotonic() + CONNECT_S
    while not peers() and time.monotonic() < deadline_s:
        time.sleep(0.02)


@contextmanager
def _bar(text: str, total: float | None) -> Iterator[Callable[..., None]]:
    """A progress bar that is gone when it is done; what it yields changes it."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    from lowfc.adapters.progress import passing_bar

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with passing_bar(Console(stderr=True), *columns) as bar:
        task = bar.add_task(text, total=total)
        yield partial(bar.update, task)


def _end(device: str, run_id: str, checks: "Iterable[Check]", as_json: bool) -> None:
    """Print what was found; exit status 1 where something is wrong."""
    from rich.console import Console

    found = list(checks)
    if as_json:
        sys.stdout.write(json.dumps(figures(device, run_id, found)) + "\n")
    else:
        report(found, Console(width=None if sys.stdout.isatty() else _WIDTH, highlight=False))
    if any(check.status == "wrong" for check in found):
        raise typer.Exit(1)


def figures(device: str, run_id: str, checks: "list[Check]") -> dict[str, Any]:
    """What `--json` prints: the checks, and counts by status."""
    return {
        "device": device,
        "run": run_id,
        "checks": [check._asdict() for check in checks],
        "counts": counts(checks),
    }


def counts(checks: "list[Check]") -> dict[str, int]:
    """How many checks ended in which way."""
    ended = [str(check.status) for check in checks]
    return {status: ended.count(status) for status in _STYLES}


def report(checks: "list[Check]", console: "Console") -> None:
    """Print what was found for a person: of what is ok a line, of the rest what was expected and what to do."""
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for check in checks:
        table.add_row(Text(check.status, style=_STYLES[check.status]), Text(check.name), Text(check.got))
        if check.advice:
            table.add_row("", Text("expected", style="dim", justify="right"), Text(check.expected, style="dim"))
            table.add_row("", Text("to do", style="dim", justify="right"), Text(check.advice))
    console.print(table)
    ended = counts(checks)
    console.print(f"\n{ended['wrong']} wrong, {counted(ended['warning'], 'warning')}, {ended['ok']} ok")
