"""The configuration in a log, recorded by this or another version of lowfc."""

from typing import Any

from pydantic import BaseModel, ValidationError

from lowfc.contract import toml_text
from lowfc.contract.configuration import MAX_FAULTS, Configuration, explain
from lowfc.contract.errors import ConfigurationError, raised_as
from lowfc.contract.former_names import renamed_keys
from lowfc.contract.sections import InterlockSection

_SECTIONS: dict[str, type[BaseModel]] = {
    name: info.annotation
    for name, info in Configuration.model_fields.items()
    if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel)
}


def recorded(content: bytes) -> tuple[Configuration, list[str]]:
    """Read a recorded configuration; return it with remarks on what this version would refuse in a file.

    An unknown key is ignored, an invalid value is replaced by the default, and an invalid interlock left out. Values
    that are valid but contradict each other stay as they are, since the run used them.

    Raises:
        ConfigurationError: it is not a readable TOML file.
    """
    with raised_as(ConfigurationError, ValueError, "not a readable TOML file"):
        data = toml_text.parsed(content)
        renamed_keys(data)
    remarks: list[str] = []
    while faults := _faults(data):
        # A fault that belongs to no single key is a contradiction between keys, reported by the validator of a section.
        single_key = [detail for detail in faults if len(detail["loc"]) > 1 or detail["type"] != "value_error"]
        if not single_key:
            remarks += [f"{explain(detail)}; used as recorded" for detail in faults]
            return _constructed(data, {str(detail["loc"][0]) for detail in faults if detail["loc"]}), remarks
        remarks += [f"{explain(detail)}; {_mend(data, detail)}" for detail in single_key[:MAX_FAULTS]]
        if more := [_mend(data, detail) for detail in single_key[MAX_FAULTS:]]:
            remarks.append(f"and {len(more)} more")
        if isinstance(interlocks := data.get("interlocks"), list):
            data["interlocks"] = [interlock for interlock in interlocks if interlock is not None]
    return Configuration.model_validate(data), remarks


def _faults(data: dict[str, Any]) -> list[Any]:
    try:
        Configuration.model_validate(data)
    except ValidationError as error:
        return list(error.errors())
    return []


def _mend(data: dict[str, Any], detail: Any) -> str:
    """Remove the key at fault; return the consequence in words."""
    section, *path = detail["loc"]
    table = data.get(section)
    if isinstance(table, list) and path:  # the key is in one interlock, whose index is path[0]
        if detail["type"] != "extra_forbidden" or table[path[0]] is None:
            table[path[0]] = None
            return "this interlock is left out"
        table, path = table[path[0]], path[1:]
    if path and isinstance(table, dict):
        table.pop(path[0], None)
    else:
        data.pop(section, None)
    return "it is ignored" if detail["type"] == "extra_forbidden" else "the default is used"


def _constructed(data: dict[str, Any], contradictory: set[str]) -> Configuration:
    """Build a configuration whose keys are valid one by one; the sections `contradictory` are not validated."""
    sections: dict[str, Any] = {
        name: kind.model_construct(**data[name]) if name in contradictory else kind.model_validate(data[name])
        for name, kind in _SECTIONS.items()
        if name in data
    }
    sections["interlocks"] = [InterlockSection.model_validate(table) for table in data.get("interlocks", ())]
    return Configuration.model_construct(**(data | sections))
