"""Law and transfer functions: what is predicted is what `advance` does."""

import numpy as np
import pytest

from lowfc.control.laws.law import Law, integrate
from lowfc.control.laws.stability import delay_weights, limiting_gain
from lowfc.control.loop.safety import Limits
from lowfc.control.loop.state import Settings
from tests.support.theory import law_of, noise_gain, rejection
from tests.support.toy import live, settings

RATE_HZ = 1000.0
WIDE = {"limits": Limits(7000.0, 7000.0, 7000.0), "limit_nm": (5000.0, 5000.0)}


def test_the_integrator_is_what_the_design_says() -> None:
    command, error = np.array([10, -20, 0], np.float32), np.array([4, 4, -8], np.float32)
    after, cut = integrate(law_of(leak=0.1), command, error)
    assert after.tolist() == pytest.approx([7, -20, 4], abs=1e-5)
    assert cut is False
    assert after.dtype == np.float32


def test_each_mode_is_cut_at_its_own_limit() -> None:
    uneven = law_of(1.0, 0.0, [5, 50, 500])
    after, cut = integrate(uneven, np.zeros(3, np.float32), np.array([-60, 60, -60], np.float32))
    assert after.tolist() == [5, -50, 60]
    assert cut is True


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gain": -0.1}, "gain"),
        ({"gain": np.nan}, "gain"),
        ({"leak": 1.1}, "leak"),
        ({"leak": -0.1}, "leak"),
        ({"limit_nm": -1.0}, "limit_nm"),
    ],
)
def test_a_law_out_of_range_is_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        law_of(**change)


def test_a_law_of_uneven_lengths_is_refused() -> None:
    with pytest.raises(ValueError, match="as long as each other"):
        Law(np.zeros(3, np.float32), np.zeros(2, np.float32), np.zeros(3, np.float32))


@pytest.mark.parametrize(
    ("delay", "expected"), [(1, [1]), (2, [0, 1]), (3, [0, 0, 1]), (1.25, [0.75, 0.25]), (2.5, [0, 0.5, 0.5])]
)
def test_delay_weights(delay: float, expected: list[float]) -> None:
    assert delay_weights(delay).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("delay", [0.99, 0, -1, np.nan, np.inf])
def test_a_delay_below_one_frame_is_refused(delay: float) -> None:
    with pytest.raises(ValueError, match="at least 1 frame"):
        delay_weights(delay)


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_the_limiting_gain_of_whole_delays(delay: int) -> None:
    assert limiting_gain(delay) == pytest.approx(2 * np.sin(np.pi / (2 * (2 * delay - 1))), abs=1e-6)


def spectral_radius(gain: float, leak: float, delay: float) -> float:
    """Largest pole of the loop, from its state matrix: an independent way to its stability."""
    weights = delay_weights(delay)
    matrix = np.zeros((len(weights), len(weights)))
    matrix[0] = -gain * weights
    matrix[0, 0] += 1 - leak
    matrix[1:, :-1] += np.eye(len(weights) - 1)
    return float(np.abs(np.linalg.eigvals(matrix)).max())


@pytest.mark.parametrize("delay", [1, 1.3, 1.5, 1.9, 2, 2.5, 3])
@pytest.mark.parametrize("leak", [0.0, 0.01, 0.3])
def test_the_limiting_gain_is_where_a_pole_leaves_the_unit_circle(delay: float, leak: float) -> None:
    highest = limiting_gain(delay, leak)
    assert spectral_radius(highest * (1 - 1e-6), leak, delay) < 1
    assert spectral_radius(highest * (1 + 1e-6), leak, delay) > 1


def run(what: Settings, disturbance_nm: np.ndarray, noise_nm: np.ndarray | float = 0.0) -> np.ndarray:
    """Residual (frames, modes) of the loop closed through `advance`, of which nothing but the law makes the command."""
    steps, residual_nm, _ = live(what, disturbance_nm, noise_nm)
    assert all(step.reasons == () for step in steps)
    return residual_nm


@pytest.mark.parametrize("delay", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("frequency_hz", [5.0, 40.0, 125.0])
def test_a_sine_wave_is_rejected_as_predicted(delay: float, frequency_hz: float) -> None:
    gain, leak, frames = 0.4, 0.01, 800
    phase = 2 * np.pi * frequency_hz / RATE_HZ * np.arange(frames)
    disturbance = np.zeros((frames, 3))
    disturbance[:, 0] = 20 * np.sin(phase)
    what = settings(delay_frames=delay, gain=(gain, 0.0), leak=(leak, 0.0), **WIDE)
    settled = slice(200, None)  # a whole number of periods
    measured = 2 * np.abs(np.mean(run(what, disturbance)[settled, 0] * np.exp(-1j * phase[settled]))) / 20
    assert measured == pytest.approx(rejection(np.array([frequency_hz]), RATE_HZ, gain, leak, delay)[0], rel=0.01)


@pytest.mark.parametrize(("gain", "delay"), [(0.1, 1.0), (0.5, 1.0), (0.3, 2.0)])
def test_measurement_noise_is_passed_on_as_predicted(gain: float, delay: float) -> None:
    rng = np.random.default_rng(2)
    noise = 10 * rng.standard_normal((4000, 3))
    what = settings(delay_frames=delay, gain=(gain, gain), **WIDE)
    residual = run(what, np.zeros_like(noise), noise)[200:]
    # Three modes with some 3800 gain / 2 independent values each: about 5 % at the lowest gain, 4 standard errors.
    assert np.mean(residual**2) / 100 == pytest.approx(noise_gain(gain, 0.0, delay), rel=0.2)


def test_the_noise_gain_of_the_shortest_delay_is_known_in_closed_form() -> None:
    for gain in (0.05, 0.5, 1.0, 1.5):
        assert noise_gain(gain, 0.0, 1.0) == pytest.approx(gain / (2 - gain), rel=1e-3)
    assert noise_gain(0.0, 0.0, 1.0) == 0


@pytest.mark.parametrize("delay", [1.0, 1.5, 2.0, 3.0])
def test_pseudo_open_loop_is_the_disturbance_while_the_loop_settles(delay: float) -> None:
    what = settings(delay_frames=delay, gain=(0.3, 0.2), leak=(0.01, 0.0))
    still = np.array([12.0, -7.0, 5.0])
    steps, _, _ = live(what, np.tile(still, (60, 1)))
    for step in steps:
        assert np.abs(step.pol_nm - still).max() < 0.05
    assert np.abs(steps[-1].command_nm + still * [0.3 / 0.31, 0.3 / 0.31, 1]).max() < 0.05
