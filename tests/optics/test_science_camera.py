"""The fast science image against the exact one."""

import numpy as np
import pytest

from lowfc.adapters.files.sensors import load_pupil
from lowfc.optics.chain.coronagraph import Wedge, contrast, mean_contrast, wedge_samples
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.pupil import circle
from lowfc.optics.chain.science_camera import ScienceCamera
from lowfc.optics.chain.zernike import NOLLS_14, zernikes
from lowfc.optics.detector.photometry import tilt_nm_per_mas

NM = 550.0
RING = Wedge(4.0, 6.0)
HALF_WIDTH, SAMPLES_PER = 12, 3
TILT_NM = 14 * tilt_nm_per_mas(2.0)


@pytest.fixture(scope="module")
def shaped():
    return load_pupil()


@pytest.fixture(scope="module")
def modes():
    radii = 2 * pupil_axis(512)
    return zernikes(NOLLS_14, radii, radii[:, None])


@pytest.fixture(scope="module")
def camera(shaped):
    return ScienceCamera(shaped, NOLLS_14, NM, HALF_WIDTH, SAMPLES_PER)


def wavefront(**nm):
    """Modes (14,) by their names, Z<Noll index>."""
    return np.array([nm.get(f"Z{index}", 0.0) for index in NOLLS_14])


RANDOM = np.random.default_rng(5)
CASES = {
    "flat": wavefront(),
    "tilt of 14 mas": wavefront(Z2=TILT_NM, Z3=-TILT_NM),
    "focus and coma": wavefront(Z4=NM / 30, Z7=NM / 30),
    "1 nm each": RANDOM.normal(0, 1.0, 14),
    "5 nm each": RANDOM.normal(0, 5.0, 14),
    "20 nm each": RANDOM.normal(0, 20.0, 14),
}


@pytest.mark.parametrize("name", CASES)
def test_it_agrees_with_the_exact_image_to_a_hundredth(shaped, modes, camera, name):
    """Each sample to 1 % of itself and 1 % of the flat wavefront's contrast, the mean to 0.2 %."""
    opd_nm = np.tensordot(CASES[name], modes, 1)
    exact = contrast(shaped, opd_nm, NM, camera.samples, samples_per=SAMPLES_PER)
    found = camera.image(CASES[name])
    dark = wedge_samples(Wedge(4.0, HALF_WIDTH), camera.samples, camera.samples, SAMPLES_PER)
    np.testing.assert_allclose(found[dark], exact[dark], rtol=1e-2, atol=4e-12 + 1e-3 * exact[dark].mean())
    mean = mean_contrast(shaped, opd_nm, NM, RING, SAMPLES_PER)
    assert camera.mean_contrast(found, RING) == pytest.approx(mean, rel=2e-3)
    assert np.abs(found - exact).max() < 1e-3  # the star itself, too


def test_the_cases_span_what_a_night_can_bring(shaped, camera):
    means = [camera.mean_contrast(camera.image(case), RING) for case in CASES.values()]
    assert min(means) < 5e-10
    assert max(means) > 1e-5


def test_a_pupil_without_equal_squares_is_taken_as_it_is():
    pupil = circle(64)
    modes_nm = np.array([20.0, -35.0, 12.0])
    radii = 2 * pupil_axis(64)
    opd_nm = np.tensordot(modes_nm, zernikes((2, 5, 8), radii, radii[:, None]), 1)
    camera = ScienceCamera(pupil, (2, 5, 8), NM, 6, 4)
    np.testing.assert_allclose(camera.image(modes_nm), contrast(pupil, opd_nm, NM, 48), rtol=1e-4, atol=1e-7)


def test_what_does_not_fit_is_refused(shaped, camera):
    with pytest.raises(ValueError, match=r"14 modes, got shape \(3,\)"):
        camera.image(np.zeros(3))
    with pytest.raises(ValueError, match=r"ends 12 lambda/D"):
        camera.mean_contrast(camera.image(np.zeros(14)), Wedge(4.0, 20.0))
    with pytest.raises(ValueError, match="square"):
        ScienceCamera(shaped[:100], NOLLS_14, NM)
    with pytest.raises(ValueError, match="must have modes"):
        ScienceCamera(shaped, (), NM)
