"""Reaction wheels, drift, jitter and shear of the simulated camera, compared with simple models."""

from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from lowfc.adapters.files.factory import shear_slopes, twin
from lowfc.contract.errors import ConfigurationError
from lowfc.optics.twin.twin import reference
from sim_camera.disturbance import shear_at, variances_nm2
from sim_camera.driver import disturbance_of, scene
from sim_camera.wheel import HEIGHTS, ORDERS, SOFT_HZ, Wheel, walk, wheels
from tests.support.in_process_loop import configuration
from tests.support.theory import modes_nm

FLAT = np.zeros((34, 34), np.float32)
TIME_S = np.arange(0, 20, 1e-4)
NM_PER_MAS = 2.424
quiet = partial(configuration, {"disturbance.preset": "quiet", "camera.rate_hz": 1000.0})


def wheel(course: str, change: float) -> Wheel:
    return wheels(3, (30.0,), np.array([2.0, 3.0]), course, change)[0]


@pytest.mark.parametrize(
    ("course", "change", "speed_hz"),
    [
        ("ramp", 0.0, lambda t: 30.0 + 0 * t),
        ("ramp", -2.0, lambda t: 30.0 - 2 * t),
        ("run-down", 3.0, lambda t: 30 * np.exp(-t / 10)),
        ("run-down", 0.0, lambda t: 30.0 + 0 * t),
    ],
)
def test_phase_of_wheel_harmonics_is_the_integral_of_the_speed(course: str, change: float, speed_hz: Any) -> None:
    """Expected: a numerically integrated phase. The falling ramp passes zero speed, where the amplitude vanishes."""
    spinning, speed = wheel(course, change), speed_hz(TIME_S)
    phase = 2 * np.pi * cumulative_trapezoid(speed, TIME_S, initial=0)
    expected = np.zeros((TIME_S.size, 2))
    for order, amplitude_nm in zip(ORDERS, spinning.amplitude_nm, strict=True):
        relative = (order * speed) ** 2 / ((order * speed) ** 2 + SOFT_HZ**2)  # amplitude relative to high speed
        expected += (relative * np.exp(1j * order * phase))[:, None].real * amplitude_nm.real
        expected -= (relative * np.exp(1j * order * phase))[:, None].imag * amplitude_nm.imag
    np.testing.assert_allclose(spinning.speed_hz(TIME_S), speed, atol=1e-9)
    np.testing.assert_allclose(spinning.modes_nm(TIME_S), expected, atol=2e-3)
    np.testing.assert_allclose(np.abs(spinning.amplitude_nm[0]) / np.sqrt(2), [2.0, 3.0])
    assert np.abs(spinning.amplitude_nm[:, 0] / spinning.amplitude_nm[0, 0]) == pytest.approx(HEIGHTS)


def test_phase_of_a_wheel_with_random_walk_of_its_speed_is_the_integral_of_the_speed() -> None:
    spinning, time_s = wheel("walk", 0.5), TIME_S[::10]
    speed = spinning.speed_hz(time_s)
    assert speed[0] == pytest.approx(30)
    assert np.ptp(speed) > 0.3
    np.testing.assert_allclose(spinning.turns(time_s), cumulative_trapezoid(speed, time_s, initial=0), atol=1e-3)


def test_random_walk_grows_with_the_square_root_of_time() -> None:
    times_s, moved = np.array([0.3, 3.0, 30.0, 300.0]), []
    for seed in range(300):
        frequency_hz, amplitude = walk(np.random.default_rng(seed), np.array([0.2, 0.4]))
        positions = np.exp(2j * np.pi * np.outer([0.0, *times_s], frequency_hz)) @ amplitude
        moved.append((positions[1:] - positions[0]).real)
    expected = np.outer(np.sqrt(times_s), [0.2, 0.4])
    np.testing.assert_allclose(np.std(moved, axis=0), expected, rtol=0.15)


@pytest.mark.parametrize("slope", [1.0, 2.0, 3.0])
def test_drift_has_the_configured_spectrum(slope: float) -> None:
    disturbance = disturbance_of(quiet(disturbance__drift_nm={"4": 0.3}, disturbance__drift_slope=slope))
    frequency_hz, variance_nm2 = variances_nm2(disturbance)
    assert not np.delete(variance_nm2, 2, axis=1).any()
    edges = np.geomspace(1e-3, 1, 4)
    for low, high in pairwise(edges):
        grid = np.geomspace(low, high, 1000)
        expected = np.trapezoid(0.3**2 / (2 * np.pi**2 * grid**slope), grid)
        inside = (frequency_hz >= low) & (frequency_hz < high)
        assert variance_nm2[inside, 2].sum() == pytest.approx(expected, rel=0.3)


@pytest.mark.parametrize("wrong", [{"wheel_change": -1.0}, {"second_wheel_hz": -40.0}, {"wheel_hz": 1e-308}])
def test_a_wheel_that_would_not_run_down_is_refused(wrong: dict[str, float]) -> None:
    keys = {"wheel_hz": 40.0, "wheel_course": "run-down", "wheel_change": 1.0} | wrong
    with pytest.raises(ConfigurationError, match="wheels that run down"):
        quiet(**{f"disturbance__{key}": value for key, value in keys.items()})


