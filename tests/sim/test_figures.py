"""The camera's figures of a run of unknown length."""

import numpy as np
import pytest

from sim_camera.bench import Truth
from sim_camera.figures import BLOCK, MOST_BLOCKS, Figures, Wavefront

NOLL = (2, 3, 4)


def figures(*residuals_nm: float, nm_per_mas: float = 1.0, recent: int = 1) -> Figures:
    """Of frames with this residual in every mode and over the pupil, and twice the disturbance."""
    found = Figures(NOLL, nm_per_mas, recent)
    for residual_nm in residuals_nm:
        modes = np.full(len(NOLL), residual_nm, np.float32)
        found.add(Truth(2 * modes, modes, 2 * residual_nm, residual_nm))
    return found


@pytest.mark.parametrize("blocks", [2, MOST_BLOCKS - 1, MOST_BLOCKS, MOST_BLOCKS + 2, 2 * MOST_BLOCKS + 4])
def test_they_are_those_of_the_second_half_however_long_it_was(monkeypatch: pytest.MonkeyPatch, blocks: int) -> None:
    monkeypatch.setattr("sim_camera.figures.BLOCK", 2)
    half = blocks // 2 * 2
    run = figures(*[5.0] * half, *[3.0] * (2 * blocks - half))
    found = run.wavefront()
    assert (found.residual_rms_nm, found.tilt_disturbance_mas) == pytest.approx((3.0, 6.0), rel=0.05)
    assert len(run._blocks) < MOST_BLOCKS


def test_before_the_first_block_they_are_those_of_what_there_is() -> None:
    assert figures().wavefront() is None
    found = figures(*[3.0, 5.0] * (BLOCK // 4), nm_per_mas=2.0).wavefront()
    assert found is not None
    rms_nm = np.sqrt(17)
    assert found == Wavefront(*(pytest.approx(value * rms_nm) for value in (2, 1, 1, 0.5))), "tilts per axis"


def test_the_recent_ones_forget_what_was_before() -> None:
    assert figures(recent=100).recent() is None
    run = figures(*[50.0] * BLOCK, *[2.0] * 100, recent=100)
    found, whole = run.recent(), run.wavefront()
    assert (found.residual_rms_nm, found.tilt_disturbance_mas) == pytest.approx((2.0, 4.0))
    assert whole.residual_rms_nm > 40.0, "of the whole run's second half"
