"""Find drivers by name: an entry point of an installed package, "module:Class", or "folder/file.py:Class"."""

import importlib.util
import json
import sys
import tomllib
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from pydantic import ValidationError

from lowfc.contract.configuration import Configuration, explain
from lowfc.contract.errors import ConfigurationError, brief, nearest
from lowfc.device.driver import DriverOptions
from lowfc.device.watch import opening

Kind = Literal["camera", "mirror"]
KINDS: tuple[Kind, ...] = ("camera", "mirror")
METHODS: dict[Kind, tuple[str, ...]] = {"camera": ("settings", "expose", "close"), "mirror": ("apply", "close")}


def installed(kind: Kind) -> dict[str, EntryPoint]:
    """Entry points of the installed drivers, by name."""
    return {point.name: point for point in entry_points(group=f"lowfc.{kind}s")}


def load(kind: Kind, name: str) -> Any:
    """Import a driver's class or factory; ConfigurationError if it is absent, fails to import or lacks a method."""
    module, colon, attribute = name.rpartition(":")
    with opening(f"the driver {name!r} cannot be loaded"):
        if colon:
            if module.endswith(".py") and not Path(module).is_file():
                raise ConfigurationError(f"the driver {name!r} cannot be loaded: there is no file {module}")
            names = [section(name)] if module.endswith(".py") else module.split(".")
            if not all(part.isidentifier() for part in (*names, *attribute.split("."))):
                raise ConfigurationError(
                    f"the driver {name!r} cannot be loaded: file and class must have names of letters, digits and _, "
                    "as in folder/my_camera.py:MyCamera: rename the file or the class"
                )
            # Needed with `python -P`, whose search path has no current folder.
            sys.path.insert(0, str(Path(module).resolve().parent if module.endswith(".py") else Path.cwd()))
            point = EntryPoint(name, f"{section(name)}:{attribute}", f"lowfc.{kind}s")
        elif name in (drivers := installed(kind)):
            point = drivers[name]
        else:
            raise ConfigurationError(
                f"no driver of a {kind} is called {name!r}{nearest(name, drivers)}; there are "
                f"{', '.join(sorted(drivers))}, or write module:Class or file.py:Class"
            )
        driver = point.load()
    missing = [method for method in METHODS[kind] if isinstance(driver, type) and not hasattr(driver, method)]
    if missing:
        raise ConfigurationError(f"the driver {name!r} is no {kind}: it has no {' and no '.join(missing)}")
    model = getattr(driver, "Options", DriverOptions)
    if not (isinstance(model, type) and issubclass(model, DriverOptions)):
        raise ConfigurationError(f"the driver {name!r}: derive its class Options from lowfc.device.DriverOptions")
    return driver


def section(name: str) -> str:
    """NAME of a driver's section [drivers.NAME]: the driver's name or, for a class, the name of the class's module."""
    module = name.partition(":")[0]
    return Path(module).stem if module.endswith(".py") else module


def opened(kind: Kind, name: str, config: Configuration, arguments: Sequence[str] = (), driver: Any = None) -> Any:
    """Open a driver with the options of the configuration, overridden by `arguments` (--key value, --key=value).

    `driver` is the driver's class, if it is loaded already. ConfigurationError if it cannot be loaded or opened, or an
    option is wrong.
    """
    driver = load(kind, name) if driver is None else driver
    values = options(driver, table(config, kind, name), arguments)
    with opening(f"the {kind} {name!r} cannot be opened"):
        return driver(values, config)


def faults(config: Configuration, folder: Path) -> list[str]:
    """List the faults of the sections [drivers.NAME] of a configuration whose file is in `folder`, a sentence each."""
    sentences, files = [], {file.stem for searched in (folder, Path.cwd()) for file in searched.glob("*.py")}
    for name in config.drivers:
        kinds = [kind for kind in KINDS if name in installed(kind)]
        module = name.partition(".")[0]
        importable = module in sys.modules or importlib.util.find_spec(module) is not None
        # Other unknown names are no faults: they may belong to driver files in other folders.
        similar = nearest(name, {*installed("camera"), *installed("mirror")})
        if not kinds and name not in files and not importable and (similar or not module.isidentifier()):
            sentences.append(
                f"drivers.{name}: no installed driver or module has that name{similar}, and there is no file {name}.py "
                "here; the options of folder/file.py:Class are in drivers.file"
            )
        parts = " or ".join(f"[drivers.{name}.{kind}]" for kind in kinds)
        hint = f"; options of the camera or the mirror alone belong in {parts}" if len(kinds) > 1 else ""
        for kind in kinds:
            try:
                options(load(kind, name), table(config, kind, name))
            except ConfigurationError as fault:
                sentences.append(f"drivers.{name}: {fault}{hint}")
    return sentences


