"""The site: `make docs` builds it without a warning, with every page and every declared name."""

import gc
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import pytest

from lowfc.client.requests import DECLARED
from lowfc.contract.configuration import keys
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import TOPICS
from lowfc.contract.wire import lowfc_pb2
from lowfc.programs.cli.main import COMMANDS, GROUP_COMMANDS
from lowfc.programs.commissioning.tune.result import TuneResult
from lowfc.programs.logs.replay.account import Account
from tools.advice import REASONS
from tools.site import BUILT

DOCS = Path(__file__).parents[2] / "docs"
_ROWS = re.compile(r"((?:^\|.*\n){4})(?:^\|.*\n)+", re.MULTILINE)


def first_rows(_app: object, name: str, source: list[str]) -> None:
    """Drop all but the first rows of tables of measured values: these have most rows of the site, and no links."""
    if name.startswith("measured/"):
        source[0] = _ROWS.sub(r"\1", source[0])


@pytest.fixture
def without_collector() -> Iterator[None]:
    """No garbage collection: it would search the trees of the pages repeatedly."""
    gc.disable()
    yield
    gc.enable()


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::PendingDeprecationWarning")  # by Sphinx extensions
@pytest.mark.usefixtures("without_collector")
@pytest.mark.parametrize("complete", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_site_has_every_page_and_every_declared_name(
    complete: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Broken links and pages outside an index are warnings, and a warning fails the build.

    Only the complete site includes docstrings, all measured values, typographic quotes, and the search index.
    """
    from sphinx.application import Sphinx
    from sphinx.builders.html import StandaloneHTMLBuilder
    from sphinx.util.docutils import docutils_namespace, patch_docutils

    if not complete:
        for name in [name for name in BUILT if name.startswith("api ")]:
            monkeypatch.setitem(BUILT, name, str)
        monkeypatch.setattr(StandaloneHTMLBuilder, "search", False)
    site = tmp_path / "site"
    with patch_docutils(DOCS), docutils_namespace():
        quotes, status = {"smartquotes": complete}, None
        sphinx = Sphinx(DOCS, DOCS, site, tmp_path / "doctrees", "html", quotes, status, warningiserror=True)
        if not complete:
            sphinx.connect("source-read", first_rows)
        sphinx.build()
    assert sphinx.statuscode == 0
    for page in DOCS.rglob("*.md"):
        assert (site / page.relative_to(DOCS).with_suffix(".html")).is_file()
    declared = {
        "reference/commands": [f"lowfc {row.name}" for row in (*sum(COMMANDS.values(), ()), *GROUP_COMMANDS)],
        "reference/configuration": [*keys()],
        "reference/topics": [topic.key for topic in TOPICS],
        "reference/messages": [*lowfc_pb2.DESCRIPTOR.message_types_by_name],
        "reference/requests": [request.key for request in DECLARED],
        "howto/troubleshooting": [*EVENTS, *REASONS],
    }
    for page, names in declared.items():
        text = unescape((site / f"{page}.html").read_text())
        assert [name for name in names if name not in text] == []


def test_typed_json_objects_name_the_commands_that_print_them() -> None:
    named = set(re.findall(r"Printed by `lowfc (\S+)`", BUILT["json"]()))
    assert {"hosts", "replay"} <= named <= {row.name for row in sum(COMMANDS.values(), ())}


def test_the_table_of_a_typed_json_object_has_the_keys_that_are_printed() -> None:
    page = BUILT["json"]()
    for result in (Account(), TuneResult.model_construct()):
        table = page.partition(f"### {type(result).__name__}\n")[2].partition("\n### ")[0]
        printed = result.model_json_schema(mode="serialization")["properties"]
        assert re.findall(r"^\| `(\w+)`", table, re.MULTILINE) == [*printed]
