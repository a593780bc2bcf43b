"""The simulated scene: the reported true wavefront equals the injected modes, and frames match the calibration."""

import dataclasses
from functools import partial
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from lowfc.adapters.files.factory import sensor
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import wire
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.estimator import Estimator
from lowfc.optics.chain.sensor import image, pupil_radii
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.twin.twin import Evaluator
from sim_camera.disturbance import Sampler
from sim_camera.driver import disturbance_of
from sim_camera.driver import scene as scene_of
from sim_camera.scene import Scene, exposure_nodes
from tests.support.in_process_loop import configuration
from tools.law_bench import calibrated

GRID, MODES = (34, 34), 14
FLAT = np.zeros(GRID, np.float32)
BIAS_DN, FINE_E_PER_DN = 100.0, 0.01
FINE = {"camera__noise": False, "camera__gain_e_per_dn": FINE_E_PER_DN, "camera__full_well_e": 600.0}
"""Configuration keys for frames without noise and with little rounding."""

configured = partial(configuration, {"disturbance.preset": "quiet"})


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(configured(**FINE))


@pytest.fixture(scope="module")
def quiet() -> Scene:
    return scene_of(configured(**FINE))


def shape_of(calibration: Calibration, modes_nm: np.ndarray) -> np.ndarray:
    return (calibration.modes_to_actuators @ modes_nm.astype(np.float32)).reshape(GRID)


def test_true_wavefront_equals_the_injected_static_modes(quiet: Scene) -> None:
    static_nm = {"2": 5.0, "4": -12.0, "11": 3.0}
    truth = scene_of(configured(camera__noise=False, disturbance__static_nm=static_nm)).truth(0, FLAT).sampled
    expected = np.array([static_nm.get(str(noll), 0.0) for noll in Configuration().noll])
    assert truth.disturbance_nm == pytest.approx(expected, abs=1e-4)
    assert truth.residual_nm == pytest.approx(expected, abs=1e-3)
    assert truth.residual_rms_nm == truth.disturbance_rms_nm > 3
    flat = quiet.truth(0, FLAT).sampled
    assert flat.residual_rms_nm == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("mode", range(MODES))
def test_a_modal_command_adds_its_wavefront_to_the_disturbance(
    quiet: Scene, calibration: Calibration, mode: int
) -> None:
    """The residual is disturbance + command within 2 % of the command: wavefront = disturbance + 2 surface."""
    command = 20.0 * np.eye(MODES)[mode]
    truth = quiet.truth(0, shape_of(calibration, command)).sampled
    assert np.abs(truth.residual_nm - command).max() < 0.02 * 20
    assert not truth.disturbance_nm.any()


@pytest.mark.parametrize("mode", range(MODES))
def test_small_mode_is_measured_with_correct_size_and_sign(quiet: Scene, calibration: Calibration, mode: int) -> None:
    """Push and pull by the mirror, without noise: the modal error equals the mode within 2 %."""
    estimator, measured, poke_nm = Estimator.of(calibration), [], 5.0 * np.eye(MODES)[mode]
    for sign in (1, -1):
        frame = quiet.expose(0, shape_of(calibration, sign * poke_nm))
        found = estimator.estimate(frame.reshape(-1), 0.0)
        measured.append(found.error_nm)
    half_difference_nm = (measured[0] - measured[1]) / 2
    assert np.abs(half_difference_nm - poke_nm).max() < 0.02 * 5.0


def noisy_frames(scene: Scene, count: int) -> list[np.ndarray]:
    return [scene.expose(index, FLAT) for index in range(count)]


def test_the_seed_determines_the_noise_and_the_flux_matches_the_calibration(calibration: Calibration) -> None:
    noisy = scene_of(configured())
    frames, pixels = noisy_frames(noisy, 20), noisy.shape[0] * noisy.shape[1]
    first = [frame.tobytes() for frame in frames[:3]]
    assert [frame.tobytes() for frame in noisy_frames(scene_of(configured()), 3)] == first
    assert [frame.tobytes() for frame in noisy_frames(scene_of(configured(seed=2)), 3)] != first
    assert len(set(first)) == 3
    expected_e = calibration.flux_dn * FINE_E_PER_DN
    error_e = np.sqrt((expected_e + pixels) / len(frames))  # photon noise, and read noise of 1 e- in each pixel
    mean_e = np.mean([frame.sum() - BIAS_DN * pixels for frame in frames])
    assert mean_e == pytest.approx(expected_e, abs=4 * error_e)
    assert frames[0].dtype == np.uint16
    assert frames[0].shape == noisy.shape == calibration.shape


