"""Required documentation: public names of five packages, valid markup, shapes and units of arrays, advice on events."""

import ast
import io
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from lowfc.contract.events import EVENTS
from lowfc.contract.wire import lowfc_pb2
from tools.advice import ADVICE, REASONS

ROOT = Path(__file__).parents[2]
PACKAGES = ("client", "device", "optics", "design", "control")
ARRAYS = re.compile(r"\b(Array|Single|SingleComplex|Complex|Integers|Long|Mask|Pixels|Sequences|ArrayLike|NDArray)\b")
SHAPE = re.compile(r"\([\w+*/ .-]+,\)|\([\w+*/ .-]+(, ?[\w+*/ .-]+)+\)|shapes? as|any shape")
UNIT = re.compile(
    r"(?<!')\b(nm2?|um|mas|DN|electrons?|e-|ns|s|Hz|rad|deg|waves|frames|diameters|lambda0?|"
    r"radii|(their|any) unit|without unit|variance|sequence|"
    r"fractions?|factors?|relative|transmissions?|weights|amplitudes?|indices|contrast|0 or 1|1 where|whether)\b"
)
"""A word for a unit, or for a quantity without unit; the s of a possessive does not count as seconds."""

Definition = ast.FunctionDef | ast.ClassDef


def public(body: list[ast.stmt], parent: str, parents_text: str = "") -> Iterator[tuple[str, Definition, str, str]]:
    """Name, node and docstring of each public definition, and the docstring of its class."""
    for node in body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            text = ast.get_docstring(node) or ""
            yield f"{parent}.{node.name}", node, text, parents_text
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, f"{parent}.{node.name}", text)


def definitions(package: str) -> list[tuple[str, Definition, str, str]]:
    found = []
    for path in sorted((ROOT / "lowfc" / package).rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found += public(ast.parse(path.read_text()).body, module)
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_has_a_docstring(package: str) -> None:
    documented = definitions(package)
    assert len(documented) > 20
    assert [name for name, _, text, _ in documented if not text] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_are_valid_markup(package: str) -> None:
    import docutils.nodes
    from docutils.frontend import get_default_settings
    from docutils.parsers.rst import Parser
    from docutils.utils import new_document
    from sphinx.ext.napoleon import Config, GoogleDocstring

    settings = get_default_settings(Parser)
    settings.warning_stream = io.StringIO()
    for name, _, text, _ in definitions(package):
        document = new_document(name, settings)
        Parser().parse(str(GoogleDocstring(text, Config(napoleon_use_ivar=True))), document)
        assert [node.astext() for node in document.findall(docutils.nodes.substitution_reference)] == [], name
    assert settings.warning_stream.getvalue() == ""


@pytest.mark.parametrize("package", PACKAGES)
def test_functions_of_arrays_document_shapes_and_units(package: str) -> None:
    lacking = []
    for name, node, text, parents_text in definitions(package):
        if isinstance(node, ast.FunctionDef):
            annotated = [arg for arg in (*node.args.args, *node.args.kwonlyargs) if arg.annotation is not None]
            arrays = [arg for arg in annotated if ARRAYS.search(ast.unparse(arg.annotation))]
            searched = f"{text} {parents_text} {' '.join(array.arg.rpartition('_')[2] for array in arrays)}"
            if arrays and not (SHAPE.search(searched) and UNIT.search(searched)):
                lacking.append((name, "unit" if SHAPE.search(searched) else "shape", [array.arg for array in arrays]))
    assert lacking == []


def test_every_event_and_reason_has_advice() -> None:
    assert [*ADVICE] == [*EVENTS]
    reasons = [value.name.removeprefix("REASON_") for value in lowfc_pb2.Reason.DESCRIPTOR.values]
    assert [*REASONS] == reasons[1:]
