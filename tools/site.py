"""Reference tables that are generated while the site is built, in place of lines `<!-- built: NAME -->` of its pages.

They are too long for the sources of a page. `tools.measure` writes shorter tables into the pages themselves.
"""

import re
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib import import_module
from types import ModuleType
from typing import Any, get_args

import typer
from typer.main import get_command

from lowfc.contract.configuration import Configuration
from lowfc.contract.former_names import FIELDS, KEYS, LAW_EXTENSIONS, VALUES
from lowfc.contract.messages import EVERYBODY, TOPICS
from lowfc.contract.network import Section
from lowfc.contract.sections import InterlockSection
from lowfc.contract.wire import lowfc_pb2
from lowfc.programs.cli.main import app
from lowfc.programs.cli.result import Result
from tools.declared import API, fields, modules, one_line, when
from tools.shared import markdown

_BUILT = re.compile(r"^<!-- built: (.+?) -->$", re.MULTILINE)
_WIDTH = 100


def with_built(page: str) -> str:
    """A page with its tables generated."""
    return _BUILT.sub(lambda found: BUILT[found[1]](), page)


def commands() -> str:
    """Every command with its help."""
    return "\n".join(
        f"## {context.command_path}\n\n```text\n{context.get_help()}\n```\n"
        for context in _contexts(typer.Context(get_command(app), info_name="lowfc", terminal_width=_WIDTH))
    )


def _contexts(context: typer.Context) -> Iterator[typer.Context]:
    """A command, then its subcommands, recursively."""
    yield context
    for name in getattr(context.command, "commands", ()):
        command = context.command.get_command(context, name)  # type: ignore[attr-defined]  # a group
        yield from _contexts(typer.Context(command, parent=context, info_name=name, terminal_width=_WIDTH))


def configuration() -> str:
    """Every key of the configuration, by section."""
    sections = {name: type(value) for name, value in Configuration() if isinstance(value, Section)}
    parts = [_keys("Top level", "", Configuration, "")]
    parts += [
        _keys(f"[{name}]", f"{one_line(section.__doc__)}.", section, f"{name}.") for name, section in sections.items()
    ]
    about = f"{one_line(InterlockSection.__doc__)}. One table for each interlock."
    parts.append(_keys("[[interlocks]]", about, InterlockSection, "interlocks."))
    return "\n".join(parts)


def _keys(heading: str, about: str, section: type[Section], prefix: str) -> str:
    descriptions = section.descriptions()
    rows = []
    for key, info in section.model_fields.items():
        if isinstance(info.default, Section):
            continue
        default = "required" if info.is_required() else f"`{info.get_default(call_default_factory=True)!r}`"
        types = (info.annotation, *get_args(info.annotation))  # with those inside a list or a union
        nested = [one for each in types for one in get_args(each)]
        bounds = [*info.metadata, *(bound for one in nested for bound in getattr(one, "metadata", ()))]
        values = [_bound(str(one)) for one in bounds if hasattr(one, "__dataclass_fields__")]
        values += [f"`{one}`" for one in nested if isinstance(one, str | int)]
        rows.append((f"`{prefix}{key}`", default, ", ".join(values), one_line(descriptions[key])))
    return f"## {heading}\n\n{about}\n\n{markdown(('key', 'default', 'values', 'description'), rows)}"


def _bound(text: str) -> str:
    """A bound such as "Ge(ge=1)" in words."""
    kind, _, value = text.rstrip(")").partition("=")
    sign = {"Ge(ge": "at least", "Gt(gt": "above", "Le(le": "at most", "Lt(lt": "below"}.get(kind)
    return f"{sign} {value}" if sign else ""


