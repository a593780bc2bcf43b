"""R from I0 and H: normalisation, unbiasedness, least noise; the geometry of a sensor from its image."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lowfc.control.calibration.alignment import Geometry, align, onto
from lowfc.control.calibration.calibration import (
    ESTIMATORS,
    condition_number,
    for_unnormalised_images,
    noise_nm,
    normalise_flux,
    reconstructor,
)
from lowfc.control.loop.estimator import Estimator, difference, saturated_pixels
from tests.support.toy import TOY, calibration

PIXELS = TOY.reference.size
RESPONSE = TOY.response + 0.001 * np.outer(TOY.reference, [1, -2, 3])  # modes that also change the flux
GOOD = np.ones(PIXELS)
SOME_BAD = GOOD.copy()  # with three bad pixels
SOME_BAD[[3, 17, 30]] = 0
I0, H = normalise_flux(TOY.reference, RESPONSE, GOOD)


@pytest.mark.parametrize("good", [GOOD, SOME_BAD])
def test_the_normalised_response_is_the_derivative_of_the_normalised_image(good: np.ndarray) -> None:
    I0, H = normalise_flux(TOY.reference, RESPONSE, good)
    assert I0 @ good == pytest.approx(1, abs=1e-12)

    def normalised(modes_nm: np.ndarray) -> np.ndarray:
        image = TOY.reference + RESPONSE @ modes_nm
        return image / (image @ good)

    for mode in range(RESPONSE.shape[1]):
        poke = 1e-4 * np.eye(RESPONSE.shape[1])[mode]
        numerical = (normalised(poke) - normalised(-poke)) / 2e-4
        assert np.abs(numerical - H[:, mode]).max() < 1e-9 * np.abs(H).max()


def test_an_image_without_light_cannot_be_normalised() -> None:
    with pytest.raises(ValueError, match="no light"):
        normalise_flux(np.zeros(PIXELS), RESPONSE, GOOD)
    with pytest.raises(ValueError, match="no light"):
        for_unnormalised_images(RESPONSE.T, np.zeros(PIXELS), GOOD)


def test_a_reconstructor_for_images_not_divided_by_their_flux_measures_the_same_modes() -> None:
    I0, H = normalise_flux(TOY.reference, RESPONSE, SOME_BAD)
    R = reconstructor(I0, H, SOME_BAD, 1e5, 2.0)
    np.testing.assert_allclose(for_unnormalised_images(R, TOY.reference, SOME_BAD) @ RESPONSE, R @ H, atol=1e-12)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("good", [GOOD, SOME_BAD])
def test_modes_are_recovered_exactly_without_noise(estimator: str, good: np.ndarray) -> None:
    I0, H = normalise_flux(TOY.reference, RESPONSE, good)
    R = reconstructor(I0, H, good, 1e5, 2.0, estimator)
    assert np.abs(R @ H - np.eye(3)).max() < 1e-10
    assert not R[:, good == 0].any()


def test_r_of_pinv_is_numpys_pseudo_inverse_of_h_and_r_of_weighted_is_not() -> None:
    assert np.allclose(reconstructor(I0, H, GOOD, 1e5, 2.0, "pinv"), np.linalg.pinv(H), rtol=1e-9)
    assert not np.allclose(reconstructor(I0, H, GOOD, 1e5, 2.0), np.linalg.pinv(H), rtol=1e-3)


def cramer_rao(flux_e: float, read_noise_e: float) -> np.ndarray:
    """Cramer-Rao bound (modes, modes), nm^2, of modes fitted with the flux, for Gaussian noise of known variance."""
    image_e = flux_e * TOY.reference / TOY.reference.sum()
    design = np.column_stack([flux_e * RESPONSE / TOY.reference.sum(), image_e])
    information = design.T @ (design / (image_e + read_noise_e**2)[:, None])
    return np.linalg.inv(information)[:3, :3]


@pytest.mark.parametrize(("flux_e", "read_noise_e", "limit"), [(1e5, 0.0, 1 + 1e-9), (1e4, 5.0, 1.01)])
def test_the_weighted_estimator_reaches_the_cramer_rao_bound(flux_e: float, read_noise_e: float, limit: float) -> None:
    """With photon noise alone its variance equals the bound; with read noise it is at most one percent larger."""
    R = reconstructor(I0, H, GOOD, flux_e, read_noise_e)
    ratio = noise_nm(R, I0, flux_e, read_noise_e) ** 2 / np.diag(cramer_rao(flux_e, read_noise_e))
    assert (ratio >= 1 - 1e-9).all()
    assert (ratio <= limit).all()


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_predicted_noise_agrees_with_a_monte_carlo_simulation(estimator: str) -> None:
    flux_e, read_noise_e, trials = 50_000.0, 3.0, 4000
    I0, H = normalise_flux(TOY.reference, RESPONSE, SOME_BAD)
    R = reconstructor(I0, H, SOME_BAD, flux_e, read_noise_e, estimator)
    rng = np.random.default_rng(5)
    frames = rng.poisson(flux_e * I0, (trials, PIXELS)) + read_noise_e * rng.standard_normal((trials, PIXELS))
    errors = (frames / (frames @ SOME_BAD)[:, None] - I0) @ R.T
    predicted = noise_nm(R, I0, flux_e, read_noise_e)
    # The relative error of a standard deviation from these trials is 1 / sqrt(2 trials); four times that is 4.5 %.
    assert np.abs(errors.std(axis=0) / predicted - 1).max() < 4 / np.sqrt(2 * trials)


@pytest.mark.parametrize(
    "response",
    [
        np.column_stack([RESPONSE[:, 0], RESPONSE[:, 0]]),
        np.column_stack([RESPONSE[:, 0], np.zeros(PIXELS)]),
        np.column_stack([RESPONSE[:, 0], RESPONSE[:, 0] * (1 + 1e-10)]),
    ],
)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_sensor_that_cannot_tell_modes_apart_is_refused(response: np.ndarray, estimator: str) -> None:
    I0, H = normalise_flux(TOY.reference, response, GOOD)
    with pytest.raises(ValueError, match="cannot tell the modes apart"):
        reconstructor(I0, H, GOOD, 1e5, 1.0, estimator)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e12])
def test_fitted_nuisance_parameters_are_not_measured_as_modes_whatever_their_unit(estimator: str, unit: float) -> None:
    ramp = np.linspace(-1, 1, PIXELS)
    background = np.column_stack([np.ones(PIXELS), TOY.reference * ramp])
    nuisance_response = normalise_flux(TOY.reference, background, GOOD)[1]
    R = reconstructor(I0, H, GOOD, 1e5, 2.0, estimator, unit * nuisance_response)
    assert R.shape == (3, PIXELS)
    assert np.abs(R @ H - np.eye(3)).max() < 1e-9
    assert np.abs(R @ nuisance_response).max() < 1e-9 * np.abs(R).max()
    without_fit = reconstructor(I0, H, GOOD, 1e5, 2.0, estimator)
    assert np.abs(without_fit @ nuisance_response).max() > 1e-3 * np.abs(without_fit).max()
    if estimator == "weighted":  # fitting the nuisance parameters increases the noise
        assert (noise_nm(R, I0, 1e5, 2.0) > noise_nm(without_fit, I0, 1e5, 2.0)).all()


@pytest.mark.parametrize("nuisance", [RESPONSE[:, :1], np.zeros((PIXELS, 1))])
def test_a_nuisance_response_that_is_zero_or_equals_that_of_a_mode_is_refused(nuisance: np.ndarray) -> None:
    nuisance_response = normalise_flux(TOY.reference, nuisance, GOOD)[1]
    with pytest.raises(ValueError, match="nuisance parameters apart"):
        reconstructor(I0, H, GOOD, 1e5, 1.0, nuisance=nuisance_response)


def test_an_unknown_estimator_is_refused() -> None:
    with pytest.raises(ValueError, match="'best'"):
        reconstructor(TOY.reference, RESPONSE, GOOD, 1e5, 1.0, "best")


def test_the_condition_number_of_a_response_in_which_a_mode_has_no_signal_is_infinite() -> None:
    assert condition_number(np.eye(4)[:, :2]) == pytest.approx(1)
    assert condition_number(np.column_stack([np.ones(4), np.zeros(4)])) == np.inf


def test_an_estimate_is_r_times_the_difference_from_i0_after_division_by_the_flux() -> None:
    rng = np.random.default_rng(3)
    uneven = rng.uniform(0.5, 1.5, PIXELS) * calibration().reference  # so that R I0 is not zero
    calibration_ = replace(calibration(), reference=(uneven / uneven.sum()).astype(np.float32))
    out = np.empty(PIXELS, np.float32)
    for flux_dn in (30_000.0, 300_000.0):
        pixels = rng.poisson(TOY.pixels((3, -4, 5), flux_dn).reshape(-1)).astype(np.uint16)
        before = pixels.copy()
        estimate = Estimator.of(calibration_).estimate(pixels, 0.0)
        assert (estimate.error_nm.dtype, pixels.tolist()) == (np.float32, before.tolist())
        assert estimate.flux_dn == pytest.approx(difference(calibration_, pixels, 0.0, out), rel=1e-6)
        expected_nm = calibration_.reconstructor.astype(np.float64) @ out
        assert np.abs(expected_nm).max() > 1
        assert estimate.error_nm == pytest.approx(expected_nm, rel=1e-4, abs=1e-4)


def test_a_frame_at_or_below_the_least_flux_has_no_estimate() -> None:
    calibration_ = calibration()
    estimator = Estimator.of(calibration_)
    pixels = np.full(PIXELS, 101, np.uint16)  # one DN above the dark in every pixel
    assert estimator.estimate(pixels, float(PIXELS)) is None
    assert estimator.estimate(pixels, PIXELS - 1.0) is not None
    assert estimator.estimate(np.zeros(PIXELS, np.uint16), 0.0) is None


def test_only_good_pixels_count_as_saturated() -> None:
    calibration_ = replace(calibration(), good=SOME_BAD.astype(np.float32))
    pixels = np.full(PIXELS, 1000, np.uint16)
    assert saturated_pixels(calibration_, pixels) == 0
    pixels[[3, 4]] = 60_000
    assert saturated_pixels(calibration_, pixels) == 1
    pixels[5] = 65_535
    assert saturated_pixels(calibration_, pixels) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reference": np.zeros(3, np.float32)}, "reference must have shape"),
        ({"modes_to_actuators": np.zeros((20, 2), np.float32)}, "modes_to_actuators must have shape"),
        ({"dark": np.full(PIXELS, np.nan, np.float32)}, "dark holds values that are not finite"),
        ({"flux_dn": 0.0}, "flux_dn"),
        ({"flux_dn": np.nan}, "flux_dn"),
        ({"flux_dn": np.inf}, "flux_dn"),
    ],
)
def test_an_inconsistent_calibration_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(calibration(), **change)


def computed_image() -> np.ndarray:
    """An image like that of a flat wavefront: a rotation by 180 degrees does not change it, but a reflection does."""
    rng = np.random.default_rng(4)
    y, x = np.indices((64, 64)) - 31.5
    speckles = gaussian_filter(rng.standard_normal((64, 64)), 2.5)
    image = np.exp(-(x**2 + y**2) / 180) * (0.05 + (speckles + speckles[::-1, ::-1]) ** 2)
    return image / image.sum()


@pytest.mark.parametrize("geometry", [Geometry(0.9, 30.2, 38.9, -70.0, 1), Geometry(1.05, 35.0, 37.0, 89.0, -1)])
def test_align_recovers_the_geometry_of_a_noisy_image(geometry: Geometry) -> None:
    rng = np.random.default_rng(1)
    real = rng.poisson(2e6 * onto(computed_image(), geometry, (70, 80)) + 5).astype(float)
    aligned = align(real, computed_image())
    assert aligned.geometry.parity == geometry.parity
    assert aligned.geometry.scale == pytest.approx(geometry.scale, abs=0.003)
    assert (aligned.geometry.row, aligned.geometry.column) == pytest.approx((geometry.row, geometry.column), abs=0.05)
    difference_deg = (aligned.geometry.rotation_deg - geometry.rotation_deg + 90) % 180 - 90  # modulo 180 degrees
    assert abs(difference_deg) < 0.2
    assert aligned.background == pytest.approx(5, abs=0.5)
    assert aligned.residual < 0.1
    assert aligned.other_parity > 2 * aligned.residual


def test_a_rotation_by_180_degrees_keeps_the_image_and_inverts_the_response() -> None:
    geometry = Geometry(1.1, 30.0, 40.0, 20.0, -1)
    image = computed_image()
    rotated = geometry.rotated(180)
    assert rotated.rotated(180) == geometry
    assert np.allclose(onto(image, geometry, (70, 80)), onto(image, rotated, (70, 80)), atol=1e-9)
    slope = image - np.roll(image, 1, axis=0)
    slope = slope - slope[::-1, ::-1]
    assert np.allclose(onto(slope, geometry, (70, 80)), -onto(slope, rotated, (70, 80)), atol=1e-9)


def test_resampling_conserves_flux_for_one_or_many_images() -> None:
    image = computed_image()
    geometry = Geometry(1.3, 50.0, 50.0, 33.0, 1)
    assert onto(image, geometry, (100, 100)).sum() == pytest.approx(1.0, abs=0.01)
    both = onto(np.stack([image, 2 * image], axis=2), geometry, (100, 100))
    assert np.array_equal(both[..., 0], onto(image, geometry, (100, 100)))
    assert np.allclose(both[..., 1], 2 * both[..., 0])


def test_align_refuses_an_image_that_is_unrelated_or_has_no_light() -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(ValueError, match="the image does not resemble"):
        align(np.pad(rng.exponential(100.0, (30, 35)), 5), computed_image())
    with pytest.raises(ValueError, match="no light"):
        align(np.zeros((70, 80)), computed_image())
