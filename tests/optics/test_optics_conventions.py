"""Each sentence of lowfc.optics.chain.grid, as a test."""

import numpy as np
import pytest

from lowfc.optics.chain.fourier import to_image, to_pupil
from lowfc.optics.chain.grid import OPEN_AREA, image_axis, pupil_axis
from lowfc.optics.chain.pupil import circle, from_quarter
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.chain.sensor import Sensor, image


def blob(samples, x0, y0, width=0.08):
    u = pupil_axis(samples)
    return np.exp(-((u - x0) ** 2 + (u[:, None] - y0) ** 2) / width**2).astype(complex)


def test_samples_lie_at_half_integer_offsets():
    np.testing.assert_allclose(pupil_axis(4), [-0.375, -0.125, 0.125, 0.375])
    np.testing.assert_allclose(image_axis(4, 8), np.array([-1.5, -0.5, 0.5, 1.5]) / 8)


def test_a_tilt_along_x_moves_the_star_along_columns_by_its_cycles():
    u = pupil_axis(256)
    tilted = circle(256) * np.exp(2j * np.pi * (3.0 * u - 1.5 * u[:, None]))
    intensity = np.abs(to_image(tilted, 128, 8, 1.0)) ** 2
    x = image_axis(128, 8)
    row, column = np.unravel_index(intensity.argmax(), intensity.shape)
    assert x[column] == pytest.approx(3.0, abs=1 / 8)
    assert x[row] == pytest.approx(-1.5, abs=1 / 8)


@pytest.mark.parametrize("scale", [1.0, 0.9, 1.1])
def test_the_relay_pupil_is_upright_and_energy_is_kept(scale):
    pupil = blob(128, 0.2, -0.1)
    focal = to_image(pupil, 360, 8, scale)
    np.testing.assert_allclose(to_pupil(focal, 128, 8, scale), pupil, atol=1e-6)
    assert np.sum(np.abs(focal) ** 2) / 8**2 == pytest.approx(np.sum(np.abs(pupil) ** 2) / 128**2, rel=1e-9)


def test_longer_waves_make_a_larger_image():
    x = image_axis(240, 8)
    focal = np.abs(to_image(blob(128, 0, 0), 240, 8, 1.0)) ** 2
    longer = np.abs(to_image(blob(128, 0, 0), 240, 8, 1 / 1.25)) ** 2
    widths = [np.sqrt((each.sum(axis=0) * x**2).sum() / each.sum()) for each in (focal, longer)]
    assert widths[1] / widths[0] == pytest.approx(1.25, rel=1e-6)


def test_an_image_is_the_fraction_of_the_light_in_the_open_circle():
    open_circle = Sensor(circle(512), np.ones((480, 480)), ApertureMask(np.ones((512, 512))))
    total = image(open_circle, np.zeros((512, 512))).sum()
    assert 0.97 < total < 1.0  # what diffraction throws beyond the pixels is missing
    half = Sensor(0.5 * circle(512), np.ones((480, 480)), ApertureMask(np.ones((512, 512))))
    assert image(half, np.zeros((512, 512))).sum() == pytest.approx(0.25 * total)
    assert circle(512).mean() == pytest.approx(OPEN_AREA, rel=1e-3)


def test_a_quadrant_starts_at_the_centre_with_rows_along_y():
    quarter = np.zeros((2, 2))
    quarter[1, 0] = 1.0  # y far, x near
    expected = np.array([[0, 1, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 1, 1, 0]])
    np.testing.assert_array_equal(from_quarter(quarter, 4), expected)
    np.testing.assert_array_equal(from_quarter(quarter, 8), np.kron(expected, np.ones((2, 2))))


@pytest.mark.parametrize(
    ("quarter", "samples", "message"),
    [
        (np.zeros((2, 3)), 4, "square"),
        (np.full((2, 2), 1.5), 4, "between 0 and 1"),
        (np.full((2, 2), np.nan), 4, "between 0 and 1"),
        (np.zeros((2, 2)), 6, "multiple of 4"),
    ],
)
def test_bad_quadrants_are_refused(quarter, samples, message):
    with pytest.raises(ValueError, match=message):
        from_quarter(quarter, samples)
