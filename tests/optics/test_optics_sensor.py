import numpy as np
import pytest

from lowfc.adapters.files.sensors import load_pupil, sensor_named
from lowfc.optics.chain.band import Band, gauss_legendre, monochromatic, uniform
from lowfc.optics.chain.fourier import kernel
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.chain.sensor import Sensor, field, image, light_budget, reference, response


def relative_l2(ours, truth):
    return np.linalg.norm(ours - truth) / np.linalg.norm(truth)


@pytest.fixture(scope="module")
def opd_nm(modes, coefficients_nm):
    return np.tensordot(coefficients_nm[0], modes, 1)


def binned(intensity):
    return intensity.reshape(80, 2, 80, 2).sum(axis=(1, 3))


@pytest.mark.parametrize("wavelength_nm", [550.0, 500.0])
def test_the_chain_agrees_with_hcipy(hcipy, sensor, opd_nm, wavelength_nm):
    def focal_grid(samples):
        return hcipy.CartesianGrid(hcipy.RegularCoords([1 / 8, 1 / 8], [samples] * 2, [-(samples - 1) / 16] * 2))

    pupil_grid = hcipy.make_pupil_grid(512, 1.0)
    to_mask = hcipy.FraunhoferPropagator(pupil_grid, focal_grid(64), focal_length=1.0)
    to_sensor = hcipy.FraunhoferPropagator(pupil_grid, focal_grid(160), focal_length=1.0)
    phase = 2 * np.pi * opd_nm / wavelength_nm
    start = hcipy.Field((sensor.pupil * np.exp(1j * phase)).ravel(), pupil_grid)
    focal = to_mask.forward(hcipy.Wavefront(start, wavelength_nm / 550.0))
    focal.electric_field *= sensor.focal_mask.ravel()
    relay = to_mask.backward(focal)
    relay.electric_field *= sensor.relay.transmission.ravel()
    theirs = binned(np.abs(np.asarray(to_sensor.forward(relay).electric_field).reshape(160, 160)) ** 2)
    ours = image(sensor, opd_nm, monochromatic(wavelength_nm))
    assert relative_l2(ours, theirs / (64 * np.pi / 4)) < 1e-12


def test_the_chain_agrees_with_prysm(prysm, sensor, opd_nm):
    # Table 1 in prysm's units (mm and um); its grids have a sample on the axis, the ramps move that by half a sample.
    u = (np.arange(512) - 256) / 512
    ramp = np.exp(-2j * np.pi * (u + u[:, None]) / 16)
    pupil_mm, focal_mm, wavelength_um = 10.0, 200.0, 0.55
    step_um = wavelength_um * focal_mm / pupil_mm / 8
    optics = {"prop_dist": focal_mm, "wavelength": wavelength_um}
    start = sensor.pupil * np.exp(2j * np.pi / 550.0 * opd_nm)
    focal = prysm.focus_fixed_sampling(start * ramp, pupil_mm / 512, output_dx=step_um, output_samples=64, **optics)
    relay = prysm.unfocus_fixed_sampling(
        focal * sensor.focal_mask, step_um, output_dx=pupil_mm / 512, output_samples=512, **optics
    )
    at_sensor = prysm.focus_fixed_sampling(
        relay * sensor.relay.transmission, pupil_mm / 512, output_dx=step_um, output_samples=160, **optics
    )
    theirs = binned(np.abs(at_sensor) ** 2)
    ours = image(sensor, opd_nm)
    assert relative_l2(ours / ours.sum(), theirs / theirs.sum()) < 1e-12


def test_response_is_the_slope_of_the_image(sensor, modes):
    step_nm = 0.01
    H = response(sensor, modes)
    assert H.shape == (6400, 20)
    for k in (0, 1, 2, 5, 9, 19):
        slope = (image(sensor, step_nm * modes[k]) - image(sensor, -step_nm * modes[k])) / (2 * step_nm)
        assert relative_l2(H[:, k], slope.ravel()) < 1e-6


def test_broadband_images_and_responses_are_weighted_sums(sensor, modes, opd_nm):
    band = gauss_legendre(550.0)
    each = [monochromatic(nm) for nm in band.wavelengths_nm]
    images = sum(w * image(sensor, opd_nm, one) for w, one in zip(band.weights, each, strict=True))
    np.testing.assert_allclose(image(sensor, opd_nm, band), images, rtol=1e-12)
    slopes = sum(w * response(sensor, modes[:1], one) for w, one in zip(band.weights, each, strict=True))
    np.testing.assert_allclose(response(sensor, modes[:1], band), slopes, rtol=1e-12, atol=1e-20)


