"""Which runs there are on this host."""

from lowfc.adapters.run import open_run, runtime_base
from lowfc.contract.errors import BusError, DataFileError
from lowfc.contract.messages import Role


def running() -> list[str]:
    """Names of the runs on this host whose controller listens; a run that was killed leaves its directory behind."""
    return [name for name, roles in _living().items() if Role.CONTROLLER in roles]


def the_run(name: str | None) -> str:
    """The run of that name, whoever of it is there, or the only one there is.

    That is the only one with a controller; without any, the only one of which at least somebody is there.

    Raises:
        BusError: there is no such run, none at all, or more than one to choose from.
    """
    living = _living(name)
    if name is not None and name in living:
        return name
    runs = [run for run, roles in living.items() if Role.CONTROLLER in roles] or list(living)
    if name is None and len(runs) == 1:
        return runs[0]
    there = f"there are {', '.join(living)}" if living else "no loop is running on this host"
    if name is not None:
        raise BusError(f"there is no run {name!r}: {there}")
    raise BusError(f"say which run with --run: {there}" if living else there)


def _living(wanted: str | None = None) -> dict[str, set[str]]:
    """Runs of which somebody listens, and who; a damaged one is left out, unless it is the one that is wanted.

    Raises:
        BusError, DataFileError: the wanted one is damaged.
    """
    found: dict[str, set[str]] = {}
    for name in sorted(path.parent.name for path in runtime_base().glob("*/links.json")):
        try:
            roles = open_run(name, ()).links.live()
        except (BusError, DataFileError, OSError):
            if name == wanted:
                raise
            continue
        if roles:
            found[name] = roles
    return found
