"""The control step's own benchmark, and what it says of memory."""

import pytest

from benchmarks import cells, step
from benchmarks.sizes import Size, configuration, made_up
from lowfc.control import loop
from lowfc.programs.control_step import ControlStep
from lowfc.programs.frame_source import Payloads

SMALL = Size(32, 5, 10)


@pytest.fixture(autouse=True)
def in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process stays what it is."""
    nothing = step.set_up(None, None, lock_memory=False, stay_awake=False)
    monkeypatch.setattr(step, "set_up", lambda *_, **__: nothing)


def test_a_step_keeps_nothing_and_takes_no_more_than_the_frame_and_the_shapes() -> None:
    config = configuration(SMALL, step.RATE_HZ)
    calibration, frames = made_up(SMALL, config)
    found = step.allocated(ControlStep(config, calibration, 0), Payloads(frames))
    assert abs(found["kept_bytes"]) < 1
    assert 2 * SMALL.pixels < found["peak_bytes"] < 2 * SMALL.pixels + 5 * 4 * SMALL.actuators + 4096


def test_what_stays_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, original = [], loop.integrate
    monkeypatch.setattr(loop, "integrate", lambda *given: (kept.append(bytes(100)), original(*given))[1])
    config = configuration(SMALL, step.RATE_HZ)
    calibration, frames = made_up(SMALL, config)
    assert step.allocated(ControlStep(config, calibration, 0), Payloads(frames))["kept_bytes"] > 100


def test_the_stages_are_those_of_a_step_and_add_up() -> None:
    original = loop.limit
    found = step.measure(0.2)
    assert loop.limit is original
    lines = step.table(found)
    assert [line[0] for line in lines[1:]] == [*step.STAGES, step.REST, step.STEP, step.PRODUCT]
    assert all(float(cell) >= 0 for line in lines[1:] for cell in line[1:])
    assert found["over_product"]["hot_us"] == pytest.approx(
        found["hot_us"][step.STEP]["p50"] / found["hot_us"][step.PRODUCT]["p50"]
    )
    assert f"{found['over_product']['hot_us']:.1f} times" in step.remarks(found)
    assert len(cells.markdown(lines).splitlines()) == len(lines) + 1
