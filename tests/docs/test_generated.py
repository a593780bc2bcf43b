"""Generated parts of the documentation: each is what its measurement, or the code, makes of it."""

import re

import pytest

from tools.declared import DECLARED
from tools.measure import COMPOSED, COST_CURVES, MEASUREMENTS, PAGES, generated, measured


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_the_tables_as_they_are_now(page):
    assert page.read_text() == generated(page), "run `python -m tools.measure`"


def test_every_table_stands_in_one_page():
    found = [name for page in PAGES for name in re.findall(r'\[\[\[cog cog.out\(table\("(.*?)"\)\)', page.read_text())]
    assert sorted(found) == sorted([*MEASUREMENTS, *DECLARED, *COMPOSED])
    assert COST_CURVES.exists()


@pytest.mark.parametrize("name", MEASUREMENTS)
def test_what_was_measured_is_what_would_be_measured_now(name):
    figures, (commands, *_) = measured(name), MEASUREMENTS[name]
    if MEASUREMENTS[name].signed:
        said = figures.get("command", figures.get("command_line"))
        assert said is None or said.replace("benchmarks.", "benchmarks ").startswith(commands[0])
    else:
        assert figures["commands"] == [*commands]
