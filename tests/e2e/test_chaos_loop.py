"""Chaos cases on the real processes: one in every run of the tests; all of them, and a soak, with the slow tests."""

import json
from pathlib import Path

import pytest

from lowfc.programs.reliability.chaos.cases import CASES
from tests.support.loops import run

pytestmark = pytest.mark.exclusive

ALWAYS = "frames-random"
OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in CASES if name != ALWAYS]


@pytest.mark.parametrize("name", [ALWAYS, *OTHERS])
def test_a_case_passes_and_its_log_is_kept(tmp_path: Path, name: str) -> None:
    done = run(tmp_path, "chaos", "--case", name, "--seed", "2", "--keep", "kept", "--json", timeout_s=200)
    (row,) = json.loads(done.stdout)["cases"]
    assert row["passed"] or row["skipped"], json.dumps(row["findings"], indent=1)
    assert row["findings"] or row["skipped"]
    assert done.returncode == 0
    if not row["skipped"]:
        logs = (tmp_path / "kept" / f"{name}-2").glob("*.mcap*")  # .part after a full disk, several after other faults
        assert max(log.stat().st_size for log in logs) > 1_000_000
    if name.startswith("stall-") and not row["skipped"]:
        assert set(row["figures"]["frame_to_command"]) == {"before", "during", "after"}
        assert row["figures"]["p99_during_over_calm"] > 0


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_a_soak_of_half_an_hour_finds_no_growth_and_no_loss(tmp_path: Path) -> None:
    done = run(tmp_path, "soak", "--hours", "0.5", "--json", timeout_s=2300)
    assert json.loads(done.stdout)["why"] == []
    assert done.returncode == 0
