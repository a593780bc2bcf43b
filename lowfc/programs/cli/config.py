"""The commands `lowfc config`: every key with its sentence, a check, the bus session of a role."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import tomli_w
import typer
from pydantic import BaseModel

from lowfc.adapters.bus.run import DEFAULT_RUN, open_run
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.terminal import AnyRun, ConfigFile, configuration
from lowfc.client.runs import the_known_run
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError, ConfigurationError

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
    inner = {name: _tables(getattr(section, name)) for name in names}
    for name in names:
        if inner[name]:
            continue
        yield f"# {' '.join((names[name].description or '').split())}"
        mark = "" if name in section.model_fields_set else "#"
        yield from (f"{mark}{line}" for line in _assignment(name, getattr(section, name)))
    for name, tables in inner.items():
        header = f"[{prefix}{name}]" if isinstance(getattr(section, name), BaseModel) else f"[[{prefix}{name}]]"
        for table in tables:
            yield from ("", header, *_lines(table, f"{prefix}{name}."))


def _tables(value: object) -> list[BaseModel]:
    """The section that a value is, or the sections in it; none of a plain value."""
    return [one for one in (value if isinstance(value, list) else [value]) if isinstance(one, BaseModel)]


def _assignment(name: str, value: object) -> list[str]:
    """A key and its value; a table in one line, so that it can stand between other keys."""
    if not isinstance(value, dict):
        return tomli_w.dumps({name: value}).splitlines()
    items = ", ".join(" ".join(_assignment(key, one)) for key, one in value.items())
    return [f"{tomli_w.dumps({name: 0}).partition(' = ')[0]} = {{{items}}}"]


def config_show(config: ConfigFile = None) -> None:
    """Print every key with its value and its sentence, as TOML; keys that nobody chose are commented out.

    Example: lowfc config show > lowfc.toml
    """
    typer.echo(commented(configuration(config)))


def config_check(config: Annotated[Path, typer.Argument(help="Configuration file (TOML).")]) -> None:
    """Check a configuration file and the files it names; exit status 2 and one line per mistake where it is wrong.

    Example: lowfc config check lowfc.toml
    """
    from lowfc.device.plugins import faults
    from lowfc.programs.core.start_up import check_files

    settings = configuration(config)
    check_files(settings)
    if wrong := faults(settings, config.parent):
        raise ConfigurationError("\n".join(f"{config}: {one}" for one in wrong))
    typer.echo(f"{config}: fine")


def config_zenoh(
    role: Annotated[str, typer.Option(help="Role of your program, such as camera.")],
    run: AnyRun = None,
    make: Annotated[bool, typer.Option("--make", help="Make the run, if it is not there.")] = False,
) -> None:
    """Print the zenoh configuration for a program of your own that plays a role in a run.

    Example: lowfc config zenoh --role camera --run bench
    """
    try:
        joined = open_run(run or DEFAULT_RUN if make else the_known_run(run))
    except BusError as fault:
        raise fault if make else BusError(f"{fault}; --make makes a run that is not there") from None
    known = sorted({*joined.links.ports, "bench", "operator", "launcher"})
    if role not in known:
        raise BusError(f"run {run!r} has no role {role!r}; there are {', '.join(known)}")
    HostClock()  # its file says what time the messages of this host go by
    typer.echo(json.dumps(session_config(joined.links, role), indent=2))
