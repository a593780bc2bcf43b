"""The loop with diffraction images, in one process: stability and convergence."""

from functools import partial

import numpy as np
import pytest

from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.stability import limiting_gain
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from tests.support.in_process_loop import SMALL_MIRROR, configuration, run_loop
from tools.law_bench import calibrated

QUIET = SMALL_MIRROR | {
    "camera.rate_hz": 1000,
    "disturbance.preset": "quiet",
    "control.start_mode": "closed",
    "mirror.settling_us": 0,
    "mirror.driver_bits": 24,
    "camera.noise": False,
    "camera.instants": 1,  # sufficient, as the disturbance is static
    "camera.gain_e_per_dn": 0.0008,  # small enough that rounding changes a mode by less than a picometre
    "camera.full_well_e": 52.0,
}
configured = partial(configuration, QUIET)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(configured())


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize(("factor", "stable"), [(0.99, True), (1.01, False)])
def test_the_limiting_gain_is_accurate_to_one_percent(
    delay: int, factor: float, stable: bool, calibration: Calibration
) -> None:
    """For a delay of d frames it is 2 sin(pi / (2 (2d - 1))). The images are noiseless, with a tilt below 1 mas."""
    gain = factor * 2 * np.sin(np.pi / (2 * (2 * delay - 1)))
    assert limiting_gain(delay) == pytest.approx(gain / factor, rel=1e-9)
    start_nm = 0.2 * tilt_nm_per_mas(2.0)
    config = configured(
        camera__delay_frames=delay, control__tilt_gain=gain, control__gain=0.0, disturbance__static_nm={"2": start_nm}
    )
    run = run_loop(config, 240, calibration)
    tilt = np.abs(run.residual_nm[:, 0])
    early, late = tilt[40:80].max(), tilt[-40:].max()
    assert tilt[:80].max() < tilt_nm_per_mas(2.0)
    assert (late < early) == stable


def test_a_kolmogorov_screen_is_corrected_up_to_the_controlled_modes() -> None:
    """The screen has 0.05 waves rms, as in case (3) of the paper, and more than a third of it in uncontrolled modes."""
    run = run_loop(configured(disturbance__preset="kolmogorov", control__gain=0.2, control__tilt_gain=0.3), 150)
    assert run.disturbance_rms_nm[-1] == pytest.approx(0.05 * 550, rel=1e-5)
    assert 0.35 < run.residual_rms_nm[-1] / run.disturbance_rms_nm[-1] < 0.6
    np.testing.assert_allclose(run.error_nm[-1], 0, atol=0.01)
