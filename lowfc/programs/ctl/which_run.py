"""Which run a command means."""

from lowfc.adapters.run import runtime_base
from lowfc.client import running, the_run
from lowfc.contract.errors import BusError


def the_known_run(name: str | None) -> str:
    """The run of that name, whether its controller is there or not, or the only one there is.

    Raises:
        BusError: there is no such run, none at all, or more than one to choose from.
    """
    if name is None:
        return the_run(None)
    if not (runtime_base() / name).is_dir():
        raise BusError(
            f"there is no run {name!r}: start its processes first; running are {', '.join(running()) or 'none'}"
        )
    return name
