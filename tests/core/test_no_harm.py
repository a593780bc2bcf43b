"""Automatic gains over the bus: closing the loop does no harm on bright or faint stars."""

import contextlib
from pathlib import Path
from unittest.mock import Mock

import pytest

from lowfc.contract.errors import CalibrationError
from tests.support.loops import loop
from tools import no_harm
from tools.no_harm import TOLERATED

OPTIONS = "--lockstep --rate 250 --duration 20 --disturbance bench --no-record"


@pytest.mark.parametrize(("why", "is_result"), [("the star saturates the sensor: ...", True), ("no light", False)])
def test_a_star_that_saturates_the_sensor_is_a_result_and_other_errors_are_raised(
    why: str, is_result: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(no_harm, "_noise_nm2", Mock(side_effect=CalibrationError(why)))
    with contextlib.nullcontext() if is_result else pytest.raises(CalibrationError, match=why):
        assert no_harm.modal_case(("sam", "bench", 0))["saturates"] == why


@pytest.mark.slow
@pytest.mark.parametrize("magnitude", [0, 5, 8])
@pytest.mark.parametrize("sensor", ["sam", "zwfs"])
def test_closing_does_not_raise_the_contrast_of_the_dark_zone(sensor: str, magnitude: int, tmp_path: Path) -> None:
    options = [*OPTIONS.split(), "--star-magnitude", str(magnitude), "--sensor", sensor]
    results = loop(tmp_path, *options, timeout_s=230)
    added = results["added_contrast"]
    assert results["closed_fraction"] > 0.85
    assert added["closed"] < added["open"] + TOLERATED * results["dark_zone_contrast"]
    if not magnitude:
        assert added["closed"] < 0.1 * added["open"]