def test_three_gauss_legendre_wavelengths_beat_the_papers_five(sensor):
    truth = reference(sensor, gauss_legendre(550.0, count=9))
    three = relative_l2(reference(sensor, gauss_legendre(550.0)), truth)
    five = relative_l2(reference(sensor, uniform(550.0)), truth)
    assert three < 2.5e-3
    assert five > 20 * three


def test_bands_have_the_wavelengths_of_section_3_3():
    np.testing.assert_allclose(uniform(550.0).wavelengths_nm, [495, 522.5, 550, 577.5, 605])
    assert sum(gauss_legendre(550.0).weights) == pytest.approx(1)
    np.testing.assert_allclose(np.dot(gauss_legendre(550.0).wavelengths_nm, gauss_legendre(550.0).weights), 550)
    with pytest.raises(ValueError, match="sum to 1"):
        Band((550.0, 560.0), (0.5, 0.6))
    with pytest.raises(ValueError, match="one weight per wavelength"):
        Band((550.0,), ())


@pytest.mark.parametrize(
    ("sam", "sensor_fraction", "peak", "condition"),
    [
        ("sam27d07_bal14", 0.0288, 0.0039, 19),
        ("sam27d07", 0.0574, 0.0038, 26.5),
        ("sam27d10_bal14", 0.0994, 0.0069, 35.3),
        ("sam27_crb20", 0.152, 0.00446, 57.2),
    ],
)
def test_shipped_masks_pass_the_light_they_were_designed_for(sam, sensor_fraction, peak, condition, modes):
    sensor = sensor_named(sam)
    budget = light_budget(sensor)
    assert budget.pupil == pytest.approx(0.2625, abs=1e-3)
    assert budget.focal_mask == pytest.approx(0.635, abs=1e-3)
    assert budget.sensor == pytest.approx(sensor_fraction, rel=0.02)
    assert budget.peak == pytest.approx(peak, rel=0.02)
    assert budget.total == pytest.approx(budget.pupil * budget.focal_mask * budget.sensor)
    assert budget.sensor < budget.relay_mask
    assert np.linalg.cond(response(sensor, modes[:14])) == pytest.approx(condition, rel=0.03)


def test_the_shaped_pupil_is_dark_to_1e_9():
    pupil = load_pupil()
    x = np.arange(0.0, 20.01, 0.2)
    wave = np.exp(-2j * np.pi * np.outer(x, pupil_axis(512)))
    intensity = np.abs(wave @ pupil @ wave.T) ** 2 / pupil.sum() ** 2
    radius, angle = np.hypot(x[:, None], x), np.rad2deg(np.arctan2(x[:, None], x))
    dark = (radius >= 4) & (radius <= 20) & (angle <= 42.5)
    assert intensity[dark].max() < 1.0e-9
    assert intensity[(radius > 4) & (radius < 8) & (angle > 60)].max() > 1e-6  # the wedges along y are bright


def test_the_bowtie_adds_light_above_and_below(sensor):
    bowtie = sensor_named("bowtie").focal_mask
    assert sensor.focal_mask.shape == (64, 64)
    assert bowtie.shape == (160, 160)
    np.testing.assert_array_equal(bowtie[48:112, 48:112] >= sensor.focal_mask, True)
    assert bowtie[5, 80] == 1  # above the centre
    assert bowtie[80, 5] == 0  # left of it
    area = np.pi * 16 + np.pi * (100 - 16) * 2 * 95 / 360
    assert bowtie.sum() / 64 == pytest.approx(area, rel=0.01)


def test_kernels_are_shared_and_cannot_be_written():
    with pytest.raises(ValueError, match="read-only"):
        kernel(64, 8, 512, 1.0)[0, 0] = 0


def test_shapes_that_do_not_fit_are_refused(sensor):
    with pytest.raises(ValueError, match=r"\(512, 512\), got \(256, 256\)"):
        field(sensor, np.zeros((256, 256)))
    with pytest.raises(ValueError, match="sampled like the pupil"):
        Sensor(sensor.pupil, sensor.focal_mask, ApertureMask(np.ones((256, 256))))
    with pytest.raises(ValueError, match="must be square"):
        Sensor(sensor.pupil, np.ones((4, 6)), sensor.relay)
    with pytest.raises(ValueError, match="wavelength"):
        Sensor(sensor.pupil, sensor.focal_mask, sensor.relay, wavelength_nm=0.0)
