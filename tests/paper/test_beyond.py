"""The tables `tolerance` and `anchors`, which are not the paper's, and their pages."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lowfc.adapters.process.terminal import new_app
from lowfc.programs.paper.cases import Context, plain
from lowfc.programs.paper.commands import ADDITIONAL, validate
from lowfc.programs.paper.report import CASES, PICTURES, to_page, to_text
from lowfc.programs.paper.tables import anchors

DOCS = Path(__file__).parents[2] / "docs" / "measured"


def committed(name: str) -> dict:
    (table,) = json.loads((DOCS / f"{name}.json").read_text())["tables"]
    return table


@pytest.mark.parametrize("name", ADDITIONAL)
def test_the_page_is_rendered_from_its_json_file(name):
    table = committed(name)
    assert (DOCS / f"{name}.md").read_text() == to_page(table)
    assert (DOCS / PICTURES / f"{name}.png").is_file()
    assert table["seed"] == 1


def test_a_long_table_prints_selected_rows_and_agrees_with_simulation():
    table = committed("tolerance")
    assert all(CASES["tolerance"].in_text(row) for row in table["rows"])
    more = table | {
        "rows": [*table["rows"], table["rows"][0] | {"quantity": "drift of Z15 tetrafoil 45, V = 8, 1e-09"}]
    }
    assert f"{len(table['rows'])} of {len(more['rows'])} rows" in to_text(more)
    checked = [row for row in table["rows"] if "at its tolerance" in row["quantity"]]
    assert len(checked) == 12
    for row in checked:
        assert row["measured"] == pytest.approx(row["predicted"], rel=0.1)
    for row in table["rows"]:
        if row["limit"] is not None:  # the largest tolerance of any sensor of this light
            assert row["measured"] <= 1.0001 * row["limit"]


def test_every_anchor_has_a_verdict_and_no_noise_is_below_the_quantum_limit():
    rows = committed("anchors")["rows"]
    verdicts = [row for row in rows if row["quantity"].startswith("verdict")]
    published = [row for row in rows if row["paper"] is not None]
    assert len(verdicts) >= len(published) > 10
    assert {row["measured"] for row in verdicts} <= {anchors.REACHED, anchors.NOT_REACHED}
    for row in rows:
        if row["limit"] is not None and row["error"] is None and row["unit"] != "mas":  # computed, without scatter
            assert row["measured"] >= row["limit"]


def test_docs_is_refused_for_parts_of_a_page(tmp_path):
    app = new_app("Test.")
    app.command("validate")(validate)
    app.command("other")(lambda: None)
    for words in (["tolerance", "table1"], ["anchors", "--sensor", "sam"]):
        ran = CliRunner().invoke(app, ["validate", *words, "--docs", str(tmp_path)])
        assert ran.exit_code
        assert "--docs writes complete pages" in str(ran.exception)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_another_seed_gives_the_same_verdicts():
    def verdicts(rows):
        return {
            (row["name"], row["quantity"]): row["measured"] for row in rows if row["quantity"].startswith("verdict")
        }

    found = verdicts(map(plain, anchors.anchors(Context(trials=100, seed=2))))
    assert found == verdicts(committed("anchors")["rows"])
