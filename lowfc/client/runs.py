"""Find the runs on this host."""

import contextlib

from lowfc.adapters.bus.other_loops import no_loop_message
from lowfc.adapters.bus.run import Run, open_run, run_path, runtime_base
from lowfc.contract.errors import BusError, DataFileError, nearest
from lowfc.contract.messages import Role

_COMMANDS = {Role.CONTROLLER: "lowfc controller", Role.RECORDER: "lowfc record", Role.CAMERA: "sim-camera"}


def running() -> list[str]:
    """Names of this user's runs on this host whose controller, or router, is listening; a killed run does not count."""
    return [name for name, roles in live_runs().items() if Role.CONTROLLER in roles]


def the_run(name: str | None) -> str:
    """Find a run by its name or a unique prefix, or the only run if `name` is None; the run may have no controller.

    Raises:
        BusError: no live run has that name, its router does not answer, or several names begin with it; or, for None,
            no run or more than one is live.
        DataFileError: the run's directory is damaged.
    """
    runs = live_runs(name)
    if name is None:
        if not runs:
            raise BusError("; ".join(filter(None, (no_loop_message(), _silent_routers(None)))))
        if len(runs) > 1:
            raise BusError(
                f"more than one run is live: {_listed(runs)}; choose one with --run (a unique prefix is enough)"
            )
        return next(iter(runs))
    if name in runs:
        return name
    matching = [] if name in _stored() else [run for run in runs if run.startswith(name)]
    if len(matching) == 1:
        return matching[0]
    if silent := _silent_routers(name):
        raise BusError(f"{silent}: is it running, and can this host reach it?")
    if not runs:
        raise BusError(f"there is no run {name!r}: {no_loop_message()}")
    if matching:
        raise BusError(f"{name!r} is the beginning of several runs' names: {', '.join(matching)}")
    raise BusError(
        f"there is no run {name!r}: there {'is' if len(runs) == 1 else 'are'} {_listed(runs)}{nearest(name, runs)}"
    )


def _silent_routers(name: str | None) -> str:
    """Clause on the routers that do not answer: of all stored runs with a router, or of run `name` alone.

    Call it only for runs that are not live.
    """
    clauses = []
    for run in _stored():
        with contextlib.suppress(BusError, DataFileError, OSError):
            if name in (None, run) and (router := open_run(run, ()).links.network.router):
                clauses.append(f"the router of run {run!r} at {router} does not answer")
    return "; ".join(clauses)


def the_known_run(name: str | None) -> str:
    """Find the run of that name, even if none of its processes is running; otherwise as `the_run`."""
    return name if name is not None and run_path(name).is_dir() else the_run(name)


def waiting_message(name: str) -> str:
    """Message while a process is alone in its run on this host; empty once another process is running."""
    runs = live_runs()
    if name in runs:
        return ""
    others = f"running: {_listed(runs)}{nearest(name, runs)}" if runs else "no other loop of yours is running"
    return f"waiting for run {name!r}, which has no other process on this host yet; {others}"


def absence(name: str, role: Role, joined: Run | None = None) -> str:
    """Message about a process without a link: it is starting, hangs, is suspended or absent, or its run was restarted.

    `joined` is the run as this process joined it; None if it has not.
    """
    if joined is not None and joined.restarted():
        return f"run {name!r} was started again: join it again, with a new Client"
    roles = live_runs().get(name, set())
    if role in roles and not open_run(name, ()).links.network.router:  # across hosts, only the router is seen
        return (
            f"the {role} of run {name!r} does not answer, but its port is in use: it is starting, hangs or is suspended"
        )
    if Role.LAUNCHER in roles and role is Role.RECORDER:
        return f"run {name!r} has no {role}: it is starting, or was started with --no-record"
    if Role.LAUNCHER in roles:
        return f"run {name!r} is starting, and its {role} is not there yet: try again"
    return f"run {name!r} has no {role}: start one, as with `{_COMMANDS[role]}`"


def live_runs(required: str | None = None) -> dict[str, set[str]]:
    """Runs with a listening process, and its roles; if that is a router, all roles, as any may be running.

    A damaged run is omitted unless it is the required one.

    Raises:
        BusError, DataFileError: the required run is damaged.
    """
    live: dict[str, set[str]] = {}
    for name in _stored():
        try:
            roles = open_run(name, ()).links.live()
        except (BusError, DataFileError, OSError):
            if name == required:
                raise
            continue
        if roles:
            live[name] = roles
    return live


def _stored() -> list[str]:
    """Names of all runs with a directory on this host."""
    return sorted(path.parent.name for path in runtime_base().glob("*/links.json"))


def _listed(runs: dict[str, set[str]]) -> str:
    """List names of runs; those without a controller are marked, as they may still be starting."""
    return ", ".join(
        name if Role.CONTROLLER in roles else f"{name} (no controller yet)" for name, roles in runs.items()
    )