def test_frames_without_noise_have_the_flux_and_dark_of_the_calibration() -> None:
    keys = {"camera__em_gain": 100.0, "camera__dark_current_e_s": 20.0, "camera__clock_induced_charge_e": 0.02}
    config = configured(camera__noise=False, camera__full_well_e=600_000.0, camera__gain_e_per_dn=10.0, **keys)
    calibration = calibrated(config)
    light_dn = scene_of(config).expose(0, FLAT).reshape(-1) - calibration.dark
    assert light_dn.sum() == pytest.approx(calibration.flux_dn, rel=0.01)


@pytest.mark.parametrize("exposure", [0.5, 0.9])
def test_image_is_the_mean_over_its_exposure(exposure: float) -> None:
    """Two quadrature nodes agree with 64 instants to 1e-5 of the brightest pixel; the star moves by 14 mas rms."""
    keys = {
        "disturbance__preset": "reaction-wheel-ideal",
        "camera__rate_hz": 1000.0,
        "camera__exposure_fraction": exposure,
    }
    config = configured(**FINE, **keys)
    blurred = scene_of(config)
    sampler = Sampler(disturbance_of(config), exposure * (np.arange(64) + 0.5) / 64, 1000.0)
    evaluator, worst = Evaluator(blurred._optics), 0.0
    for index in (0, 40, 91, 333):
        opds = sampler.at(index) @ blurred._basis
        mean = np.mean([evaluator.image(opd) for opd in opds], axis=0, dtype=np.float64) * blurred._electrons
        found = (blurred.expose(index, FLAT).astype(float) - BIAS_DN) * FINE_E_PER_DN
        worst = max(worst, float(np.abs(found - mean).max() / mean.max()))
    rounding = 0.5 * FINE_E_PER_DN / mean.max()
    assert worst < 1e-5 + rounding


@pytest.mark.parametrize(
    "keys", [{"disturbance__preset": "reaction-wheel"}, {"disturbance__wheel_hz": 40.0}], ids=["damped lines", "wheel"]
)
@pytest.mark.parametrize("rate_hz", [100.0, 20.0])
def test_vibrations_faster_than_the_exposure_are_averaged(keys: dict[str, object], rate_hz: float) -> None:
    """The sensed wavefront is the mean over 1000 instants, to 0.05 nm; the lines have amplitudes of 1 nm and more."""
    config = configured(camera__rate_hz=rate_hz, camera__exposure_fraction=1.0, **keys)
    truth = scene_of(config).truth(3, FLAT)
    expected = Sampler(disturbance_of(config), (np.arange(1000) + 0.5) / 1000, rate_hz).at(3).mean(axis=0)
    assert truth.sensed_nm == pytest.approx(expected, abs=0.05)


def test_exposure_nodes_average_a_vibration_and_are_two_if_it_is_slow() -> None:
    assert len(exposure_nodes(0.25)[0]) == 2
    for cycles in (0.2, 0.9, 1.2, 3.0, 58.0):
        nodes, weights = exposure_nodes(cycles)
        assert np.cos(2 * np.pi * cycles * (nodes - 0.5)) @ weights == pytest.approx(np.sinc(cycles), abs=0.005)


@pytest.mark.slow
def test_a_blurred_image_is_as_accurate_as_an_image_at_rest() -> None:
    """The twin's two nodes against 64 images of the full optics: the error is at most 1.1 times the error at rest."""
    keys = {"disturbance__preset": "reaction-wheel-ideal", "camera__rate_hz": 1000.0}
    config = configured(**FINE, **keys)
    blurred, optics = scene_of(config), sensor(config, print)
    sampler = Sampler(disturbance_of(config), config.camera.exposure_fraction * (np.arange(64) + 0.5) / 64, 1000.0)
    evaluator, shapes = Evaluator(blurred._optics), zernikes(config.noll, *pupil_radii(optics))
    at_rest = moving = 0.0
    for index in (0, 91):
        modes = sampler.at(index)
        images = [image(optics, np.tensordot(one, shapes, 1)) for one in modes]
        electrons = float(blurred._electrons)
        at_rest = max(at_rest, float(np.abs(evaluator.image(modes[32] @ blurred._basis) - images[32]).max()))
        found = (blurred.expose(index, FLAT).astype(float) - BIAS_DN) * FINE_E_PER_DN / electrons
        moving = max(moving, float(np.abs(found - np.mean(images, axis=0)).max()))
    rounding = 0.5 * FINE_E_PER_DN / electrons
    assert moving < 1.1 * at_rest + rounding


