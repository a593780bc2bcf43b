"""Which run a command means."""

from lowfc.adapters.bus.run import runtime_base
from lowfc.client import the_run


def the_known_run(name: str | None) -> str:
    """The run of that name, whether a process of it is there or not, or the only one there is, as `the_run`.

    Raises:
        BusError: there is no such run, none at all, or more than one to choose from.
    """
    return name if name is not None and (runtime_base() / name).is_dir() else the_run(name)
