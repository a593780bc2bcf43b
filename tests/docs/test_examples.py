"""Example scripts on numerical code and on logs, run as in their docstrings; the names that the package exports."""

import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Function that runs an example in this process, with the arguments in its docstring, and returns its output."""

    def in_this_process(name: str, log: str = "") -> list[str]:
        script = ROOT / "examples" / f"{name}.py"
        (arguments,) = re.findall(rf"^Example: python examples/{name}.py (.*)$", script.read_text(), re.MULTILINE)
        monkeypatch.setattr(sys, "argv", [str(script), *(log or arguments).split()])
        runpy.run_path(str(script), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    return in_this_process


def test_the_photon_budget_of_a_fainter_star_has_less_light_and_more_tilt_noise(run: Callable[..., list[str]]) -> None:
    rows = [[float(word) for word in line.split()] for line in run("photon_budget")[2:]]
    (magnitude, light_e, tilt_mas, _), (faint_magnitude, faint_light_e, faint_tilt_mas, _) = rows
    assert (magnitude, faint_magnitude) == (2, 5)  # a factor of 10^(0.4 x 3) in light
    assert light_e / faint_light_e == pytest.approx(10**1.2, rel=0.02)
    assert 10**0.6 < faint_tilt_mas / tilt_mas < 10**1.2  # between photon noise alone and read noise alone


def test_in_the_loop_design_limiting_gains_agree_with_theory_and_residuals_grow_with_the_delay(
    run: Callable[..., list[str]],
) -> None:
    rows = [[float(word) for word in line.split()] for line in run("loop_design")[2:]]
    # The limiting gain with a delay d is 2 sin(pi / (2 (2d - 1))).
    assert [row[1] for row in rows if row[0] in (1, 2)] == [2, 1]
    residuals = [row[3] for row in rows]
    assert residuals == sorted(residuals)


def test_a_log_becomes_a_data_frame_with_a_column_for_each_mode(run: Callable[..., list[str]]) -> None:
    rows = [line.split() for line in run("log_to_pandas", str(ROOT / "tests/golden/0.1/night.mcap"))[1:]]
    assert [row[0] for row in rows] == [
        *(f"{name}_z{noll}_nm" for name in ("error", "pol", "command") for noll in (2, 3)),
        "flux_dn",
    ]
    assert rows[0][1] == "156.0"
    assert rows[-1][1] == "156.0", "the count excludes the 7 refused frames, whose flux is unknown"


def test_a_night_compared_with_itself_has_the_same_verdict_and_values(run: Callable[..., list[str]]) -> None:
    log = str(ROOT / "tests/golden/0.1/night.mcap")
    lines = run("compare_nights", f"{log} {log}")
    assert lines[:3] == ["verdict", "    Not a good run", "    Not a good run"]
    tilt = lines.index("Z2 tilt x, nm")
    assert float(lines[tilt + 1]) == float(lines[tilt + 2]) > 0


def test_the_package_imports_its_exported_names_on_first_use() -> None:
    script = (
        "import sys, lowfc; assert not [name for name in sys.modules if name.startswith('lowfc.')]\n"
        "assert {*lowfc.__all__} <= {*dir(lowfc)}\n"
        "print(*(getattr(lowfc, name).__name__ for name in lowfc.__all__))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    names = "Calibration Client Configuration LogReader load load read_history running"  # two modules have a load
    assert done.stdout.strip() == names
