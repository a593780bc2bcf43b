"""Generated tables of the documentation agree with the stored measurements and the code."""

import re

import pytest

from tools.declared import DECLARED
from tools.measure import COMPOSED, COST_CURVES, MEASUREMENTS, PAGES, generated, measured


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_tables_of_a_page_are_up_to_date(page):
    assert page.read_text() == generated(page), "run `python -m tools.measure`"


def test_every_table_is_on_exactly_one_page():
    found = [name for page in PAGES for name in re.findall(r'\[\[\[cog cog.out\(table\("(.*?)"\)\)', page.read_text())]
    assert sorted(found) == sorted([*MEASUREMENTS, *DECLARED, *COMPOSED])
    assert COST_CURVES.exists()


@pytest.mark.parametrize("name", MEASUREMENTS)
def test_stored_measurements_were_made_by_the_current_commands(name):
    results, (commands, *_) = measured(name), MEASUREMENTS[name]
    if MEASUREMENTS[name].has_provenance:
        assert results["command"].startswith(commands[0])
    else:
        assert results["commands"] == [*commands]
