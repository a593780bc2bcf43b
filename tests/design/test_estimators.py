"""Estimators against closed forms, and their covariance against the Cramer-Rao bound and simulated noise."""

from itertools import pairwise

import numpy as np
import pytest

from lowfc.design.estimators import KINDS, estimate, fit, iterated
from lowfc.design.fisher import covariance, cramer_rao, variance_e2
from lowfc.design.trials import (
    bounds_waves,
    expected_rms,
    gram,
    input_rms,
    noisy_e,
    r_squared,
    random_wavefronts,
    residual_pv,
    residual_rms,
)
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.zernike import NOLLS_14, NOLLS_20, zernikes

SCALE_E, READ_NOISE_E = 2e5, 3.0


@pytest.fixture(scope="module")
def optics():
    """I0 (60,) and H (60, 3) of an arbitrary sensor."""
    rng = np.random.default_rng(1)
    I0 = rng.exponential(size=60) / 60
    return I0, I0[:, None] ** 0.5 * rng.normal(size=(60, 3)) * 1e-3


@pytest.fixture(scope="module")
def fits(optics):
    return {kind: fit(*optics, SCALE_E, READ_NOISE_E, kind) for kind in KINDS}


def test_pixel_without_variance_carries_no_information():
    H, variance = np.array([[3.0], [0.0]]), np.array([9.0, 0.0])
    np.testing.assert_allclose(cramer_rao(H, variance), [[1.0]])


def test_indistinguishable_modes_are_refused():
    H = np.ones((5, 2))
    with pytest.raises(ValueError, match="cannot tell the modes apart"):
        cramer_rao(H, np.ones(5))
    with pytest.raises(ValueError, match="cannot tell the modes apart"):
        fit(np.ones(5), H, SCALE_E, READ_NOISE_E, "pinv")


def test_weighted_estimator_attains_the_cramer_rao_bound(fits):
    variance = variance_e2(fits["pinv"].reference_e, READ_NOISE_E)
    bound = cramer_rao(fits["pinv"].response_e, variance)
    np.testing.assert_allclose(covariance(fits["weighted"].R, variance), bound, rtol=1e-9)
    assert (np.diag(covariance(fits["pinv"].R, variance)) > 1.05 * np.diag(bound)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_linear_image_is_estimated_exactly(fits, optics, kind):
    I0, H = optics
    modes_nm = np.array([[1.0, -2.0, 3.0], [0.5, 0.0, -4.0]])
    images_e = SCALE_E * (I0 + modes_nm @ H.T)
    np.testing.assert_allclose(estimate(fits[kind], images_e), modes_nm, atol=1e-9)
    np.testing.assert_allclose(estimate(fits[kind], images_e[1]), modes_nm[1], atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_fitted_nuisance_parameters_do_not_bias_the_modes(fits, optics, kind):
    I0, H = optics
    nuisance = np.column_stack([I0, H[:, 0] * 1e6 + np.gradient(I0)])  # flux, and a shear that resembles the first mode
    image_e = SCALE_E * (I0 + H @ [1.0, -2.0, 3.0] + nuisance @ [0.01, 2e-6])
    with_nuisance = fit(I0, H, SCALE_E, READ_NOISE_E, kind, nuisance)
    np.testing.assert_allclose(estimate(with_nuisance, image_e), [1.0, -2.0, 3.0], atol=1e-8)
    assert abs(estimate(fits[kind], image_e)[0] - 1.0) > 0.5
    assert with_nuisance.R.shape == (3, 60)


def test_iterations_with_the_full_model_remove_the_second_order_error(fits, optics):
    I0, H = optics

    def model(modes_nm):
        return I0 + H @ modes_nm + 0.02 * np.abs(H) @ modes_nm**2

    truth_nm = np.array([3.0, -2.0, 4.0])
    image_e = SCALE_E * model(truth_nm)
    errors = [np.abs(modes_nm - truth_nm).max() for modes_nm in iterated(fits["weighted"], image_e, model, 60)]
    assert errors[0] > 0.1
    assert all(after < 0.5 * before for before, after in pairwise(errors[:4]))
    assert errors[60] < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_scatter_of_estimates_from_noisy_images_agrees_with_the_prediction(fits, kind):
    rng, linear, count = np.random.default_rng(5), fits[kind], 20_000
    images_e = noisy_e(rng, np.tile(linear.reference_e, (count, 1)), READ_NOISE_E)
    predicted = np.sqrt(np.diag(covariance(linear.R, variance_e2(linear.reference_e, READ_NOISE_E) + 1 / 12)))
    measured = estimate(linear, images_e).std(axis=0, ddof=1)
    np.testing.assert_allclose(measured, predicted, rtol=4 / np.sqrt(2 * count))


def test_an_unknown_kind_is_refused(optics):
    with pytest.raises(ValueError, match="estimator must be one of"):
        fit(*optics, SCALE_E, READ_NOISE_E, "best")


def test_noise_is_the_sum_of_photon_noise_read_noise_and_rounding():
    mean_e = np.repeat([0.0, 7.0, 400.0], 40_000)
    image_e = noisy_e(np.random.default_rng(3), mean_e, READ_NOISE_E)
    assert (image_e == np.rint(image_e)).all()
    for mean, part in zip((0.0, 7.0, 400.0), image_e.reshape(3, -1), strict=True):
        variance = mean + READ_NOISE_E**2 + 1 / 12
        assert part.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance / 40_000))
        assert part.var() == pytest.approx(variance, rel=0.04)