def test_harmonics_of_two_wheels_beat() -> None:
    """The sum of two equal harmonics beats at the speed difference: its amplitude is up to twice that of one."""
    one, other = wheels(1, (30.0, 30.5), np.array([2.0]))
    time_s = np.arange(0, 4, 1e-3)
    both = [replace(each, amplitude_nm=np.array([[2.0], *[[0]] * 4]) + 0j) for each in (one, other)]
    total = sum(each.modes_nm(time_s)[:, 0] for each in both)
    envelope = np.abs(total).reshape(-1, 100).max(axis=1)
    # Expected in the middle of each tenth of a second; 900 / 925 is the amplitude at 30 Hz relative to high speed.
    expected = 4 * np.abs(np.cos(np.pi * 0.5 * (0.05 + 0.1 * np.arange(40)))) * 900 / 925
    np.testing.assert_allclose(envelope, expected, atol=0.4)
    config = quiet(disturbance__wheel_hz=30.0, disturbance__second_wheel_hz=0.5)  # relative to the first wheel
    assert [each.start_hz for each in disturbance_of(config).wheels] == [30.0, 30.5]


@pytest.mark.parametrize("exposure", [0.5, 1.0])
def test_sensor_sees_the_mean_of_fast_jitter_over_the_exposure(exposure: float) -> None:
    config = quiet(disturbance__jitter_mas=2.0, camera__exposure_fraction=exposure)
    disturbance = disturbance_of(config)
    assert 500 < disturbance.frequency_hz.min() < disturbance.frequency_hz.max() < 1500
    np.testing.assert_allclose(
        np.sqrt(variances_nm2(disturbance)[1].sum(axis=0))[:3] / NM_PER_MAS, [2, 2, 0], rtol=1e-3
    )
    simulated, samples = scene(config), 2000  # samples per frame period
    for index in (0, 7, 8, 30):
        exposed_nm = modes_nm(disturbance, index * samples, round(exposure * samples) + 1, 1000.0 * samples)
        mean_nm = (exposed_nm[1:] + exposed_nm[:-1]).mean(axis=0) / 2
        assert np.abs(simulated.truth(index, FLAT).sensed_nm - mean_nm)[:2].max() < 0.1


def test_shear_changes_the_image_but_not_the_wavefront() -> None:
    keys = {"camera__noise": False, "camera__gain_e_per_dn": 0.01, "camera__full_well_e": 600.0}
    config = quiet(disturbance__shear=0.002, **keys)
    sheared, disturbance = scene(config), disturbance_of(config)
    series = np.array([shear_at(disturbance, time_s) for time_s in np.arange(0, 100, 0.01)])
    assert series.std(axis=0) == pytest.approx([0.002, 0.002], rel=0.2)
    index = 1000 * int(np.abs(series[::100]).max(axis=1).argmax())  # a frame with large shear
    truth = sheared.truth(index, FLAT)
    # Half of each period is exposed; the shear is that of the exposure's middle.
    np.testing.assert_allclose(truth.shear, shear_at(disturbance, (index + 0.25) / 1000))
    assert truth.sampled.residual_rms_nm == pytest.approx(0, abs=1e-4)
    changed = sheared.expose(index, FLAT).astype(float) - scene(quiet(**keys)).expose(index, FLAT)
    slopes = shear_slopes(config) @ truth.shear
    light_dn = (sheared.expose(index, FLAT).sum() - 100 * 6400) / reference(twin(config, None, print)).sum()
    np.testing.assert_allclose(changed.ravel(), light_dn * slopes, atol=1.5)
    assert np.abs(changed).max() > 25


def test_frames_and_truths_depend_on_the_seed_only() -> None:
    keys = {
        "disturbance__wheel_hz": 40.0,
        "disturbance__second_wheel_hz": 0.7,
        "disturbance__wheel_course": "walk",
        "disturbance__wheel_change": 0.3,
        "disturbance__drift_nm": {"2": 0.1, "5": 0.1},
        "disturbance__jitter_mas": 1.0,
        "disturbance__shear": 0.001,
    }
    runs = []
    for seed, order in ((1, (0, 9, 70)), (1, (70, 0, 9)), (2, (0, 9, 70))):
        simulated = scene(quiet(**keys, seed=seed, camera__noise=False))
        pairs = {index: (simulated.expose(index, FLAT).tobytes(), simulated.truth(index, FLAT)) for index in order}
        runs.append([(pairs[index][0], pairs[index][1].instants_nm.tobytes()) for index in (0, 9, 70)])
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]
    speeds = simulated.truth(70, FLAT).wheel_speed_hz
    assert speeds == pytest.approx([40, 40.7], abs=0.5)
    assert speeds[0] not in (40.0, speeds[1])
