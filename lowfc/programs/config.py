"""What a configuration says: every key with its sentence, or the bus session of a role."""

import json
from collections.abc import Iterator

import tomli_w
from pydantic import BaseModel

from lowfc.adapters.clock import HostClock
from lowfc.adapters.run import DEFAULT_RUN, open_run
from lowfc.adapters.zenoh_bus import session_config
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError
from lowfc.programs.ctl.which_run import the_known_run

_HEADER = (
    "# A key with a # before it has its default. Remove the # to choose a value; a command may choose another default",
    "# where the file is silent: sim-loop starts with the loop closed and gives the controller a processor of its own.",
    "",
)


def commented(config: Configuration) -> str:
    """TOML of a configuration: each key below its sentence, commented out unless it was chosen.

    A key that was not chosen would otherwise replace what a command chooses where the file is silent.
    """
    return "\n".join([*_HEADER, *_lines(config)])


def _lines(section: BaseModel, prefix: str = "") -> Iterator[str]:
    """Keys of a section, then the sections in it."""
    names = type(section).model_fields
    inner = [name for name in names if isinstance(getattr(section, name), BaseModel)]
    for name in names:
        if name in inner:
            continue
        yield f"# {' '.join((names[name].description or '').split())}"
        mark = "" if name in section.model_fields_set else "#"
        yield from (f"{mark}{line}" for line in _assignment(name, getattr(section, name)))
    for name in inner:
        yield from ("", f"[{prefix}{name}]", *_lines(getattr(section, name), f"{prefix}{name}."))


def _assignment(name: str, value: object) -> list[str]:
    """A key and its value; a table in one line, so that it can stand between other keys."""
    if isinstance(value, dict):
        items = ", ".join(tomli_w.dumps({key: one}).strip() for key, one in value.items())
        return [f"{name} = {{{items}}}"]
    return tomli_w.dumps({name: value}).splitlines()


def zenoh_session(run_id: str | None, role: str, *, make: bool) -> str:
    """Zenoh's configuration file for a program that plays a role in a run, which is made where `make` allows it.

    Raises:
        BusError: there is no such run, or it has no such role.
    """
    try:
        run = open_run(run_id or DEFAULT_RUN if make else the_known_run(run_id))
    except BusError as fault:
        raise fault if make else BusError(f"{fault}; --make makes a run that is not there") from None
    known = sorted({*run.links.ports, "operator", "launcher"})
    if role not in known:
        raise BusError(f"run {run_id!r} has no role {role!r}; there are {', '.join(known)}")
    HostClock()  # its file says what time the messages of this host go by
    return json.dumps(session_config(run.links, role), indent=2)
