"""The site: `make docs` builds it without a warning; every page, and all that is declared, is in it."""

import subprocess
import sys
from html import unescape
from pathlib import Path

import pytest

from lowfc.client.requests import DECLARED
from lowfc.contract.configuration import keys
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import TOPICS
from lowfc.contract.wire import lowfc_pb2
from lowfc.programs.cli.main import COMMANDS, PARTS
from tools.advice import REASONS

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as `make docs` does it; a link that leads nowhere and a page in no index are warnings."""
    folder = tmp_path_factory.mktemp("site")
    words = ["-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", DOCS, folder]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_is_in_the_site(site: Path) -> None:
    for page in DOCS.rglob("*.md"):
        assert (site / page.relative_to(DOCS).with_suffix(".html")).is_file()


def test_all_that_is_declared_is_in_the_reference(site: Path) -> None:
    declared = {
        "reference/commands": [f"lowfc {row.name}" for row in (*sum(COMMANDS.values(), ()), *PARTS)],
        "reference/configuration": [*keys()],
        "reference/topics": [topic.key for topic in TOPICS],
        "reference/messages": [*lowfc_pb2.DESCRIPTOR.message_types_by_name],
        "reference/requests": [request.key for request in DECLARED],
        "howto/troubleshooting": [*EVENTS, *REASONS],
    }
    for page, words in declared.items():
        text = unescape((site / f"{page}.html").read_text())
        assert [word for word in words if word not in text] == []
