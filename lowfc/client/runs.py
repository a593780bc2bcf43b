"""Which runs there are on this host."""

from pathlib import Path

from lowfc.adapters.run import open_run, runtime_base
from lowfc.contract.errors import BusError
from lowfc.contract.messages import Role


def running(base: Path | None = None) -> list[str]:
    """Names of the runs on this host whose controller listens; a run that was killed leaves its directory behind."""
    folder = runtime_base() if base is None else base
    found = (path.parent.name for path in folder.glob("*/links.json"))
    return sorted(name for name in found if Role.CONTROLLER in open_run(name, ()).links.live())


def the_run(name: str | None) -> str:
    """The run of that name, or the only one there is.

    Raises:
        BusError: there is no such run, none at all, or more than one to choose from.
    """
    runs = running()
    if name is None and len(runs) == 1:
        return runs[0]
    if name in runs and name is not None:
        return name
    there = f"there are {', '.join(runs)}" if runs else "no loop is running on this host"
    if name is not None:
        raise BusError(f"there is no run {name!r}: {there}")
    raise BusError(f"say which run with --run: {there}" if runs else there)