def test_random_wavefronts_are_stratified_and_depend_only_on_the_seed():
    drawn = random_wavefronts(np.random.default_rng(4), 50, NOLLS_20, 0.04, 0.016)
    bounds = bounds_waves(NOLLS_20, 0.04, 0.016)
    assert bounds.tolist() == [0.04] * 5 + [0.016] * 15
    strata = np.sort(np.floor((drawn / bounds + 1.0) * 25), axis=0)
    np.testing.assert_array_equal(strata, np.tile(np.arange(50.0)[:, None], (1, 20)))
    np.testing.assert_array_equal(drawn, random_wavefronts(np.random.default_rng(4), 50, NOLLS_20, 0.04, 0.016))
    assert np.abs(np.corrcoef(drawn.T) - np.eye(20)).max() < 0.5


@pytest.fixture(scope="module")
def circle_modes():
    """Modes (14, points) at the grid points within the unit circle, of unit rms."""
    u = 2.0 * pupil_axis(256)
    inside = u[:, None] ** 2 + u**2 <= 1.0
    return zernikes(NOLLS_14, u, u[:, None])[:, inside]


def test_residual_rms_and_pv_over_the_circle_agree_with_closed_forms(circle_modes):
    residuals = np.zeros((2, 14))
    residuals[0, 0], residuals[1, :3] = 0.5, (3.0, 0.0, 4.0)
    products = gram(circle_modes)
    np.testing.assert_allclose(products, np.eye(14), atol=5e-3)
    np.testing.assert_allclose(residual_rms(products, residuals), [0.5, 5.0], rtol=5e-3)
    pv = residual_pv(circle_modes, residuals)
    assert pv[0] == pytest.approx(0.5 * 4.0, rel=0.01)  # a tilt's peak to valley is four times its rms
    assert pv[1] == pytest.approx(np.ptp(residuals[1] @ circle_modes))


def test_expected_rms_agrees_with_many_draws(circle_modes):
    products, bounds = gram(circle_modes), bounds_waves(NOLLS_14, 0.04, 0.016)
    drawn = random_wavefronts(np.random.default_rng(6), 5000, NOLLS_14, 0.04, 0.016)
    measured = np.sqrt(np.mean(residual_rms(products, drawn) ** 2))
    assert input_rms(products, bounds) == pytest.approx(measured, rel=0.01)
    assert expected_rms(products, np.diag(bounds**2 / 3)) == pytest.approx(input_rms(products, bounds))


def test_r_squared_is_one_minus_the_ratio_of_squared_errors_to_the_scatter_of_the_estimates():
    truth = np.array([[0.0, 1.0], [2.0, 1.0], [4.0, 4.0]])
    estimates = truth + np.array([[0.0, 1.0], [0.0, 0.0], [0.0, -1.0]])
    # Sums of squares of the second mode: 2 of the errors 1, 0, -1, and 2 of the estimates 2, 1, 3 about their mean.
    np.testing.assert_allclose(r_squared(estimates, truth), [1.0, 1.0 - 2.0 / 2.0])
