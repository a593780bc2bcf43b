"""Automatic gains over the bus: closing the loop does no harm on bright or faint stars."""

from pathlib import Path

import pytest

from tests.support.loops import loop
from tools.no_harm import TOLERATED

OPTIONS = "--lockstep --rate 250 --duration 20 --disturbance bench --no-record"


@pytest.mark.slow
@pytest.mark.parametrize("magnitude", [0, 5, 8])
@pytest.mark.parametrize("sensor", ["sam", "zwfs"])
def test_closing_does_not_raise_the_contrast_of_the_dark_zone(sensor: str, magnitude: int, tmp_path: Path) -> None:
    words = [*OPTIONS.split(), "--star-magnitude", str(magnitude), "--sensor", sensor]
    results = loop(tmp_path, *words, timeout_s=230)
    added = results["added_contrast"]
    assert results["closed_fraction"] > 0.85
    assert added["closed"] < added["open"] + TOLERATED * results["dark_zone_contrast"]
    if not magnitude:
        assert added["closed"] < 0.1 * added["open"]
