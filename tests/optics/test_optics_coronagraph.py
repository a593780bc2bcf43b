"""Contrast of the science image, phase screens, and the fast science image compared with the exact one."""

import numpy as np
import pytest
from scipy.special import j0, j1

from lowfc.adapters.files.sensors import load_pupil
from lowfc.optics.chain.coronagraph import (
    DARK_ZONE,
    Coronagraph,
    LyotStop,
    Wedge,
    contrast,
    contrast_curve,
    mean_contrast,
    wedge_samples,
)
from lowfc.optics.chain.grid import image_axis, pupil_axis
from lowfc.optics.chain.pupil import circle
from lowfc.optics.chain.science_camera import ScienceCamera
from lowfc.optics.chain.screen import kolmogorov
from lowfc.optics.chain.zernike import NOLLS_14, zernikes
from lowfc.optics.detector.photometry import tilt_nm_per_mas

WAVELENGTH_NM = 550.0


@pytest.fixture(scope="module")
def coronagraph():
    return Coronagraph(load_pupil())


@pytest.fixture(scope="module")
def flat(coronagraph):
    return np.zeros(coronagraph.pupil.shape)


def test_open_circle_gives_an_airy_pattern():
    x = image_axis(64, 8)
    r = np.pi * np.hypot(x[:, None], x)
    found = contrast(Coronagraph(circle(512)), np.zeros((512, 512)), WAVELENGTH_NM, 64, samples_per=8)
    np.testing.assert_allclose(found, (2 * j1(r) / r) ** 2, atol=2e-4)  # the sampled circle has a staircase edge


def test_shaped_pupil_contrast_is_below_1e_9_in_its_dark_zone(coronagraph, flat):
    dark = wedge_samples(DARK_ZONE, 160, 160)
    image = contrast(coronagraph, flat, WAVELENGTH_NM, 160)
    assert image[dark].max() < 1e-9
    assert image[~dark].max() > 0.9
    fewer_rows = contrast(coronagraph, flat, WAVELENGTH_NM, 160, 108)
    np.testing.assert_allclose(fewer_rows, image[26:134], rtol=1e-9, atol=1e-16)  # the middle rows of the larger image


def test_a_tilt_shifts_the_image_of_the_star(coronagraph):
    ramp = WAVELENGTH_NM * (3.0 * pupil_axis(512) + 0.5 * pupil_axis(512)[:, None])  # 3 and 1/2 waves across the pupil
    image = contrast(coronagraph, ramp, WAVELENGTH_NM, 64)
    x = image_axis(64, 4)
    centred = contrast(coronagraph, np.zeros((512, 512)), WAVELENGTH_NM, 64)
    np.testing.assert_allclose(image[2:, 12:], centred[:-2, :-12], atol=1e-12)
    row, column = np.unravel_index(image.argmax(), image.shape)
    assert abs(x[column] - 3.0) <= 0.125
    assert abs(x[row] - 0.5) <= 0.125


def test_mean_contrast_and_curve_agree_with_the_full_image(coronagraph, flat, modes):
    ring = Wedge(4.5, 5.5)
    opd_nm = WAVELENGTH_NM / 30 * (modes[2] + modes[5])
    image = contrast(coronagraph, opd_nm, WAVELENGTH_NM, 160)
    mean = mean_contrast(coronagraph, opd_nm, WAVELENGTH_NM, ring)
    assert mean == pytest.approx(image[wedge_samples(ring, 160, 160)].mean(), rel=1e-9)
    edges = np.array([3.5, 4.5, 5.5, 6.5])
    curve = contrast_curve(coronagraph, opd_nm, WAVELENGTH_NM, edges)
    assert curve[1] == pytest.approx(mean, rel=1e-9)
    assert mean > 30 * mean_contrast(coronagraph, flat, WAVELENGTH_NM, ring)
    assert mean_contrast(coronagraph, opd_nm, WAVELENGTH_NM, ring, samples_per=2) == pytest.approx(mean, rel=0.05)


def test_wedge_has_the_area_of_its_formula():
    wedge = Wedge(4, 20, 42.5)
    inside = wedge_samples(wedge, 200, 200, 4)
    assert inside.sum() / 16 == pytest.approx((20**2 - 4**2) * np.deg2rad(2 * 42.5), rel=5e-3)
    np.testing.assert_array_equal(inside, inside[::-1, ::-1])
    for wrong in ({"inner": 5.0, "outer": 4.0}, {"half_opening_deg": 91.0}, {"inner": -1.0}):
        with pytest.raises(ValueError, match="a wedge needs"):
            Wedge(**wrong)


def test_wavefront_with_other_sampling_than_the_pupil_is_refused(coronagraph):
    with pytest.raises(ValueError, match=r"\(512, 512\), got \(64, 64\)"):
        contrast(coronagraph, np.zeros((64, 64)), WAVELENGTH_NM, 8)


