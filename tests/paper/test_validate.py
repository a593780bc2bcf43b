"""`lowfc validate`: its rows against the committed ones, the paper's claims, and the command's output."""

import json
import sys
import threading
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import pytest

from lowfc.adapters.files.layouts import SHIPPED
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.programs.paper import commands, report
from lowfc.programs.paper.cases import DEFAULT_SAM, Case, Context, Row, plain, sparse_apertures
from lowfc.programs.paper.figures.aberration import REALISATIONS
from lowfc.programs.paper.figures.screens import SCREENS
from lowfc.programs.paper.report import (
    CASES,
    DOCUMENT,
    FIGURES,
    GLANCE,
    PICTURES,
    RESULTS,
    run,
    to_json,
    to_markdown,
    to_text,
    write_document,
)
from lowfc.programs.paper.tables import conditioning
from lowfc.programs.paper.tables.reconstruction import WITH_NUISANCES
from lowfc.programs.paper.tables.tables import TABLES
from tests.support.loops import json_of, lowfc, refusal

DOCS = Path(__file__).parents[2] / "docs" / "measured"
SAM = "sam27d07_bal14"
FEW_TRIALS = 4
RMS = "RMS residual, matched input"
ESTIMATORS = ("pinv", "weighted", "weighted + 1 iteration", "weighted + 2 iterations")
LIGHT = ("paper's electrons", "own photometry")


def key(row):
    return row["name"], row["modes"], row["estimator"], row["quantity"]


def find(table, name, quantity, modes=None, estimator=None):
    (row,) = [row for row in table["rows"] if key(row) == (name, modes, estimator, quantity)]
    return row


@pytest.fixture(scope="module")
def committed():
    return {table["table"]: table for table in json.loads((DOCS / RESULTS).read_text())["tables"]}