def test_continuous_truth_is_the_rms_over_the_period_with_a_moving_mirror(calibration: Calibration) -> None:
    """Compared with static scenes, one for the wavefront at each instant; the mirror moves in mid-period."""
    config = configured(disturbance__preset="bench", camera__rate_hz=20.0, camera__instants=4)
    scene, sampler = scene_of(config), Sampler(disturbance_of(config), np.array([0.125, 0.375, 0.625, 0.875]), 20.0)
    shapes = [shape_of(calibration, height_nm * np.eye(MODES)[3]) for height_nm in (5.0, -8.0)]
    weights = np.array([[1, 0], [1, 0], [0.25, 0.75], [0, 1]], np.float32)
    found = scene.truth(7, shapes[0], (shapes, weights))
    squares, pupil = [], []
    for modes, weight in zip(sampler.at(7), weights, strict=True):
        static = scene_of(
            configured(disturbance__static_nm={str(n): v for n, v in zip(config.noll, modes, strict=True)})
        )
        expected = static.truth(0, np.tensordot(weight, np.array(shapes), 1)).sampled
        squares.append(expected.residual_nm.astype(float) ** 2)
        pupil.append((expected.disturbance_rms_nm**2, expected.residual_rms_nm**2))
    assert found.continuous.residual_nm == pytest.approx(np.sqrt(np.mean(squares, axis=0)), abs=2e-3)
    both = (found.continuous.disturbance_rms_nm, found.continuous.residual_rms_nm)
    assert both == pytest.approx(np.sqrt(np.mean(pupil, axis=0)), rel=1e-3)


@pytest.mark.parametrize("instants", [1, 4])
def test_truths_of_several_frames_equal_the_truth_of_each_frame(calibration: Calibration, instants: int) -> None:
    """Shapes recur within a frame and between frames, as those of a mirror that moves once per frame or not at all."""
    scene = scene_of(configured(disturbance__preset="kolmogorov", camera__instants=instants))
    first, second, third = (shape_of(calibration, nm * np.eye(MODES)[2]) for nm in (5.0, -8.0, 3.0))
    weights = np.random.default_rng(1).random((instants, 3)).astype(np.float32)
    frames = [(6, first, ([first, second, second], weights)), (7, second, ([second, third], weights[:, :2]))]
    found = scene.truths([*frames, (8, third, None)])
    for one, frame in zip(found, [*frames, (8, third, None)], strict=True):
        alone = scene.truth(*frame)
        for name in ("sampled", "continuous"):
            pair = getattr(one, name), getattr(alone, name)
            assert (pair[0] is None) == (pair[1] is None) == (name == "continuous" and instants == 1)
            if pair[0] is not None:
                for field in dataclasses.fields(pair[0]):
                    np.testing.assert_allclose(*(getattr(each, field.name) for each in pair), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(one.instants_nm, alone.instants_nm, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(one.sensed_nm, alone.sensed_nm, rtol=1e-5, atol=1e-5)


def test_with_one_instant_image_and_truth_are_at_the_start_of_the_exposure() -> None:
    keys = {"camera__noise": False, "disturbance__preset": "reaction-wheel-ideal"}
    config = configured(**keys, camera__instants=1)
    scene = scene_of(config)
    modes = Sampler(disturbance_of(config), np.zeros(1), config.camera.rate_hz).at(3)[0]
    static_nm = {str(n): float(v) for n, v in zip(config.noll, modes, strict=True)}
    static = scene_of(configured(camera__noise=False, disturbance__static_nm=static_nm))
    assert (scene.expose(3, FLAT) == static.expose(0, FLAT)).all()
    assert scene.truth(3, FLAT).continuous is None


def test_example_camera_refuses_a_mirror_with_another_grid() -> None:
    stand_in, service = run_path(str(Path(__file__).parents[2] / "examples" / "stand_in.py")), Mock()
    optics = stand_in["Optics"](Configuration())
    optics.join(service)
    _, on_mirror_state, _ = service.bus.subscribe.call_args.args
    surface = np.zeros((24, 24), np.float32)
    state = wire.MirrorState(rows=24, columns=24, actuators=surface.tobytes())
    on_mirror_state(SimpleNamespace(payload=state.SerializeToString()))
    with pytest.raises(ConfigurationError, match=r"\(24, 24\) actuators, .*columns say \(34, 34\)"):
        optics.expose()