def test_screens_have_the_structure_function_of_a_periodic_kolmogorov_screen():
    samples, width, separations = 128, 4, np.array([2, 4, 8, 16])
    found = np.zeros(separations.size)
    for i in range(24):
        screen = kolmogorov(np.random.default_rng([1, i]), samples, width)
        for k, shift in enumerate(separations):
            differences = [screen[shift:] - screen[:-shift], screen[:, shift:] - screen[:, :-shift]]
            found[k] += np.mean([np.mean(each**2) for each in differences]) / 24
    r = separations / samples
    # The screen has no power in the cell of zero frequency: the integral begins at the radius of a disk of that area.
    f = np.geomspace(1.0 / (width * np.sqrt(np.pi)), samples / 2, 4000)
    density = 0.0229 * f ** (-11 / 3) * 2 * np.pi * f
    expected = 2 * np.trapezoid(density * (1 - j0(2 * np.pi * r[:, None] * f)), f, axis=1)
    np.testing.assert_allclose(found, expected, rtol=0.08)
    assert np.all(expected < 6.88 * r ** (5 / 3))
    slope = np.polyfit(np.log(r), np.log(found), 1)[0]
    assert slope == pytest.approx(5 / 3, abs=0.1)
    with pytest.raises(ValueError, match="at least as wide"):
        kolmogorov(np.random.default_rng(1), 32, 0)


RING = Wedge(4.0, 6.0)
HALF_WIDTH, SAMPLES_PER = 12, 3
TILT_NM = 14 * tilt_nm_per_mas(2.0)


@pytest.fixture(scope="module")
def camera(coronagraph):
    return ScienceCamera(coronagraph, NOLLS_14, WAVELENGTH_NM, HALF_WIDTH, SAMPLES_PER)


def wavefront(**nm):
    """Modes (14,), nm rms, from keywords Z<Noll index>; the others are zero."""
    return np.array([nm.get(f"Z{index}", 0.0) for index in NOLLS_14])


RANDOM = np.random.default_rng(5)
CASES = {
    "flat": wavefront(),
    "tilt of 14 mas": wavefront(Z2=TILT_NM, Z3=-TILT_NM),
    "focus and coma": wavefront(Z4=WAVELENGTH_NM / 30, Z7=WAVELENGTH_NM / 30),
    "about 1 nm in each mode": RANDOM.normal(0, 1.0, 14),
    "about 5 nm in each mode": RANDOM.normal(0, 5.0, 14),
    "about 20 nm in each mode": RANDOM.normal(0, 20.0, 14),
}


@pytest.mark.parametrize("case", CASES)
def test_fast_science_image_agrees_with_the_exact_image_to_one_percent(coronagraph, modes, camera, case):
    """Tolerance: 1 % of the sample plus 0.1 % of the dark zone's mean plus 1 % of its mean with a flat wavefront."""
    opd_nm = np.tensordot(CASES[case], modes[:14], 1)
    exact = contrast(coronagraph, opd_nm, WAVELENGTH_NM, camera.samples, samples_per=SAMPLES_PER)
    found = camera.image(CASES[case])
    dark = wedge_samples(Wedge(4.0, HALF_WIDTH), camera.samples, camera.samples, SAMPLES_PER)
    np.testing.assert_allclose(found[dark], exact[dark], rtol=1e-2, atol=4e-12 + 1e-3 * exact[dark].mean())
    mean = mean_contrast(coronagraph, opd_nm, WAVELENGTH_NM, RING, SAMPLES_PER)
    assert camera.mean_contrast(found, RING) == pytest.approx(mean, rel=2e-3)
    assert np.abs(found - exact).max() < 1e-3  # in the whole image, the star's core included


def test_the_fast_image_of_a_pupil_without_2_x_2_blocks_agrees_with_the_exact_image():
    plain = Coronagraph(circle(64))
    modes_nm = np.array([20.0, -35.0, 12.0])
    radii = 2 * pupil_axis(64)
    opd_nm = np.tensordot(modes_nm, zernikes((2, 5, 8), radii, radii[:, None]), 1)
    camera = ScienceCamera(plain, (2, 5, 8), WAVELENGTH_NM, 6, 4)
    np.testing.assert_allclose(camera.image(modes_nm), contrast(plain, opd_nm, WAVELENGTH_NM, 48), rtol=1e-4, atol=1e-7)


def test_science_camera_refuses_inconsistent_inputs(coronagraph, camera):
    with pytest.raises(ValueError, match=r"14 modes, got shape \(3,\)"):
        camera.image(np.zeros(3))
    with pytest.raises(ValueError, match=r"ends 12 lambda/D"):
        camera.mean_contrast(camera.image(np.zeros(14)), Wedge(4.0, 20.0))
    with pytest.raises(ValueError, match="square"):
        ScienceCamera(Coronagraph(coronagraph.pupil[:100]), NOLLS_14, WAVELENGTH_NM)
    with pytest.raises(ValueError, match="must have modes"):
        ScienceCamera(coronagraph, (), WAVELENGTH_NM)
    behind_lyot = Coronagraph(np.ones((126, 126)), lyot=LyotStop(np.ones((8, 8)), np.ones((126, 126))))
    with pytest.raises(ValueError, match="multiple of 4 samples across, got 126"):
        ScienceCamera(behind_lyot, NOLLS_14, WAVELENGTH_NM)
