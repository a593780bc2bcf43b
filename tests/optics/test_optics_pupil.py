"""Grid conventions, Zernike modes, pupils and focal-plane masks, compared with closed forms and hcipy."""

import numpy as np
import pytest

from lowfc.adapters.files.sensors import load_pupil, sensor_from, sensor_named
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.sections import SensorSection
from lowfc.optics.chain.focal_mask import disk, phase_spot
from lowfc.optics.chain.fourier import to_image, to_pupil
from lowfc.optics.chain.grid import OPEN_AREA, SAMPLES, image_axis, pupil_axis
from lowfc.optics.chain.pupil import circle, circle_with_bar, from_quarter, prolate
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.chain.sensor import Sensor, image
from lowfc.optics.chain.zernike import mode_name, noll_to_orders, zernike


@pytest.mark.parametrize("scale", [1.0, 0.9, 1.1])
def test_relay_pupil_is_upright_and_energy_is_conserved(scale):
    u = pupil_axis(128)
    pupil = np.exp(-((u - 0.2) ** 2 + (u[:, None] + 0.1) ** 2) / 0.08**2).astype(complex)
    focal = to_image(pupil, 360, 8, scale)
    np.testing.assert_allclose(to_pupil(focal, 128, 8, scale), pupil, atol=1e-6)
    assert np.sum(np.abs(focal) ** 2) / 8**2 == pytest.approx(np.sum(np.abs(pupil) ** 2) / 128**2, rel=1e-9)


def test_image_is_normalised_to_the_light_in_the_open_circle():
    open_circle = Sensor(circle(512), np.ones((480, 480)), ApertureMask(np.ones((512, 512))))
    total = image(open_circle, np.zeros((512, 512))).sum()
    assert 0.97 < total < 1.0  # diffraction puts the rest outside the detector
    half = Sensor(0.5 * circle(512), np.ones((480, 480)), ApertureMask(np.ones((512, 512))))
    assert image(half, np.zeros((512, 512))).sum() == pytest.approx(0.25 * total)
    assert circle(512).mean() == pytest.approx(OPEN_AREA, rel=1e-3)


def test_a_quadrant_starts_at_the_centre_with_rows_along_y():
    quarter = np.zeros((2, 2))
    quarter[1, 0] = 1.0  # far from the centre in y, near in x
    expected = np.array([[0, 1, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 1, 1, 0]])
    np.testing.assert_array_equal(from_quarter(quarter, 4), expected)
    np.testing.assert_array_equal(from_quarter(quarter, 8), np.kron(expected, np.ones((2, 2))))


def test_every_mode_agrees_with_hcipy(hcipy):
    grid = hcipy.make_pupil_grid(128, 1.0)
    x, y = 2 * np.asarray(grid.x), 2 * np.asarray(grid.y)
    inside = np.hypot(x, y) <= 1
    for noll in range(1, 67):
        assert tuple(hcipy.noll_to_zernike(noll)) == noll_to_orders(noll)
        expected = np.asarray(hcipy.zernike_noll(noll, 1.0, grid))[inside]
        np.testing.assert_allclose(zernike(noll, x, y)[inside], expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_polynomials_continue_outside_the_circle():
    assert zernike(2, 3.0, 1.0) == pytest.approx(6.0)
    assert zernike(3, 3.0, 1.0) == pytest.approx(2.0)
    assert zernike(4, 2.0, 0.0) == pytest.approx(np.sqrt(3) * 7.0)
    assert zernike(11, 0.0, 2.0) == pytest.approx(np.sqrt(5) * (6 * 16 - 6 * 4 + 1))


def test_mode_names_differ_and_end_with_the_axis_of_the_mode():
    names = {noll: mode_name(noll) for noll in range(1, 30)}
    assert len(set(names.values())) == 29
    expected = {2: "tilt x", 3: "tilt y", 4: "focus", 7: "coma y", 8: "coma x", 11: "spherical"}
    assert expected.items() <= names.items()
    for noll in (noll for noll, name in names.items() if name.endswith(" x")):  # odd in x and even in y
        assert zernike(noll, -0.3, 0.2) == pytest.approx(-zernike(noll, 0.3, 0.2))
        assert zernike(noll, 0.3, -0.2) == pytest.approx(zernike(noll, 0.3, 0.2))


def test_noll_indices_below_one_are_refused():
    with pytest.raises(ValueError, match="start at 1"):
        zernike(0, 0.0, 0.0)


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 135.0, 300.0])
def test_bar_reaches_from_the_centre_to_the_edge_on_one_side(angle_deg):
    barred, angle = circle_with_bar(512, 0.1, angle_deg), np.deg2rad(angle_deg)

    def transmission(radius, across):
        x = radius * np.cos(angle) - across * np.sin(angle)
        y = radius * np.sin(angle) + across * np.cos(angle)
        return barred[int((y + 0.5) * 512), int((x + 0.5) * 512)]

    for radius in (0.02, 0.25, 0.48):
        assert transmission(radius, 0.0) == transmission(radius, 0.045) == transmission(radius, -0.045) == 0
        assert transmission(-radius, 0.0) == 1
    assert transmission(0.25, 0.055) == transmission(0.25, -0.055) == 1
    # The bar's area: a rectangle and the segment of the circle at its end.
    half_angle = np.arcsin(0.1)
    rectangle = 0.1 * 0.5 * np.cos(half_angle)
    segment = 0.25 * (half_angle - np.sin(half_angle) * np.cos(half_angle))
    assert (circle(512) - barred).mean() == pytest.approx(rectangle + segment, rel=0.02)


