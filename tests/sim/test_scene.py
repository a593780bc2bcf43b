"""The simulated bench: its truth is what was put in, and its frames are what the calibration expects."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.files.factory import analytic_calibration, mirror_on_twin, sensor, twin
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.estimator import Estimator
from lowfc.optics.chain.sensor import image, pupil_radii
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.twin.twin import Evaluator
from sim_camera.disturbance import BLOCK, _sum_of_waves
from sim_camera.driver import disturbance_of
from sim_camera.driver import scene as scene_of
from sim_camera.scene import Scene

FLAT = np.zeros((34, 34), np.float32)
FINE = {"camera__noise": False, "camera__gain_e_per_dn": 0.01, "camera__full_well_e": 600.0}


def configured(**overrides: object) -> Configuration:
    quiet = {"disturbance.preset": "quiet"}
    return load(None, quiet | {key.replace("__", "."): value for key, value in overrides.items()})


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    config = configured(**FINE)
    optics = twin(config, None, print)
    return analytic_calibration(config, optics, mirror_on_twin(config, optics, print))


@pytest.fixture(scope="module")
def still() -> Scene:
    return scene_of(configured(**FINE))


@pytest.fixture(scope="module")
def noisy() -> Scene:
    return scene_of(configured())


def shape_of(calibration: Calibration, modes_nm: np.ndarray) -> np.ndarray:
    return (calibration.modes_to_actuators @ modes_nm.astype(np.float32)).reshape(34, 34)


def test_the_truth_of_static_modes_is_those_modes(still: Scene) -> None:
    asked = {"2": 5.0, "4": -12.0, "11": 3.0}
    truth = scene_of(configured(camera__noise=False, disturbance__static_nm=asked)).truth(0, FLAT).sampled
    expected = np.zeros(14)
    expected[[0, 2, 9]] = 5, -12, 3
    assert truth.disturbance_nm == pytest.approx(expected, abs=1e-4)
    assert truth.residual_nm == pytest.approx(expected, abs=1e-3)
    assert truth.residual_rms_nm == truth.disturbance_rms_nm > 3
    nothing = still.truth(0, FLAT).sampled
    assert nothing.residual_rms_nm == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("mode", range(14))
def test_a_modal_command_adds_its_wavefront_to_the_disturbance(
    still: Scene, calibration: Calibration, mode: int
) -> None:
    """The residual is disturbance + command within 2 % of the command: wavefront = disturbance + 2 surface."""
    command = 20.0 * np.eye(14)[mode]
    truth = still.truth(0, shape_of(calibration, command)).sampled
    assert np.abs(truth.residual_nm - command).max() < 0.02 * 20
    assert not truth.disturbance_nm.any()


@pytest.mark.parametrize("mode", range(14))
def test_a_small_mode_is_measured_with_the_right_size_and_sign(
    still: Scene, calibration: Calibration, mode: int
) -> None:
    """Push and pull by the mirror, without noise: R of the frames is the mode, within 2 %."""
    estimator, measured = Estimator.of(calibration), []
    for sign in (1, -1):
        frame = still.expose(0, shape_of(calibration, sign * 5.0 * np.eye(14)[mode]))
        found = estimator.estimate(frame.reshape(-1), 0.0)
        measured.append(found.error_nm)
    half = (measured[0] - measured[1]) / 2
    assert np.abs(half - 5.0 * np.eye(14)[mode]).max() < 0.1


def noisy_frames(scene: Scene, count: int) -> list[np.ndarray]:
    return [scene.expose(index, FLAT) for index in range(count)]


def test_noise_comes_from_the_seed_and_the_light_is_what_the_calibration_expects(
    noisy: Scene, calibration: Calibration
) -> None:
    frames = noisy_frames(noisy, 20)
    first = [frame.tobytes() for frame in frames[:3]]
    assert [frame.tobytes() for frame in noisy_frames(scene_of(configured()), 3)] == first
    assert [frame.tobytes() for frame in noisy_frames(scene_of(configured(seed=2)), 3)] != first
    assert len(set(first)) == 3
    expected_e = calibration.flux_dn * 0.01
    error_e = np.sqrt((expected_e + frames[0].size) / 20)
    assert np.mean([frame.sum() - 100.0 * frame.size for frame in frames]) == pytest.approx(expected_e, abs=4 * error_e)
    assert frames[0].dtype == np.uint16
    assert frames[0].shape == noisy.shape == calibration.shape


def test_a_frame_is_the_same_in_whatever_order_it_is_asked_for() -> None:
    indices = [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 7]
    scene = scene_of(configured(camera__noise=False, disturbance__preset="reaction-wheel"))
    forward = [scene.expose(index, FLAT).tobytes() for index in indices]
    backward = [scene.expose(index, FLAT).tobytes() for index in reversed(indices)]
    assert forward == backward[::-1]
    assert len(set(forward)) == len(indices)


@pytest.mark.parametrize("exposure", [0.5, 0.9])
def test_an_image_is_the_mean_over_its_exposure(exposure: float) -> None:
    """Two instants against 64, while the star moves by 14 mas rms: to 1e-5 of the brightest pixel."""
    keys = {
        "disturbance__preset": "reaction-wheel-ideal",
        "camera__rate_hz": 1000.0,
        "camera__exposure_fraction": exposure,
    }
    config = configured(**FINE, **keys)
    blurred, shaken = scene_of(config), disturbance_of(config)
    instant, worst = Evaluator(blurred._optics), 0.0
    for index in (0, 40, 91, 333):
        instants = index + exposure * (np.arange(64) + 0.5) / 64
        opds = _sum_of_waves(shaken, instants / 1000).astype(np.float32) @ blurred._basis
        mean = np.mean([instant.image(opd).copy() for opd in opds], axis=0, dtype=np.float64) * blurred._electrons
        found = (blurred.expose(index, FLAT).astype(float) - 100) * 0.01
        worst = max(worst, float(np.abs(found - mean).max() / mean.max()))
    assert worst < 1e-5 + 0.005 / mean.max(), "and half a digital number"


@pytest.mark.slow
def test_a_blurred_image_is_as_near_the_full_model_as_one_at_rest() -> None:
    """Two instants of the twin against 64 of the full optics, and one of each: at most a tenth worse."""
    keys = {"disturbance__preset": "reaction-wheel-ideal", "camera__rate_hz": 1000.0}
    config = configured(**FINE, **keys)
    blurred, shaken, optics = scene_of(config), disturbance_of(config), sensor(config, print)
    instant, shapes = Evaluator(blurred._optics), zernikes(config.noll, *pupil_radii(optics))
    at_rest = moving = 0.0
    for index in (0, 91):
        instants = index + config.camera.exposure_fraction * (np.arange(64) + 0.5) / 64
        each = [image(optics, np.tensordot(one, shapes, 1)) for one in _sum_of_waves(shaken, instants / 1000)]
        middle = _sum_of_waves(shaken, instants[32:33] / 1000)[0].astype(np.float32)
        electrons = float(blurred._electrons)
        at_rest = max(at_rest, float(np.abs(instant.image(middle @ blurred._basis) - each[32]).max()))
        found = (blurred.expose(index, FLAT).astype(float) - 100) * 0.01 / electrons
        moving = max(moving, float(np.abs(found - np.mean(each, axis=0)).max()))
    assert moving < 1.1 * at_rest + 0.005 / electrons, "and half a digital number"


def test_the_continuous_truth_is_the_rms_over_the_period_and_the_mirrors_path(calibration: Calibration) -> None:
    """Against the wavefront at each instant by itself, the mirror moved halfway."""
    config = configured(disturbance__preset="bench", camera__rate_hz=20.0, camera__instants=4)
    scene, shaken = scene_of(config), disturbance_of(config)
    shapes = [shape_of(calibration, height * np.eye(14)[3]) for height in (5.0, -8.0)]
    weights = np.array([[1, 0], [1, 0], [0.25, 0.75], [0, 1]], np.float32)
    found = scene.truth(7, shapes[0], (shapes, weights))
    squares, pupil = [], []
    for moment, weight in zip((0.125, 0.375, 0.625, 0.875), weights, strict=True):
        modes = _sum_of_waves(shaken, np.array([(7 + moment) / 20]))[0]
        still = scene_of(
            configured(disturbance__static_nm={str(n): v for n, v in zip(config.noll, modes, strict=True)})
        )
        alone = still.truth(0, np.tensordot(weight, np.array(shapes), 1)).sampled
        squares.append(alone.residual_nm.astype(float) ** 2)
        pupil.append((alone.disturbance_rms_nm**2, alone.residual_rms_nm**2))
    assert found.continuous is not None
    assert found.continuous.residual_nm == pytest.approx(np.sqrt(np.mean(squares, axis=0)), abs=2e-3)
    both = (found.continuous.disturbance_rms_nm, found.continuous.residual_rms_nm)
    assert both == pytest.approx(np.sqrt(np.mean(pupil, axis=0)), rel=1e-3)


def test_one_instant_is_that_at_which_the_exposure_starts_and_blurs_nothing() -> None:
    keys = {"camera__noise": False, "disturbance__preset": "reaction-wheel-ideal"}
    config = configured(**keys, camera__instants=1)
    scene = scene_of(config)
    still = _sum_of_waves(disturbance_of(config), np.array([3 / config.camera.rate_hz]))[0]
    static = {str(n): float(v) for n, v in zip(config.noll, still, strict=True)}
    assert (
        scene.expose(3, FLAT)
        == scene_of(configured(camera__noise=False, disturbance__static_nm=static)).expose(0, FLAT)
    ).all()
    assert scene.truth(3, FLAT).continuous is None


def test_the_stand_in_of_the_examples_refuses_a_mirror_of_another_grid() -> None:
    spec = importlib.util.spec_from_file_location("stand_in", Path(__file__).parents[2] / "examples" / "stand_in.py")
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(stand_in := importlib.util.module_from_spec(spec))
    heard: list[Any] = []
    optics = stand_in.Optics(Configuration())
    optics.join(SimpleNamespace(bus=SimpleNamespace(subscribe=lambda _, hear, __: heard.append(hear))))
    surface = np.zeros((24, 24), np.float32)
    state = wire.MirrorState(rows=24, columns=24, actuators=surface.tobytes())
    heard[0](SimpleNamespace(payload=state.SerializeToString()))
    with pytest.raises(
        ConfigurationError, match=r"\(24, 24\) actuators, mirror.rows and mirror.columns say \(34, 34\)"
    ):
        optics.expose()
