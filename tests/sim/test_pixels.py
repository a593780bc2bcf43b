"""Pixel errors of the simulated detector, compared with simple models."""

from functools import partial

import numpy as np
import pytest
import scipy

from lowfc.adapters.files.factory import detector
from lowfc.contract.configuration import load
from lowfc.optics.detector.detector import Detector, expose, saturation_dn
from sim_camera.driver import scene
from sim_camera.pixels import pixel_errors, response
from tests.support.in_process_loop import configuration

FLAT = np.zeros((34, 34), np.float32)
DETECTOR = Detector(full_well_e=40_000.0, bias_dn=100.0)
faint = partial(configuration, {"disturbance.preset": "quiet", "star.magnitude": 20.0})


def test_dark_current_has_a_poisson_distribution() -> None:
    """400 electrons per second in 2 ms: digital numbers have a Poisson distribution with mean 0.8."""
    config = faint(camera__dark_current_e_s=400.0, camera__read_noise_e=0.0)
    assert config.dark_e == pytest.approx(0.8)
    frame = expose(detector(config), np.zeros((400, 500)), np.random.default_rng(1))
    counted = np.bincount((frame - 100).ravel(), minlength=8)
    expected = scipy.stats.poisson.pmf(np.arange(8), 0.8) * frame.size
    frequent = expected > 5
    observed = [*counted[frequent], counted[~frequent].sum()]
    p_value = scipy.stats.chisquare(observed, [*expected[frequent], frame.size - expected[frequent].sum()])[1]
    assert p_value > 1e-3


def test_dark_current_raises_the_mean_of_frames() -> None:
    frames = [scene(faint(camera__dark_current_e_s=rate)).expose(0, FLAT) for rate in (0.0, 5000.0)]
    assert frames[1].mean() - frames[0].mean() == pytest.approx(10, abs=0.2)


def test_hot_pixels_and_gains_have_the_configured_statistics() -> None:
    found = pixel_errors(DETECTOR, (300, 400), 1, 0.02, 0.0, 0.01, 50.0)
    assert found.gain.std() == pytest.approx(0.02, rel=0.02)
    hot = found.hot_e[found.hot_e > 0]
    assert hot.size == pytest.approx(1200, abs=4 * np.sqrt(1200))
    assert hot.mean() == pytest.approx(50, rel=0.15)
    again = pixel_errors(DETECTOR, (300, 400), 1, 0.02, 0.0, 0.01, 50.0)
    np.testing.assert_array_equal(found.hot_e, again.hot_e)
    np.testing.assert_array_equal(found.gain, again.gain)
    assert pixel_errors(DETECTOR, (300, 400), 1, 0, 0, 0, 50.0) is None


def test_nonlinear_response_is_exact_at_zero_and_full_well() -> None:
    found, full = response(DETECTOR, 0.05), saturation_dn(DETECTOR)
    assert found[[0, 50, 100, full]].tolist() == [0, 50, 100, full]
    for light_dn in (200, 20_000, 35_000):
        assert found[100 + light_dn] - 100 == pytest.approx(light_dn * 1.05 - 0.05 * light_dn**2 / 40_000, abs=0.5)
    assert (np.diff(found[: full + 1].astype(int)) >= 0).all()
    np.testing.assert_array_equal(response(DETECTOR, 0.0), np.arange(1 << 16))


def test_scene_applies_pixel_errors_reproducibly() -> None:
    keys = {"camera.hot_pixels": 0.01, "camera.nonlinearity": 0.05, "camera.nonuniformity": 0.02, "camera.noise": False}
    bright = {"star.magnitude": 0.0, "disturbance.preset": "quiet"}
    plain, one, same = (scene(load(None, bright | other)) for other in ({"camera.noise": False}, keys, keys))
    ideal, real = plain.expose(0, FLAT), one.expose(0, FLAT)
    np.testing.assert_array_equal(real, same.expose(0, FLAT))
    errors = pixel_errors(DETECTOR, real.shape, 1, 0.02, 0.05, 0.01, 40.0)
    signal = (ideal.astype(float) - 100) * errors.gain + errors.hot_e
    expected = 100 + signal * (1 + 0.05 * (1 - signal / 40_000))
    np.testing.assert_allclose(real, expected, atol=2)
