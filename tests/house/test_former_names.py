"""Former names of identifiers, fields, enum values, keys and extensions are no longer used as such."""

import ast
import re
from pathlib import Path

import pytest

from lowfc.adapters.files import law_file
from lowfc.contract import configuration, former_names
from lowfc.contract.messages import wire

ROOT = Path(__file__).parents[2]
IDENTIFIERS = {
    *("Drive", "Following", "Additions", "Raised", "Lane", "hopeful", "Wanted", "Taken", "Told", "obey"),
    *("ShortcutReader", "SharedShortcutReader", "ShortcutWriter", "Ledger", "Rehearsal"),
    *("when_we_die", "last_words", "newest_only", "timeless", "stay_awake", "SAFED"),
    *("late_ms", "hold_ms", "valid_ms", "most_alike", "most_saturated", "least_flux", "PixelLaws", "pixel_laws"),
}
WORD = re.compile(rf"\b(?:{'|'.join(IDENTIFIERS)})\b")
"""A former name anywhere, also in texts and comments; only sources with a match are parsed."""
FOLDERS = ("lowfc", "sim_camera", "sim_dm", "tests", "benchmarks", "tools", "examples")
SOURCES = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if path != Path(__file__)]


def identifiers(source: str) -> set[str]:
    """Names, attributes, arguments and definitions of a module."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        for field in ("id", "attr", "arg", "name"):
            if isinstance(name := getattr(node, field, None), str):
                found.add(name)
    return found


def test_no_source_uses_a_former_identifier() -> None:
    sources = {path: path.read_text(encoding="utf-8") for path in SOURCES}
    found = {path: identifiers(text) & IDENTIFIERS for path, text in sources.items() if WORD.search(text)}
    assert {str(path.relative_to(ROOT)): names for path, names in found.items() if names} == {}
    assert len(SOURCES) > 400


def test_no_message_uses_a_former_field() -> None:
    for former in former_names.FIELDS:
        message, _, field = former.partition(".")
        assert field not in getattr(wire, message).DESCRIPTOR.fields_by_name, former
    values = {value for enum in wire.DESCRIPTOR.enum_types_by_name.values() for value in enum.values_by_name}
    assert values & former_names.VALUES.keys() == set()


def test_no_key_or_extension_uses_a_former_name() -> None:
    assert configuration.keys().keys() & former_names.KEYS.keys() == set()
    former = {old for new, old in former_names.LAW_EXTENSIONS.items() if old != new}
    assert {name for name, _, _ in law_file._EXTENSIONS} & former == set()


@pytest.mark.parametrize(
    "source", ["class Drive: ...", "x = state.hopeful", "def obey(): ...", "f(late_ms=1)", "from a import Lane"]
)
def test_former_identifiers_are_found(source: str) -> None:
    assert WORD.search(source)
    assert identifiers(source) & IDENTIFIERS
