"""Automatic gains over the bus: closing the loop does no harm on bright or faint stars."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tools.no_harm import TOLERATED

COMMAND = "lowfc sim-loop --lockstep --rate 250 --duration 20 --disturbance bench --no-record --json"


@pytest.mark.slow
@pytest.mark.parametrize("magnitude", [0, 5, 8])
@pytest.mark.parametrize("sensor", ["sam", "zwfs"])
def test_closing_does_not_raise_the_contrast_of_the_dark_zone(sensor: str, magnitude: int, tmp_path: Path) -> None:
    words = [*COMMAND.split(), "--star-magnitude", str(magnitude), "--sensor", sensor]
    done = subprocess.run([sys.executable, "-m", *words], cwd=tmp_path, capture_output=True, text=True, timeout=230)
    assert not done.returncode, done.stderr
    results = json.loads(done.stdout)
    added = results["added_contrast"]
    assert results["closed_fraction"] > 0.85
    assert added["closed"] < added["open"] + TOLERATED * results["dark_zone_contrast"]
    if not magnitude:
        assert added["closed"] < 0.1 * added["open"]