@pytest.fixture(scope="module")
def apodised():
    return prolate(256, 2.5)


def encircled(pupil, radius):
    """Fraction of a pupil's light within a radius (lambda/D) in the image plane, and the field within it."""
    samples_per = 32
    x = image_axis(2 * int(np.ceil(radius * samples_per)), samples_per)
    field = to_image(pupil.astype(complex), x.size, samples_per, 1.0) * (np.hypot(x[:, None], x) <= radius)
    return np.sum(np.abs(field) ** 2) / samples_per**2 / (np.sum(pupil**2) / pupil.size), field


def test_prolate_pupil_is_an_eigenfunction_of_the_mask(apodised):
    """The eigenvalue of the circular prolate function is the fraction of the light within the mask."""
    encircled_fraction, field = encircled(apodised, 2.5)
    back = to_pupil(field, 256, 32, 1.0)
    inside = circle(256) > 0
    assert np.abs(back[inside] - encircled_fraction * apodised[inside]).max() < 1e-3


def test_prolate_pupil_is_symmetric_and_has_the_throughput_of_a_gaussian(apodised):
    assert apodised.max() <= 1
    assert apodised[127:129, 127:129] == pytest.approx(1, abs=1e-3)
    assert not apodised[circle(256) == 0].any()
    np.testing.assert_allclose(apodised, apodised.T, atol=1e-12)
    np.testing.assert_allclose(apodised, apodised[::-1], atol=1e-12)
    # For large c = pi times the mask's radius, the pupil tends to exp(-c r^2 / 2), r in pupil radii: throughput 1 / c.
    assert np.sum(apodised**2) / np.sum(circle(256)) == pytest.approx(1 / (np.pi * 2.5), rel=0.1)
    with pytest.raises(ValueError, match="must be positive"):
        prolate(256, 0.0)


@pytest.mark.parametrize(("radius", "spot"), [(4.0, 1.06), (2.53, 2.0)])
def test_the_phase_spot_has_the_area_of_its_circle_and_a_soft_edge(radius, spot):
    mask, plain = phase_spot(8, radius, spot), disk(8, radius)
    np.testing.assert_array_equal(mask == 0, plain == 0)
    assert mask.imag.sum() / 64 == pytest.approx(np.pi * spot**2 / 4, rel=1e-3)
    r = np.hypot(image_axis(len(mask), 8)[:, None], image_axis(len(mask), 8))
    half_sample = np.sqrt(0.5) / 8
    np.testing.assert_array_equal(mask[r < spot / 2 - half_sample], 1j)
    np.testing.assert_array_equal(mask[(plain > 0) & (r > spot / 2 + half_sample)], 1)
    np.testing.assert_array_equal(mask, mask[::-1])
    np.testing.assert_array_equal(mask, mask.T)


def test_custom_pupil_is_read_from_a_file(tmp_path):
    quarter = np.linspace(1.0, 0.5, 64 * 64).reshape(64, 64) * circle(128)[64:, 64:]
    np.savez(tmp_path / "mine.npz", quarter=quarter)
    pupil = sensor_from(SensorSection(pupil=str(tmp_path / "mine.npz"))).pupil
    assert pupil.shape == (SAMPLES, SAMPLES)
    np.testing.assert_array_equal(pupil[256::4, 256::4], quarter)
    np.testing.assert_array_equal(pupil, pupil[::-1, ::-1])
    assert not np.array_equal(pupil, load_pupil())


def test_misspelt_sensor_name_gets_a_suggestion():
    with pytest.raises(ConfigurationError, match=r"unknown sensor 'clofws' .*'clowfs'.*layout is called"):
        sensor_named("clofws")
    with pytest.raises(ConfigurationError, match=r"unknown sensor 'mask'; sensors: sam, bow.*sam27d07"):
        sensor_named("mask")


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ({"pupil": "prolat"}, "did you mean 'prolate'"),
        ({"pupil": "prolate", "focal_radius": 7.5}, "at most 7 for a prolate pupil"),
        ({"kind": "clowfs", "inner_radius": 4.0}, r"inner_radius, 4\.0 lambda/D, must be below"),
        ({"kind": "clowfs", "inner_radius": 3.9999}, "thinner than the sampling"),
        ({"kind": "clowfs", "defocus_mm": 1.0, "focal_ratio": 100.0}, "increase the distance"),
        ({"kind": "clowfs", "inner_radius": 1.0, "focal_mask": "bowtie"}, "bowtie has neither"),
        ({"kind": "zwfs", "focal_mask": "bowtie"}, "bowtie has neither"),
        ({"kind": "zwfs", "spot_diameter": 0.01}, "0.01 lambda/D delays none or all"),
        ({"kind": "zwfs", "spot_diameter": 8.0, "focal_radius": 1.0}, "8.0 lambda/D delays none or all"),
    ],
)
def test_wrong_sensor_keys_are_refused(keys, complaint):
    with pytest.raises(ConfigurationError, match=complaint):
        sensor_from(SensorSection.model_validate(keys))
