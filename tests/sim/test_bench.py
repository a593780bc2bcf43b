"""The simulated bench: its truth is what was put in, and its frames are what the calibration expects."""

import numpy as np
import pytest
from sim_camera.bench import Bench

from lowfc.adapters.files.factory import analytic_calibration, mirror_on_twin, twin
from lowfc.contract.configuration import Configuration, load
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.estimator import Estimator
from sim_camera.disturbance import BLOCK
from sim_camera.process import bench

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
def still() -> Bench:
    return bench(configured(**FINE))


@pytest.fixture(scope="module")
def noisy() -> Bench:
    return bench(configured())


def shape_of(calibration: Calibration, modes_nm: np.ndarray) -> np.ndarray:
    return (calibration.modes_to_actuators @ modes_nm.astype(np.float32)).reshape(34, 34)


def test_the_truth_of_static_modes_is_those_modes(still: Bench) -> None:
    asked = {"2": 5.0, "4": -12.0, "11": 3.0}
    _, truth = bench(configured(camera__noise=False, disturbance__static_nm=asked)).expose(0, FLAT)
    expected = np.zeros(14)
    expected[[0, 2, 9]] = 5, -12, 3
    assert truth.disturbance_nm == pytest.approx(expected, abs=1e-4)
    assert truth.residual_nm == pytest.approx(expected, abs=1e-3)
    assert truth.residual_rms_nm == truth.disturbance_rms_nm > 3
    _, nothing = still.expose(0, FLAT)
    assert nothing.residual_rms_nm == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("mode", range(14))
def test_a_modal_command_adds_its_wavefront_to_the_disturbance(
    still: Bench, calibration: Calibration, mode: int
) -> None:
    """The residual is disturbance + command within 2 % of the command: wavefront = disturbance + 2 surface."""
    command = 20.0 * np.eye(14)[mode]
    _, truth = still.expose(0, shape_of(calibration, command))
    assert np.abs(truth.residual_nm - command).max() < 0.02 * 20
    assert not truth.disturbance_nm.any()


@pytest.mark.parametrize("mode", range(14))
def test_a_small_mode_is_measured_with_the_right_size_and_sign(
    still: Bench, calibration: Calibration, mode: int
) -> None:
    """Push and pull by the mirror, without noise: R of the frames is the mode, within 2 %."""
    estimator, measured = Estimator.of(calibration), []
    for sign in (1, -1):
        frame, _ = still.expose(0, shape_of(calibration, sign * 5.0 * np.eye(14)[mode]))
        found = estimator.estimate(frame.reshape(-1), 0.0)
        measured.append(found.error_nm)
    half = (measured[0] - measured[1]) / 2
    assert np.abs(half - 5.0 * np.eye(14)[mode]).max() < 0.1


def noisy_frames(scene: Bench, count: int) -> list[np.ndarray]:
    return [scene.expose(index, FLAT)[0] for index in range(count)]


def test_noise_comes_from_the_seed_and_the_light_is_what_the_calibration_expects(
    noisy: Bench, calibration: Calibration
) -> None:
    frames = noisy_frames(noisy, 20)
    first = [frame.tobytes() for frame in frames[:3]]
    assert [frame.tobytes() for frame in noisy_frames(bench(configured()), 3)] == first
    assert [frame.tobytes() for frame in noisy_frames(bench(configured(seed=2)), 3)] != first
    assert len(set(first)) == 3
    expected_e = calibration.flux_dn * 0.01
    error_e = np.sqrt((expected_e + frames[0].size) / 20)
    assert np.mean([frame.sum() - 100.0 * frame.size for frame in frames]) == pytest.approx(expected_e, abs=4 * error_e)
    assert frames[0].dtype == np.uint16
    assert frames[0].shape == noisy.shape == calibration.shape


def test_a_frame_is_the_same_in_whatever_order_it_is_asked_for() -> None:
    indices = [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 7]
    scene = bench(configured(camera__noise=False, disturbance__preset="reaction-wheel"))
    forward = [scene.expose(index, FLAT)[0].tobytes() for index in indices]
    backward = [scene.expose(index, FLAT)[0].tobytes() for index in reversed(indices)]
    assert forward == backward[::-1]
    assert len(set(forward)) == len(indices)
