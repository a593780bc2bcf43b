"""The commands `lowfc config`: print all keys, check a file, print the zenoh configuration of a role."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import tomli_w
import typer

from lowfc.adapters.bus.access import roles
from lowfc.adapters.bus.run import DEFAULT_RUN, open_run, run_path
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.terminal import AnyRun, ConfigFile, configuration
from lowfc.client.runs import the_known_run
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import BusError, ConfigurationError
from lowfc.contract.messages import Role
from lowfc.contract.network import Section
from lowfc.contract.printable import printable

_HEADER = (
    "# Keys after a # have their defaults; remove the # to set a value. For keys that are not set, a command may use",
    "# another default: sim-loop starts with the loop closed and distributes its processes over the processors.",
    "",
)


def commented(config: Configuration) -> str:
    """TOML of a configuration: each key below its description, commented out unless it was set.

    An uncommented default would override a command's own default.
    """
    return "\n".join([*_HEADER, *_lines(config)])


def _lines(section: Section, prefix: str = "") -> Iterator[str]:
    """Keys of a section, then the sections in it."""
    descriptions = section.descriptions()
    subsections = {name: _subsections(getattr(section, name)) for name in descriptions}
    for name, description in descriptions.items():
        if subsections[name]:
            continue
        yield f"# {' '.join(description.split())}"
        mark = "" if name in section.model_fields_set else "#"
        yield from (f"{mark}{line}" for line in _assignment(name, getattr(section, name)))
    for name, tables in subsections.items():
        header = f"[{prefix}{name}]" if isinstance(getattr(section, name), Section) else f"[[{prefix}{name}]]"
        for table in tables:
            yield from ("", header, *_lines(table, f"{prefix}{name}."))


def _subsections(value: object) -> list[Section]:
    """The section or the list of sections of a value; empty for a plain value."""
    values = value if isinstance(value, list) else [value]
    return [each for each in values if isinstance(each, Section)]


def _assignment(name: str, value: object) -> list[str]:
    """Lines of a key and its value; a table is written inline, so that other keys can follow it."""
    if isinstance(value, dict):
        return [f"{name} = {_inline(value)}"]
    return tomli_w.dumps({name: value}).rstrip("\n").split("\n")


def _inline(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    if isinstance(value, dict):
        items = (tomli_w.dumps({key: 0}).removesuffix("0\n") + _inline(one) for key, one in value.items())
        return f"{{{', '.join(items)}}}"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")


def config_show(config: ConfigFile = None) -> None:
    """Print every key with its value and description, as TOML; keys that are not set are commented out.

    Example: lowfc config show > lowfc.toml
    """
    typer.echo(commented(configuration(config)))


def config_check(
    config: Annotated[Path, typer.Argument(help="Configuration file (TOML).")],
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file to read; default: compute one, as a run does.")
    ] = None,
) -> None:
    """Check a configuration file and the files it names, and compute or read a calibration.

    On errors the exit status is 2, with one line per error.

    Example: lowfc config check lowfc.toml
    """
    from rich.console import Console

    from lowfc.adapters.files.calibration_file import load as load_calibration
    from lowfc.device.plugins import faults
    from lowfc.programs.commissioning.analytic import analytic
    from lowfc.programs.core.recording.volume import configured_selection
    from lowfc.programs.core.start_up import check_files

    settings = configuration(config)
    check_files(settings)
    configured_selection(settings)
    if wrong := faults(settings, config.parent):
        raise ConfigurationError("\n".join(f"{config}: {fault}" for fault in wrong))
    if calibration is None:
        analytic(settings, Console(stderr=True))
    else:
        load_calibration(calibration)
    typer.echo(f"{printable(str(config))}: fine")


def config_zenoh(
    role: Annotated[str, typer.Option(help="Role of your program, such as camera.")],
    run: AnyRun = None,
    make: Annotated[
        bool,
        typer.Option("--make", help=f"Create the run if it does not exist (without --run: {DEFAULT_RUN})."),
    ] = False,
) -> None:
    """Print the zenoh configuration with which your own program joins a run in a role.

    Example: lowfc config zenoh --role camera --run bench
    """
    name = DEFAULT_RUN if run is None else run
    exists, created = run_path(name).is_dir(), None
    if make and not exists:
        part, _, mirror = role.partition("-")
        keys = {"mirror.name": mirror} if part == Role.MIRROR and mirror else {}
        created = open_run(name, (load(None, keys).mirror.name,))
    try:
        joined = open_run(name if make else the_known_run(run), ())
    except BusError as fault:
        raise fault if make else BusError(f"{fault}; --make creates a run that does not exist") from None
    links = joined.links
    local = sorted({*links.ports, "bench", "operator", "launcher"})
    run_roles = roles(links.mirrors) if links.network.router else local
    if role not in run_roles:
        if created is not None:
            created.remove()
        raise BusError(f"run {joined.run_id!r} has no role {role!r}; its roles are {', '.join(run_roles)}")
    HostClock()  # writes the clock offset to a file that the user's program reads
    typer.echo(json.dumps(session_config(links, role), indent=2))
