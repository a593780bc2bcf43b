"""Chaos cases on the real processes: two of them in CI, all of them, the stalls and a soak in the whole suite."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from lowfc.programs.reliability.chaos.cases import CASES
from tests.support.loops import LOWFC, run

pytestmark = pytest.mark.exclusive

QUICK = ("frames-random",)
STALLS = tuple(name for name in CASES if name.startswith("stall-"))
WAIT_S = 200


def chaos(folder: Path, *names: str, seed: int = 1) -> dict[str, Any]:
    words = [word for name in names for word in ("--case", name)]
    done = run(folder, "chaos", *words, "--seed", str(seed), "--keep", "kept", "--json", timeout_s=WAIT_S)
    figures: dict[str, Any] = json.loads(done.stdout)
    wrong = {row["name"]: row["findings"] for row in figures["cases"] if not row["passed"] and not row["skipped"]}
    assert not wrong, json.dumps(wrong, indent=1)
    assert done.returncode == 0
    return figures


@pytest.mark.parametrize("name", QUICK)
def test_a_case_passes_and_leaves_its_log(tmp_path: Path, name: str) -> None:
    (row,) = chaos(tmp_path, name)["cases"]
    (log,) = (tmp_path / "kept" / f"{name}-1").glob("*.mcap")
    assert log.stat().st_size > 1_000_000
    if name == "kill-controller":
        assert row["figures"]["restart_step_nm"] <= 100


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name not in (*QUICK, *STALLS)])
def test_every_other_case_passes(tmp_path: Path, name: str) -> None:
    (row,) = chaos(tmp_path, name, seed=2)["cases"]
    assert row["findings"] or row["skipped"]


@pytest.mark.slow
@pytest.mark.parametrize("name", STALLS)
def test_a_stall_is_compared_with_before_and_after(tmp_path: Path, name: str) -> None:
    (row,) = chaos(tmp_path, name)["cases"]
    assert set(row["figures"]["frame_to_command"]) == {"before", "during", "after"}
    assert row["figures"]["p99_during_over_calm"] > 0


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_half_an_hour_grows_and_loses_nothing(tmp_path: Path) -> None:
    done = subprocess.run(
        [*LOWFC, "soak", "--hours", "0.5", "--json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=2300,
        check=False,
    )
    figures = json.loads(done.stdout)
    assert figures["why"] == []
    assert done.returncode == 0
