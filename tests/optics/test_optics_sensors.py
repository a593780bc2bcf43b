"""Images and responses of every sensor, compared with closed forms, independent propagators, finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from lowfc.adapters.files import factory
from lowfc.adapters.files.sensors import sensor_from, sensor_named
from lowfc.contract.errors import CalibrationError
from lowfc.contract.sections import SENSORS, SensorSection
from lowfc.optics.chain.band import Band, gauss_legendre, monochromatic, uniform
from lowfc.optics.chain.fourier import kernel, to_image
from lowfc.optics.chain.grid import image_axis
from lowfc.optics.chain.relay import ApertureMask, Defocus, PupilImage, direct_kernel, fresnel_distance
from lowfc.optics.chain.sensor import Sensor, field, image, light_budget, reference, response, shear_response
from lowfc.optics.detector.detector import Detector, expose
from tests.support.in_process_loop import configuration


def relative_l2(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.fixture(scope="module")
def opd_nm(modes, coefficients_nm):
    return np.tensordot(coefficients_nm[0], modes, 1)


def binned(intensity):
    return intensity.reshape(80, 2, 80, 2).sum(axis=(1, 3))


@pytest.mark.parametrize("wavelength_nm", [550.0, 500.0])
def test_the_image_agrees_with_hcipy(hcipy, sensor, opd_nm, wavelength_nm):
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
    expected = binned(np.abs(np.asarray(to_sensor.forward(relay).electric_field).reshape(160, 160)) ** 2)
    found = image(sensor, opd_nm, monochromatic(wavelength_nm))
    assert relative_l2(found, expected / (64 * np.pi / 4)) < 1e-12


def test_the_image_agrees_with_prysm(prysm, sensor, opd_nm):
    # The paper's Table 1 in prysm's units (mm, um). prysm has a sample on the axis: `ramp` shifts by half a sample.
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
    expected = binned(np.abs(at_sensor) ** 2)
    found = image(sensor, opd_nm)
    assert relative_l2(found / found.sum(), expected / expected.sum()) < 1e-12


@pytest.mark.parametrize("name", ["sam", "clowfs", "zwfs"])
def test_broadband_images_and_responses_are_weighted_sums(name, modes, opd_nm):
    optics, band = sensor_named(name), gauss_legendre(550.0, count=2)
    for quantity in (
        lambda one: image(optics, opd_nm, one),
        lambda one: response(optics, modes[:1], one),
        lambda one: shear_response(optics, one),
    ):
        each = [quantity(monochromatic(nm)) for nm in band.wavelengths_nm]
        np.testing.assert_allclose(quantity(band), np.tensordot(band.weights, each, 1), rtol=1e-12, atol=1e-15)


def test_three_gauss_legendre_wavelengths_are_more_accurate_than_the_papers_five(sensor):
    truth = reference(sensor, gauss_legendre(550.0, count=9))
    error_of_three = relative_l2(reference(sensor, gauss_legendre(550.0)), truth)
    error_of_five = relative_l2(reference(sensor, uniform(550.0)), truth)
    assert error_of_three < 2.5e-3
    assert error_of_five > 20 * error_of_three


def test_bands_have_the_wavelengths_of_section_3_3_of_the_paper():
    np.testing.assert_allclose(uniform(550.0).wavelengths_nm, [495, 522.5, 550, 577.5, 605])
    assert sum(gauss_legendre(550.0).weights) == pytest.approx(1)
    np.testing.assert_allclose(np.dot(gauss_legendre(550.0).wavelengths_nm, gauss_legendre(550.0).weights), 550)
    with pytest.raises(ValueError, match="sum to 1"):
        Band((550.0, 560.0), (0.5, 0.6))
    with pytest.raises(ValueError, match="one weight per wavelength"):
        Band((550.0,), ())


def test_throughput_is_the_product_of_the_elements(sensor, modes):
    budget = light_budget(sensor)
    assert budget.pupil == pytest.approx(0.2625, abs=1e-3)
    assert budget.focal_mask == pytest.approx(0.635, abs=1e-3)
    assert budget.sensor == pytest.approx(0.0574, rel=0.02)
    assert budget.sensor < budget.relay_mask
    assert budget.total == pytest.approx(budget.pupil * budget.focal_mask * budget.sensor)
    assert np.linalg.cond(response(sensor, modes[:14])) == pytest.approx(26.5, rel=0.03)


def test_the_bowtie_mask_is_open_also_above_and_below_the_centre(sensor):
    bowtie = sensor_named("bowtie").focal_mask
    assert sensor.focal_mask.shape == (64, 64)
    assert bowtie.shape == (160, 160)
    assert (bowtie[48:112, 48:112] >= sensor.focal_mask).all()
    assert bowtie[5, 80] == 1  # above the centre
    assert bowtie[80, 5] == 0  # left of it
    area = np.pi * 16 + np.pi * (100 - 16) * 2 * 95 / 360
    assert bowtie.sum() / 64 == pytest.approx(area, rel=0.01)


def test_cached_kernels_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        kernel(64, 8, 512, 1.0)[0, 0] = 0


def test_sensor_refuses_inconsistent_shapes(sensor):
    with pytest.raises(ValueError, match=r"\(512, 512\), got \(256, 256\)"):
        field(sensor, np.zeros((256, 256)))
    with pytest.raises(ValueError, match="sampled like the pupil"):
        Sensor(sensor.pupil, sensor.focal_mask, ApertureMask(np.ones((256, 256))))
    with pytest.raises(ValueError, match="must be square"):
        Sensor(sensor.pupil, np.ones((4, 6)), sensor.relay)
    with pytest.raises(ValueError, match="wavelength"):
        Sensor(sensor.pupil, sensor.focal_mask, sensor.relay, wavelength_nm=0.0)


def field_after_mask(optics, opd_nm, wavelength_nm):
    """Field after the focal-plane mask."""
    start = optics.pupil * np.exp(2j * np.pi / wavelength_nm * opd_nm)
    return to_image(start, len(optics.focal_mask), 8, 550.0 / wavelength_nm) * optics.focal_mask


def test_six_millimetres_are_3_4_waves_of_defocus():
    assert fresnel_distance(6.0, 20.0, 550.0) == pytest.approx(27.27, abs=0.01)
    assert fresnel_distance(6.0, 20.0, 550.0) / 8 == pytest.approx(3.41, abs=0.01)  # z / (8 lambda F^2), peak to valley


@pytest.mark.parametrize("wavelength_nm", [550.0, pytest.param(500.0, marks=pytest.mark.slow)])
def test_the_defocused_image_agrees_with_hcipy(hcipy, opd_nm, wavelength_nm):
    """Lengths are in lambda0/D, and the wavelength is small, so that hcipy's propagation is paraxial.

    hcipy's window is periodic, which changes the scale of the intensity by up to 1e-3.
    """
    optics = sensor_named("clowfs")
    samples, small_wavelength = 512, 1e-3
    grid = hcipy.make_uniform_grid([samples] * 2, [samples / 8] * 2)
    start = np.zeros((samples, samples), complex)
    start[224:288, 224:288] = field_after_mask(optics, opd_nm, wavelength_nm)
    free_space = hcipy.FresnelPropagator(grid, optics.relay.distance / small_wavelength)
    wave = hcipy.Wavefront(hcipy.Field(start.ravel(), grid), small_wavelength * wavelength_nm / 550.0)
    at_detector = np.asarray(free_space.forward(wave).electric_field).reshape(samples, samples)[176:336, 176:336]
    expected, found = np.abs(at_detector) ** 2, np.abs(field(optics, opd_nm, wavelength_nm)) ** 2
    scale = np.vdot(expected, found) / np.vdot(expected, expected)
    assert scale == pytest.approx(1, abs=1e-3)
    assert relative_l2(found, scale * expected) < 1e-3


@pytest.mark.parametrize("defocus_mm", [1.5, 6.0])
def test_defocused_image_agrees_with_a_quadratic_phase_in_the_relay_pupil(opd_nm, defocus_mm):
    """Expected: the Fresnel integral, by the angular spectrum over all frequencies that the samples resolve."""
    optics = sensor_from(SensorSection(kind="clowfs", defocus_mm=defocus_mm))
    x, u = image_axis(64, 8), image_axis(4096, 512)  # u: 8 D of the relay pupil's plane
    window = np.cos(np.clip((np.abs(u) - 3.0) * np.pi / 2, 0, np.pi / 2)) ** 2  # its rim sends no light to the detector
    transfer = window * np.exp(-1j * np.pi * optics.relay.distance * u**2)
    propagator = np.exp(2j * np.pi * np.outer(image_axis(160, 8), u)) * transfer @ np.exp(-2j * np.pi * np.outer(u, x))
    propagator /= 8 * 512
    expected = propagator @ field_after_mask(optics, opd_nm, 550.0) @ propagator.T
    assert relative_l2(field(optics, opd_nm, 550.0), expected) < 1e-3


@pytest.mark.parametrize("wavelength_nm", [550.0, 500.0])
def test_pupil_image_agrees_with_hcipy(hcipy, opd_nm, wavelength_nm):
    optics = sensor_named("zwfs")
    focal_grid = hcipy.CartesianGrid(hcipy.RegularCoords([1 / 8] * 2, [64] * 2, [-63 / 16] * 2))
    pitch = 1.1 / 80
    detector = hcipy.CartesianGrid(hcipy.RegularCoords([pitch] * 2, [80] * 2, [-79 / 2 * pitch] * 2))
    pupil_grid = hcipy.make_pupil_grid(512, 1.0)
    phase = 2 * np.pi / wavelength_nm * opd_nm
    start = hcipy.Field((optics.pupil * np.exp(1j * phase)).ravel(), pupil_grid)
    focal = hcipy.FraunhoferPropagator(pupil_grid, focal_grid).forward(hcipy.Wavefront(start, wavelength_nm / 550.0))
    focal.electric_field *= optics.focal_mask.ravel()
    at_detector = np.asarray(hcipy.FraunhoferPropagator(detector, focal_grid).backward(focal).electric_field)
    expected = np.abs(at_detector.reshape(80, 80)) ** 2 * optics.pitch**2 / (np.pi / 4)
    found = image(optics, opd_nm, monochromatic(wavelength_nm))
    assert relative_l2(found, expected.reshape(40, 2, 40, 2).sum(axis=(1, 3))) < 1e-12


def test_direct_kernels_conserve_energy():
    """A sampled focal plane gives a periodic image; over one period the columns of each kernel are orthonormal."""
    distance = 27.25  # the period, 8 times this distance, is an integer number of samples
    matrix = direct_kernel(Defocus(distance), 1744, 64, 8, 1.0)
    np.testing.assert_allclose(matrix.conj().T @ matrix, np.eye(64), atol=1e-12)
    for scale in (1.0, 1.1):
        matrix = direct_kernel(PupilImage(8.0 / scale), 512, 64, 8, scale)
        products = matrix.conj().T @ matrix * (8.0 / scale / 512) * 8  # the samples in the focal plane are 1/8 apart
        np.testing.assert_allclose(products, np.eye(64), atol=1e-12)


@pytest.mark.parametrize("name", ["clowfs", "zwfs"])
def test_without_relay_mask_light_is_lost_only_outside_the_detector(name):
    optics = sensor_named(name)
    budget = light_budget(optics)
    assert budget.relay_mask == 1
    relay = PupilImage(4.4) if name == "zwfs" else optics.relay
    wide = light_budget(replace(optics, pixels=160, relay=relay))
    assert max(budget.sensor, 0.985) < wide.sensor < 1


@pytest.mark.parametrize("name", SENSORS)
def test_response_of_every_sensor_is_the_derivative_of_its_image(name, modes):
    optics, step_nm = sensor_named(name), 0.02
    chosen = modes[[0, 5]] if name == "open" else modes[[0, 2, 9]]  # the open relay has no response to even modes
    H = response(optics, chosen)
    assert H.shape == (optics.pixels**2, len(chosen))
    for k, mode in enumerate(chosen):
        slope = (image(optics, step_nm * mode) - image(optics, -step_nm * mode)) / (2 * step_nm)
        assert relative_l2(H[:, k], slope.ravel()) < 1e-6


EIGHTH_ORDER = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}


def slope_along(shifted, step):
    """Derivative by an eighth-order central difference of `shifted` at -4 to 4 steps."""
    return sum(weight * (shifted(k) - shifted(-k)) for k, weight in EIGHTH_ORDER.items()) / step


@pytest.mark.parametrize("axis", [0, 1])
def test_shear_is_equivalent_to_moving_the_relay_mask_the_other_way(axis, sensor):
    def moved(samples):
        transmission = np.roll(sensor.relay.transmission, -samples, axis=1 - axis)
        return reference(replace(sensor, relay=ApertureMask(transmission))).ravel()

    assert relative_l2(shear_response(sensor)[:, axis], slope_along(moved, 1 / 512)) < 1e-4


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("name", ["clowfs", "zwfs"])
def test_shear_moves_the_image(name, axis):
    """An image of the pupil moves by the shear; behind focus the image is inverted and moves by -distance x shear."""
    fine = replace(sensor_named(name), pixels=160 if name == "clowfs" else 640, binning=1)
    moves_by = -fine.relay.distance if name == "clowfs" else 1.0
    I0 = reference(fine)
    slope = slope_along(lambda samples: np.roll(I0, samples, axis=1 - axis), fine.pitch / moves_by)
    inner = np.s_[8:-8, 8:-8]
    found = shear_response(fine)[:, axis].reshape(I0.shape)
    assert relative_l2(found[inner], slope[inner]) < 1e-4


@pytest.mark.parametrize("name", ["clowfs", "zwfs", "bar"])
def test_another_wavelength_is_equivalent_to_rescaled_optics(name):
    """At lambda = 1.25 lambda0 a sample of lambda0/8D is lambda/10D, and the same distance in mm is less defocus."""
    optics, longer_nm = sensor_named(name), 687.5
    found = reference(optics, monochromatic(longer_nm))
    relay = optics.relay
    if isinstance(relay, Defocus):
        relay = Defocus(relay.distance / 1.25)
    scaled = replace(optics, relay=relay, wavelength_nm=longer_nm, samples_per=10)
    np.testing.assert_allclose(found, reference(scaled), rtol=1e-9, atol=1e-15)


def test_the_papers_defocus_has_a_better_condition_number_than_a_third_of_it_or_twice_it(modes):
    def condition(defocus_mm):
        optics = sensor_from(SensorSection(kind="clowfs", defocus_mm=defocus_mm))
        return np.linalg.cond(response(optics, modes[:14]))

    assert condition(6.0) < 0.7 * min(condition(2.0), condition(12.0))


def test_unresolved_defocus_is_refused():
    optics = sensor_named("clowfs")
    with pytest.raises(ValueError, match=r"of at least 2.33 \(lambda/D\)\^2, got 2.3"):
        replace(optics, relay=Defocus(2.3))
    shortest = replace(optics, relay=Defocus(14 / 6))
    assert light_budget(shortest).sensor == pytest.approx(1, abs=0.01)  # no repeated image on the detector
    with pytest.raises(ValueError, match="behind the focal-plane mask"):
        Defocus(0.0)
    with pytest.raises(ValueError, match="must have a positive width"):
        PupilImage(0.0)


@pytest.mark.parametrize("name", ["sam", "bar", "lyot"])
def test_behind_an_aperture_mask_modal_responses_are_odd_but_image_and_shear_response_even(name, modes):
    """The focal-plane mask is real and symmetric: the field in the relay pupil is real, modes add imaginary parts."""
    optics = sensor_named(name)
    H, slopes = response(optics, modes[:14]), shear_response(optics)
    # Reversing the order of pixels is a point reflection through the centre.
    assert np.abs(H + H[::-1]).max() < 1e-9 * np.abs(H).max()
    assert np.abs(slopes - slopes[::-1]).max() < 1e-9 * np.abs(slopes).max()
    I0 = reference(optics).ravel()
    assert np.abs(I0 - I0[::-1]).max() < 1e-9 * I0.max()


def calibrated(**changed):
    """Calibration with a small mirror for these configuration keys, and noise of a frame (modes,), nm rms."""
    keys = {"mirror.rows": 12, "mirror.columns": 12, "mirror.pitches_per_pupil": 11.0}
    config = configuration(keys, **changed)
    optics = factory.twin(config, None, pytest.fail)
    calibration = factory.analytic_calibration(config, optics, factory.mirror_on_twin(config, optics, pytest.fail))
    return calibration, factory.frame_noise_nm(config, calibration)


@pytest.mark.parametrize(("name", "noise_factor"), [("clowfs", (3, 8)), ("zwfs", (1.2, 2))])
def test_fitting_shear_and_background_removes_their_bias(name, noise_factor):
    """Beam sheared by 0.002 D plus 10 % uniform light; the noise of tilt x, the mode most like shear, increases."""
    optics = sensor_named(name)
    ramp = np.exp(-2j * np.pi * 0.002 * image_axis(64, 8))
    sheared = reference(replace(optics, focal_mask=optics.focal_mask * ramp)).ravel()
    with_background = sheared + 0.1 * sheared.mean()

    def bias_nm(calibration, light):
        return np.linalg.norm(calibration.reconstructor @ (light / light.sum() - calibration.reference))

    plain, noise_nm = calibrated(sensor__kind=name)
    shear, shear_noise_nm = calibrated(sensor__kind=name, control__nuisance=["shear"])
    both, _ = calibrated(sensor__kind=name, control__nuisance=["background", "shear"])
    assert (plain.estimator, both.estimator) == ("weighted", "weighted+background+shear")
    assert bias_nm(plain, sheared) > 4.0
    assert bias_nm(shear, sheared) < 0.15
    assert bias_nm(shear, with_background) > 20 * bias_nm(both, with_background)
    assert bias_nm(both, with_background) < 0.15
    assert noise_factor[0] < shear_noise_nm[0] / noise_nm[0] < noise_factor[1]


def test_the_noise_of_a_frame_includes_rounding_to_whole_dn():
    calibration, noise_nm = calibrated(camera__gain_e_per_dn=4.0, star__magnitude=5.0)
    mean_e = np.tile(4.0 * calibration.flux_dn * calibration.reference, (100, 1))
    light = expose(Detector(gain_e_per_dn=4.0), mean_e, np.random.Generator(np.random.SFC64(1))) - calibration.dark
    modes_nm = (light / light.sum(axis=1, keepdims=True) - calibration.reference) @ calibration.reconstructor.T
    assert np.median(modes_nm.std(axis=0) / noise_nm) == pytest.approx(1, abs=0.1)


def test_saturating_star_and_no_light_are_refused():
    with pytest.raises(CalibrationError, match=r"the star saturates the sensor: \d+ e- in the brightest pixel"):
        calibrated(sensor__kind="zwfs", star__magnitude=-1.0)
    with pytest.raises(CalibrationError, match="the sensor saturates without light: a pixel has 60100 DN"):
        calibrated(camera__dark_current_e_s=3e7)
    with pytest.raises(CalibrationError, match="no light reaches the sensor"):
        calibrated(camera__exposure_fraction=1e-9)
    with pytest.raises(CalibrationError, match=r"no light reaches the sensor.*star\.diameter_m"):
        calibrated(star__diameter_m=1e-200)