def topics() -> str:
    """A table of all topics."""
    rows = []
    for topic in TOPICS:
        full = topic.message.DESCRIPTOR.full_name
        own = full.startswith("lowfc.")
        message = f"[`{full}`](messages.md#{full.rpartition('.')[2].lower()})" if own else f"`{full}`"
        who = [
            "any" if roles == EVERYBODY else ", ".join(sorted(roles)) for roles in (topic.publishers, topic.subscribers)
        ]
        about = f"{topic.description}{' The last one is returned on query.' if topic.queryable else ''}"
        rows.append((f"`{topic.key}`", message, when(topic), *who, about))
    return markdown(("topic", "message", "when", "published by", "received by", "description"), rows)


def messages() -> str:
    """Every message with its fields, every enumeration with its values."""
    file = lowfc_pb2.DESCRIPTOR
    parts = [f"## {name}\n\n{fields(name)}" for name in file.message_types_by_name]
    for name, enumeration in file.enum_types_by_name.items():
        parts.append(
            f"## {name}\n\n{markdown(('value', 'number'), ((f'`{v.name}`', v.number) for v in enumeration.values))}"
        )
    return "\n".join(parts)


@cache
def json_objects() -> str:
    """Every `--json` object that has a class, with its fields."""
    for module in modules("lowfc.programs"):
        import_module(module)
    printed = {one for one in _subclasses(Result) if one.model_fields and one.__module__.startswith("lowfc.")}
    rows = []
    for result in sorted(printed, key=lambda each: f"{each.__module__}.{each.__name__}"):
        *_, package, module = result.__module__.split(".")
        command = module if package == "cli" else package  # the other commands are packages
        about = f"{one_line(result.__doc__)}. Printed by `lowfc {command}`."
        rows.append(f"### {result.__name__}\n\n{about}\n\n{_field_table(result)}")
    return "\n".join(rows)


def _field_table(result: type[Result]) -> str:
    rows = []
    printed = {name: info for name, info in result.model_fields.items() if not info.exclude}
    for name, info in printed.items():
        extra = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
        rows.append(
            (f"`{info.alias or name}`", f"`{_type(info.annotation)}`", extra.get("unit", ""), info.description or "")
        )
    for name, computed in result.model_computed_fields.items():
        rows.append((f"`{name}`", f"`{_type(computed.return_type)}`", "", one_line(computed.description)))
    return markdown(("key", "type", "unit", "label"), rows)


def _type(annotation: Any) -> str:
    text = annotation.__name__ if isinstance(annotation, type) and not get_args(annotation) else str(annotation)
    return re.sub(r"\b[\w.]+\.(?=\w)", "", text).replace("|", "or")


def _subclasses(kind: type[Result]) -> set[type[Result]]:
    return {one for child in kind.__subclasses__() for one in (child, *_subclasses(child))}


def former_names() -> str:
    """Configuration keys, message fields, values and law extensions renamed since release 0.1."""
    tables = {
        "configuration key": KEYS,
        "field of a message": FIELDS,
        "value": VALUES,
        "extension of a law file": {old: new for new, old in LAW_EXTENSIONS.items() if old != new},
    }
    rows = [(kind, f"`{old}`", f"`{new}`") for kind, table in tables.items() for old, new in table.items()]
    return markdown(("what", "0.1", "0.2"), rows)


def api(package: str) -> str:
    """A package of the Python API: its exported names or, without `__all__`, each of its modules."""
    top = import_module(package)
    if hasattr(top, "__all__"):
        return _module(top)
    return "\n".join(_module(import_module(name)) for name in modules(package))


def _module(module: ModuleType) -> str:
    name, imported = module.__name__, "   :imported-members:\n" if hasattr(module, "__all__") else ""
    return f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n{imported}```\n"


BUILT: dict[str, Callable[[], str]] = {
    "commands": commands,
    "configuration": configuration,
    "topics": topics,
    "messages": messages,
    "json": json_objects,
    "former names": former_names,
    **{f"api {one}": partial(api, f"lowfc.{one}") for one in API},
}
"""The generated tables, by the names used in the pages."""
