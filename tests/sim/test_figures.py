"""The camera's figures of a run of unknown length."""

import numpy as np
import pytest

from sim_camera.bench import Truth
from sim_camera.figures import BLOCK, MOST_BLOCKS, Figures

NOLL = (2, 3, 4)


def truth(residual_nm: float) -> Truth:
    modes = np.full(len(NOLL), residual_nm, np.float32)
    return Truth(2 * modes, modes, 2 * residual_nm, residual_nm)


@pytest.mark.parametrize("blocks", [2, MOST_BLOCKS - 1, MOST_BLOCKS, MOST_BLOCKS + 2, 2 * MOST_BLOCKS + 4])
def test_they_are_those_of_the_second_half_however_long_it_was(monkeypatch: pytest.MonkeyPatch, blocks: int) -> None:
    monkeypatch.setattr("sim_camera.figures.BLOCK", 2)
    figures, half = Figures(NOLL, 1.0), blocks // 2 * 2
    for number in range(2 * blocks):
        figures.add(truth(5.0 if number < half else 3.0))
    found = figures.wavefront()
    assert found is not None
    assert found.residual_rms_nm == pytest.approx(3.0, rel=0.05)
    assert found.tilt_disturbance_mas == pytest.approx(6.0, rel=0.05)
    assert len(figures._blocks) < MOST_BLOCKS


def test_before_the_first_block_they_are_those_of_what_there_is() -> None:
    figures = Figures(NOLL, 1.0)
    assert figures.wavefront() is None
    for _ in range(BLOCK // 2):
        figures.add(truth(4.0))
    found = figures.wavefront()
    assert found is not None
    assert found.residual_rms_nm == pytest.approx(4.0)


def test_the_recent_ones_forget_what_was_before() -> None:
    figures = Figures(NOLL, 1.0, recent=100)
    assert figures.recent() is None
    for residual_nm, frames in ((50.0, BLOCK), (2.0, 100)):
        for _ in range(frames):
            figures.add(truth(residual_nm))
        found = figures.recent()
        assert found is not None
        assert found.residual_rms_nm == pytest.approx(residual_nm)
        assert found.tilt_disturbance_mas == pytest.approx(2 * residual_nm)
    whole = figures.wavefront()
    assert whole is not None
    assert whole.residual_rms_nm > 40.0, "of the whole run's second half"