@pytest.fixture(scope="module")
def few():
    """Tables of one sensor: with a few trials, or without trials if the table has none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conditioning, "BARS", ((0.1, 45.0),))
        patch.setattr(conditioning, "HOLES", (0.09, 0.05))
        tables = run(
            ("table1", "table2", "table3", "table4", "photometry"), Context(FEW_TRIALS, jobs=2, sensors=(SAM,))
        )
        # The bars and holes of this table are aperture masks themselves; zwfs is a sensor of another kind.
        tables += run(["conditioning"], Context(FEW_TRIALS, jobs=2, sensors=("zwfs",)))
    return {table["table"]: table for table in tables}


def agree(measured, reference):
    """Assert that the values of two rows agree: to 1 %, or to five standard errors if they have one."""
    for column in ("paper", "predicted", "limit", "measured", "unit", "assumption"):
        found, expected = measured[column], reference[column]
        if not isinstance(expected, (int, float)):
            assert found == expected, (key(reference), column)
            continue
        if column == "measured" and reference["error"] is not None:
            # The committed standard error is of many trials; scale it to few.
            allowed = 5.0 * reference["error"] * (1.0 + reference["trials"] / measured["trials"]) ** 0.5
        elif expected > 1e12:  # singular: rounding errors
            allowed = float("inf") if found > 1e12 else 0.0
        else:
            size = 1.0 - expected if "R^2" in reference["quantity"] else abs(expected)  # R^2: distance from 1
            allowed = 0.01 * size + (1e-5 if reference["unit"] else 0.0)  # contrasts have no unit and are small
        assert found == pytest.approx(expected, abs=allowed), (key(reference), column)


def compare(found, committed):
    """Assert that each row of both tables agrees; return the keys of the rows that only one table has."""
    rows = {key(row): row | {"trials": found["trials"]} for row in found["rows"]}
    references = {key(row): row | {"trials": committed["trials"]} for row in committed["rows"]}
    assert len(rows) == len(found["rows"]), "two rows with the same key"
    for each in rows.keys() & references.keys():
        agree(rows[each], references[each])
    return rows.keys() ^ references.keys()


def test_the_document_is_rendered_from_its_results(committed):
    assert (DOCS / DOCUMENT).read_text() == to_markdown(list(committed.values()))
    assert tuple(committed) == commands.TABLES
    for table, name, modes, estimator, quantity in GLANCE:
        assert find(committed[table], name, quantity, modes, estimator)
    for table in committed.values():
        assert table["trials"] >= 100
        assert table["plot"] is None or (DOCS / "pictures" / "paper" / table["plot"]).is_file()


@pytest.mark.parametrize("name", ["table1", "photometry", "table2", "table3", "table4", "conditioning"])
def test_a_table_of_one_sensor_agrees_with_the_committed_one(few, committed, name):
    others = {each[0] for each in compare(few[name], committed[name])}
    own = {row["name"] for row in few[name]["rows"]} & {row["name"] for row in committed[name]["rows"]}
    # Table 3's input rows are named after the pupil's first sensor, which is not SAM in the complete table.
    assert others == {row["name"] for row in few[name]["rows"] + committed[name]["rows"]} - own
    assert (SAM in own) == (name in ("table2", "table3", "table4"))
    assert ("zwfs" in own) == (name in ("conditioning", "photometry"))


def test_the_committed_conditioning_confirms_section_4_of_the_paper(committed):
    condition = {
        row["name"]: row["measured"]
        for row in committed["conditioning"]["rows"]
        if row["quantity"] == "condition number" and row["modes"] == 14
    }
    assert condition["open"] > 1e12
    bars = [value for name, value in condition.items() if name.startswith("bar")]
    assert len(bars) == 6
    assert max(bars) < 1000
    assert condition[SAM] < 100
    assert min(bars) > 5 * condition[SAM]
    holes = [value for name, value in condition.items() if "holes of" in name and value is not None]
    assert len(holes) >= 4
    assert holes == sorted(holes, reverse=True)


def test_table3_of_few_wavefronts_is_better_than_the_paper(few):
    assert {row["estimator"] for row in few["table3"]["rows"]} == {None, *ESTIMATORS}
    for modes in (14, 20):
        pinv, weighted, _, iterated = (find(few["table3"], SAM, RMS, modes, estimator) for estimator in ESTIMATORS)
        assert pinv["measured"] < pinv["paper"]
        assert iterated["measured"] < weighted["measured"] < pinv["measured"]
        assert 0.5 * iterated["limit"] < iterated["measured"] < 1.5 * iterated["limit"]


def test_the_prediction_for_table4_is_better_than_the_paper(few):
    pinv, weighted = (
        find(few["table4"], SAM, "std of x tilt, 1 mas, paper's electrons", 2, kind) for kind in ("pinv", "weighted")
    )
    assert pinv["predicted"] < pinv["paper"] == 0.36
    assert weighted["predicted"] < 0.25
    assert weighted["limit"] <= weighted["predicted"] < 1.02 * weighted["limit"]


def test_the_papers_inconsistencies_are_computed(few):
    rows = [row for row in few["photometry"]["rows"] if row["name"].startswith("inconsistency")]
    assert {row["name"].split(":")[0] for row in rows} == {f"inconsistency {k}" for k in (1, 2, 3, 4)}
    by_quantity = {row["quantity"]: row for row in rows}
    tilt = by_quantity["largest P-V of 1 mas that Table 2's tilt allows"]
    assert tilt["measured"] < 0.6 * tilt["paper"]
    defocus = by_quantity["defocus at which the brightest pixel has 1.10 %"]
    assert 1.0 < defocus["measured"] < 1.6 < defocus["paper"] == 6.0
    for row in rows:
        if row["paper"] == 0.97:
            assert row["measured"] > 0.985


def test_the_command_prints_one_json_object():
    table = json_of("validate", "table1", "--trials", 7, "--seed", 3)
    assert (table["table"], table["trials"], table["seed"]) == ("table1", 7, 3)
    assert set(table["rows"][0]) >= {"name", "modes", "estimator", "quantity", "unit"}
    assert set(table["rows"][0]) >= {"paper", "measured", "error", "predicted", "limit", "assumption"}
    several = json_of("validate", "table2", "table1", "--sensor", SAM, "--sensor", SAM)
    assert [table["table"] for table in several["tables"]] == ["table1", "table2"]
    assert len({key(row) for row in several["tables"][1]["rows"]}) == len(several["tables"][1]["rows"])


def test_a_layout_of_a_file_is_compared_with_the_paper(tmp_path, few):
    (tmp_path / "mask.json").write_text(SHIPPED.read_text())
    (own,) = run(["table2"], Context(FEW_TRIALS, sensors=(f"{tmp_path}/mask.json:{SAM}",)))
    assert [row["paper"] for row in own["rows"]] == [row["paper"] for row in few["table2"]["rows"]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("tabel3",), "did you mean 'table3'"),
        (("table2", "--sensor", "sam27d07_bal15"), "did you mean"),
        (("table2", "--sensor", "clowfs:far"), "after the colon comes the defocus"),
        (("photometry", "--sensor", "nonsense"), "called 'nonsense'"),
        (("table3", "--sensor", "open", "--trials", "2"), "table3: sensor open, 14 modes: the sensor cannot tell"),
        (("fig5", "--sensor", "open", "--trials", "2"), "fig5: sensor open, 14 modes: the sensor cannot tell"),
        (("tolerance", "--sensor", "open"), "tolerance: sensor open, 14 modes: the sensor cannot tell"),
        (("table1", "--docs", "."), "use it with all"),
        (("all", "--docs", ".", "--sensor", "sam"), "use it with all"),
        (("tolerance", "table1", "--docs", "."), "--docs writes complete pages"),
        (("anchors", "--sensor", "sam", "--docs", "."), "--docs writes complete pages"),
    ],
)
def test_user_errors_are_one_line(arguments, message):
    error = refusal("validate", *arguments, kind=ConfigurationError)
    assert message in error
    assert "\n" not in error


def test_a_programming_error_is_not_reported_as_a_user_error(monkeypatch):
    monkeypatch.setitem(report.CASES, "table1", Case("broken", Mock(side_effect=ValueError("a fault"))))
    with pytest.raises(ValueError, match="a fault"):
        run(["table1"], Context())


def test_the_command_prints_a_table_and_warns_if_a_sensor_has_no_effect():
    warning = "the sensors are fixed, --sensor has no effect there"
    assert lowfc("validate", "table1", "--sensor", SAM).stderr.startswith(f"table1: {warning}\n")
    done = lowfc("validate", "table1")
    assert warning not in done.stderr
    assert "pupil diameters" in done.stdout
    assert "[1] The model uses focal lengths and diameters only by their ratio." in done.stdout
    assert warning not in lowfc("validate", "fig3", "--sensor", SAM).stderr


def test_missing_matplotlib_is_reported_before_computing(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(report.CASES, "table1", Case("never run", pytest.fail))
    with pytest.raises(ConfigurationError, match="matplotlib"):
        run(["table1"], Context(), tmp_path / "plots")
    assert list(tmp_path.iterdir()) == []


def test_docs_writes_document_results_and_pictures(monkeypatch, tmp_path):
    drawn = {
        name: Case("drawn", lambda context: [Row("a", "b", "", 1.0)], lambda context, path: path.write_bytes(b"new"))
        for name in CASES
    }
    for name, case in drawn.items():
        monkeypatch.setitem(report.CASES, name, case)
    assert lowfc("validate", "all", "--docs", tmp_path).exit_code == 0
    assert {path.name for path in tmp_path.iterdir()} == {DOCUMENT, RESULTS, PICTURES.partition("/")[0]}
    pictures = {path.stem for path in (tmp_path / PICTURES).iterdir()}
    assert pictures == set(CASES) - set(commands.ADDITIONAL) == set(commands.TABLES)


def test_an_unwritable_folder_is_a_user_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DataFileError, match="cannot be created"):
        run(["table1"], Context(), tmp_path / "file" / "plots")
    with pytest.raises(DataFileError, match="cannot be written"):
        write_document(tmp_path / "nowhere", [])


def test_rows_are_formatted_as_text_markdown_and_json():
    rows = [
        Row("sensor", "scatter", "mas", 0.123456, 0.36, 0.004, 0.12, 0.1, 2, "pinv", "Dim."),
        Row("a | b", "condition number", "", float("inf"), assumption="Dim."),
        Row("sensor", "electrons", "e-", 999.7, error=12.0),
    ]
    head = {"table": "table1", "title": "T", "trials": 9, "seed": 8, "plot": "t.png"}
    table = head | {"rows": [plain(row) for row in rows]}
    text, document = to_text(table), to_markdown([table])
    assert "0.123 ± 0.004" in text
    assert "1000 ± 10" in text
    assert text.count("Dim.") == 1
    assert "| a / b |  |  | condition number |  | inf |" in document
    assert "![T](pictures/paper/t.png)" in document
    assert json.loads(to_json([table])) == table
    assert json.loads(to_json([table, table])) == {"tables": [table, table]}


@pytest.mark.slow
def test_every_table_agrees_with_the_committed_one(committed):
    for table in run(tuple(TABLES), Context(20, jobs=2)):
        assert not compare(table, committed[table["table"]])


@pytest.mark.slow
def test_every_figure_agrees_with_the_committed_one(committed):
    for table in run(tuple(FIGURES), Context(10, jobs=2)):
        name, reference_table = table["table"], committed[table["table"]]
        for row, reference in zip(table["rows"], reference_table["rows"], strict=True):
            assert key(row) == key(reference), name
            tolerance = TOLERANCE.get((name, row["quantity"]))
            if tolerance is not None:
                assert abs(row["measured"] - reference["measured"]) < tolerance(reference["measured"]), (name, row)
                row, reference = row | {"measured": None}, reference | {"measured": None}
            if name == "fig9" and row["limit"] is not None:  # the best fit is a mean over the screens too
                assert row["limit"] == pytest.approx(reference["limit"], rel=0.2), row
                row, reference = row | {"limit": None}, reference | {"limit": None}
            agree(row | {"trials": 10}, reference | {"trials": FIGURE_DRAWS.get(name, reference_table["trials"])})


FIGURE_DRAWS = {"fig1": REALISATIONS, "fig7": REALISATIONS, "fig9": SCREENS}
"""Number of draws behind the committed standard errors of a figure, where it is below the number of trials."""


def _unexplained(coefficient):
    """Tolerance of an R^2 or a correlation: its scatter over ten wavefronts is half of 1 - coefficient."""
    return 5.0 * (1.0 - coefficient)


TOLERANCE = {
    ("fig5", "correlation"): _unexplained,
    **{("fig6", quantity): _unexplained for quantity in ("R^2", "least R^2", "mean R^2")},
    **{("fig9", quantity): lambda value: 0.2 * value for quantity in ("least residual rms", "largest residual rms")},
}
"""Tolerance of ten trials for values that depend on the draw and have no standard error."""


TABLE3 = {
    (SAM, "pinv"): (3.8e-4, 6.3e-4),
    (SAM, "weighted"): (3.0e-4, 5.2e-4),
    (SAM, "weighted + 2 iterations"): (2.1e-4, 3.9e-4),
    ("sam", "pinv"): (5.1e-4, 8.0e-4),
    ("bowtie", "pinv"): (4.6e-4, 6.8e-4),
    (f"bowtie:{DEFAULT_SAM}", "pinv"): (4.6e-4, 6.8e-4),
    ("clowfs", "pinv"): (1.3e-3, 2.3e-3),
}
"""Upper bounds of the rms residual of 14 and of 20 modes, waves, by sensor and estimator."""


@pytest.mark.parametrize(("name", "estimator"), TABLE3)
def test_the_committed_table3_is_better_than_the_paper(committed, name, estimator):
    for modes, largest in zip((14, 20), TABLE3[name, estimator], strict=True):
        assert find(committed["table3"], name, RMS, modes, estimator)["measured"] < largest


@pytest.mark.parametrize(("name", "light"), [*product(("sam", "sam27d10_bal14"), LIGHT), (SAM, LIGHT[0])])
def test_the_committed_table4_is_better_than_the_paper(committed, name, light):
    for mas, (kind, largest_mas) in product((1, 10), (("pinv", 0.36), ("weighted", 0.25))):
        row = find(committed["table4"], name, f"std of x tilt, {mas} mas, {light}", 2, kind)
        assert row["predicted"] < largest_mas, row
        assert row["measured"] < largest_mas + 2.0 * row["error"], row


@pytest.mark.parametrize(
    ("better", "worse", "modes", "estimator"),
    [
        ("sam", "clowfs", 14, "pinv"),  # stated in the document's introduction
        ("clowfs", "sam", 14, "weighted + 2 iterations"),
        *(("sam18_sized", "sam", modes, "pinv") for modes in (14, 20)),
        *(("bowtie", "sam", 14, estimator) for estimator in ESTIMATORS),
    ],
)
def test_one_sensor_is_better_than_another_in_the_committed_table3(committed, better, worse, modes, estimator):
    smaller, larger = (find(committed["table3"], name, RMS, modes, estimator)["measured"] for name in (better, worse))
    assert smaller < larger


def test_zernike_sensor_beats_sparse_apertures_and_sized_holes_beat_equal_ones_in_the_committed_table4(committed):
    def scatter(name, axis="x", kind="weighted"):
        return find(committed["table4"], name, f"std of {axis} tilt, 1 mas, {LIGHT[1]}", 2, kind)["predicted"]

    assert all(scatter("zwfs") < scatter(name) for name in sparse_apertures())
    for axis, kind in product("xy", ("pinv", "weighted")):
        assert scatter("sam18_sized", axis, kind) < scatter("sam", axis, kind)


def test_fitting_flux_and_shear_adds_noise_for_clowfs_but_not_for_sam(committed):
    """For sam, the image change of flux and shear is even and that of modes odd, so that fitting both adds no noise."""
    without_nuisances, with_nuisances = (
        {name: find(committed["table3"], name, RMS, 14, kind)["measured"] for name in ("sam", "clowfs")}
        for kind in ("weighted", WITH_NUISANCES)
    )
    assert with_nuisances["sam"] == pytest.approx(without_nuisances["sam"], rel=1e-6)
    assert with_nuisances["clowfs"] > 1.5 * without_nuisances["clowfs"]


def test_an_interruption_does_not_wait_for_running_items():
    released, ended = threading.Event(), []
    context = Context(jobs=2, progress=Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        context.map("", lambda index: index and (released.wait(30.0), ended.append(index)), range(2))
    assert not ended
    released.set()