def table(config: Configuration, kind: Kind, name: str) -> dict[str, Any]:
    """Options of a driver in a configuration: [drivers.NAME], or its part for this kind.

    ConfigurationError if the section is named after the driver's class.
    """
    expected = section(name)
    for other in {name, name.rpartition(":")[2]} - {expected}:
        if other in config.drivers:
            raise ConfigurationError(f"the options of {name} are in [drivers.{expected}], got [drivers.{other}]")
    entries = config.drivers.get(expected) or _nested(config.drivers, expected)
    if entries and set(entries) <= set(KINDS) and all(isinstance(part, dict) for part in entries.values()):
        return dict(entries.get(kind, {}))
    return entries


def _nested(tables: dict[str, Any], name: str) -> dict[str, Any]:
    """The table of a dotted name, as TOML reads [drivers.package.module]; empty if there is none."""
    nested: Any = tables
    for part in name.split("."):
        nested = nested.get(part) if isinstance(nested, dict) else None
    return nested if isinstance(nested, dict) else {}


def options(driver: Any, configured: dict[str, Any], arguments: Sequence[str] = ()) -> DriverOptions:
    """Options of a driver's class from a table, overridden by command-line arguments `--key value`.

    ConfigurationError if one is unknown or wrong.
    """
    model: type[DriverOptions] = getattr(driver, "Options", DriverOptions)
    values, faults = {key: _choice(model, key, value) for key, value in _parsed(arguments).items()}, []
    try:
        # In JSON, as in TOML, a list stands for a tuple, and text for a path or an enum.
        validated = model.model_validate_json(json.dumps(configured, default=str))
    except ValidationError as error:  # options missing here may be among the arguments
        faults = [detail for detail in error.errors() if not (values and detail["type"] == "missing")]
    if values and not faults:
        try:
            validated = model.model_validate({**configured, **values}, strict=False)
        except ValidationError as error:
            faults = error.errors()
    if faults:
        name = getattr(driver, "__name__", "the driver")  # a factory such as `partial` has none
        lines = [f"options of {name}: {_explained(detail, model)}" for detail in faults]
        raise ConfigurationError("\n".join(lines))
    return validated


def options_help(driver: Any) -> list[tuple[str, str]]:
    """Command-line options of a driver's class, each with its help."""
    rows = []
    model: type[DriverOptions] = getattr(driver, "Options", DriverOptions)
    descriptions = model.descriptions()
    for key, info in model.model_fields.items():
        annotation = info.annotation
        if get_args(annotation)[1:] == (NoneType,):
            annotation = get_args(annotation)[0]
        choices = get_args(annotation) if get_origin(annotation) is Literal else ()
        kind = "|".join(map(str, choices)) or getattr(annotation, "__name__", str(annotation))
        default = "required" if info.is_required() else f"default: {info.get_default(call_default_factory=True)}"
        shown = "" if default.endswith((": ", "None")) else f"  [{default}]"
        rows.append((f"--{key.replace('_', '-')} <{kind}>", f"{descriptions[key]}{shown}"))
    return rows


def _choice(model: type[DriverOptions], key: str, value: Any) -> Any:
    """The choice of a Literal option whose text is `value`, such as the number 2 for "2"; `value` if there is none."""
    annotation = model.model_fields[key].annotation if key in model.model_fields else None
    parts = annotation, *get_args(annotation)
    choices = {str(choice): choice for part in parts if get_origin(part) is Literal for choice in get_args(part)}
    return choices.get(str(value), value)


def _explained(fault: Any, model: type[DriverOptions]) -> str:
    if fault["type"] == "extra_forbidden":
        if fault["loc"][0] in KINDS and isinstance(fault["input"], dict):
            return f"a section has options, or the parts {' and '.join(KINDS)} with options, not both"
        return f"there is no {brief(fault['loc'][0])}; there are {', '.join(model.model_fields) or 'none'}"
    if fault["type"] == "missing":
        key = str(fault["loc"][0])
        return (
            f"{key} is missing: --{key.replace('_', '-')} VALUE, or {key} in the driver's section of the configuration"
        )
    return explain(fault)


def _parsed(arguments: Sequence[str]) -> dict[str, Any]:
    """Parse a command line into values by field name; lists and tables are written as in TOML."""
    values: dict[str, Any] = {}
    remaining = list(arguments)
    while remaining:
        key, equals, value = remaining.pop(0).partition("=")
        if not key.startswith("--") or not (equals or remaining):
            raise ConfigurationError(f"options of a driver are --name value, got {' '.join([key, *remaining])!r}")
        value = value if equals else remaining.pop(0)
        try:
            is_toml = value[:1] in ("[", "{")
            values[key[2:].replace("-", "_")] = tomllib.loads(f"x = {value}")["x"] if is_toml else value
        except tomllib.TOMLDecodeError:
            raise ConfigurationError(f"{key}: {value!r} is not a list or a table as in TOML") from None
    return values
