"""Continuous-time residual of a loop: theory against simulations with fine time steps."""

import numpy as np
import pytest

from lowfc.arrays import Array
from lowfc.control.laws.continuous import (
    Timing,
    commanded,
    continuous_residual_nm2,
    held_residual_nm2,
    hold_floor,
    mean_over,
    means_while_applied,
    residual_power,
)
from lowfc.control.laws.kalman import lqg
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.stability import delay_weights
from lowfc.control.laws.vibration import Line, Model
from tools.continuous import RATE_HZ, WHEEL, floor_mas, kalman, residual_mas

FINE = 200
"""Number of time steps in a frame period."""


def integrator_of_tip(gain: float, delay: float) -> LinearLaw:
    return integrator([gain], [0.0], (2,), delay, RATE_HZ)


@pytest.mark.parametrize("timing", [Timing(1, 1, 0.5), Timing(2, 2, 0.9), Timing(1, 0.75, 0.5), Timing(1.4, 1.4, 0.5)])
@pytest.mark.parametrize("omega", [0.05, 0.7, 2.0, 2 * np.pi - 0.7])
def test_the_residual_power_of_a_wave_agrees_with_a_fine_simulation(timing: Timing, omega: float) -> None:
    frames, fine, weights = 1500, (np.arange(FINE) + 0.5) / FINE, delay_weights(timing.delay)

    def sinusoid(times: Array) -> Array:
        return np.sqrt(2) * np.cos(omega * times + 1)

    c, squares = np.zeros(frames), []
    for k in range(frames):
        seen = sum(weight * c[k - 1 - lag] for lag, weight in enumerate(weights))
        c[k] = c[k - 1] - 0.4 * (sinusoid(k + fine[fine < timing.exposure]).mean() + seen)
        if k > frames // 2:
            squares.append(np.mean((sinusoid(k + timing.applied + fine) + c[k]) ** 2))
    residual_nm2 = residual_power(integrator_of_tip(0.4, timing.delay), np.array([omega]), timing)[0, 0]
    assert residual_nm2 == pytest.approx(np.mean(squares), rel=0.01)


@pytest.mark.parametrize(("delay", "exposure"), [(1.0, 0.5), (1.5, 0.5), (2.3, 0.2), (1.4, 1.0)])
def test_the_mirror_moves_within_the_exposure_that_sees_parts_of_two_commands(delay: float, exposure: float) -> None:
    """In the simulation with fine steps, an exposure sees the motion of the mirror."""
    frames, omega, timing = 800, 0.11, Timing.of(delay, exposure)
    sinusoid = np.sqrt(2) * np.cos(omega * np.arange(frames * FINE) / FINE + 1)
    mirror, c = np.zeros(frames * FINE), 0.0
    for k in range(frames):
        exposed = slice(k * FINE, k * FINE + round(exposure * FINE))
        c -= 0.3 * np.mean(sinusoid[exposed] + mirror[exposed])
        mirror[k * FINE + round(timing.applied * FINE) :] = c
    residual_nm2 = np.mean((sinusoid + mirror)[frames // 4 * FINE :] ** 2)
    theory_nm2 = residual_power(integrator_of_tip(0.3, delay), np.array([omega]), timing)[0, 0]
    assert theory_nm2 == pytest.approx(residual_nm2, rel=0.01)


def test_the_floor_is_the_residual_of_the_best_held_value() -> None:
    t = np.linspace(0, 1, 20_001)
    for omega in (0.1, 1.0, 4.0):
        sinusoid = np.exp(1j * omega * t)
        residual = np.trapezoid(np.abs(sinusoid - np.trapezoid(sinusoid, t)) ** 2, t)
        assert hold_floor(np.array([omega]))[0] == pytest.approx(residual, rel=1e-4)
    assert mean_over(np.zeros(1), 1.0)[0] == 1


def test_laws_leave_the_documented_residuals_on_the_ideal_wheel_and_the_best_law_reaches_the_floor() -> None:
    """Residuals are in mas per axis, without noise."""
    instant, blurred = Timing(1, 1, 0), Timing(1, 1, 0.5)
    assert residual_mas(integrator_of_tip(1.11, 1), instant) == pytest.approx(3.528, abs=0.002)
    assert residual_mas(integrator_of_tip(1.11, 1), blurred) == pytest.approx(2.944, abs=0.002)
    assert residual_mas(integrator_of_tip(0.518, 2), Timing(2, 2, 0.5)) == pytest.approx(6.547, abs=0.002)
    assert floor_mas() == pytest.approx(0.7215, abs=1e-4)
    for timing in (instant, blurred, Timing(1, 1, 0.9), Timing(2, 2, 0.5), Timing(1, 0.8, 0.5), Timing(1.5, 1.5, 0.5)):
        assert residual_mas(lqg([WHEEL], (2,), timing), timing) == pytest.approx(floor_mas(), rel=0.02), timing


def test_a_law_for_another_interval_than_that_of_its_command_has_a_larger_residual() -> None:
    instant, blurred = Timing(1, 1, 0), Timing(1, 1, 0.5)
    assert residual_mas(kalman(instant, 1.0, 0.0), instant) == pytest.approx(1.44, abs=0.01)
    assert residual_mas(kalman(blurred, 1.0, 0.5), blurred) == pytest.approx(0.954, abs=0.01)


def test_the_noise_of_an_integrators_command_has_a_closed_form() -> None:
    law, omega = integrator_of_tip(0.4, 1), np.linspace(1e-6, np.pi, 4000)
    power = np.abs(commanded(law, omega, 1))[:, 0] ** 2
    assert np.trapezoid(power, omega) / np.pi == pytest.approx(0.4 / (2 - 0.4), rel=1e-3)


@pytest.mark.parametrize("timing", [Timing(1, 1, 0), Timing(1, 1, 0.5), Timing(2, 2, 0.9), Timing(1.3, 1.3, 0.5)])
def test_means_while_commands_are_in_force_are_interpolated_from_measurements(timing: Timing) -> None:
    """The means are those of sinusoids with frequencies up to a quarter of the frame rate."""
    k = np.arange(400)
    for omega in (0.0, 0.04, 0.5, 1.5):
        sinusoid = np.exp(1j * (omega * k + 0.3))
        measured = sinusoid * mean_over(np.array([omega]), timing.exposure)
        true_means = sinusoid * mean_over(np.array([omega]), 1.0) * np.exp(1j * omega * timing.applied)
        means, response = means_while_applied(measured.real[:, None], timing)
        valid = np.isfinite(means[:, 0])
        assert valid.sum() > 290
        np.testing.assert_allclose(means[valid, 0], true_means.real[valid], atol=2e-3)
        assert response[0] == pytest.approx(1)


def test_the_continuous_residual_is_recovered_from_the_states_at_instants() -> None:
    """The disturbance is a sinusoid, and the mirror holds its shape; the residual at the instants alone is smaller."""
    timing, law, k, omega = Timing.of(1, 0.0), integrator_of_tip(0.5, 1), np.arange(3000), 0.3
    sinusoid = np.sqrt(2) * np.cos(omega * k + 1)
    mirror, c = np.zeros_like(sinusoid), 0.0
    for frame in range(len(k)):
        mirror[frame] = c
        c -= 0.5 * (sinusoid[frame] + c)
    residual_nm2 = continuous_residual_nm2(sinusoid[:, None], mirror[:, None])[500:-100]
    assert np.isfinite(residual_nm2).all()
    assert residual_nm2.mean() == pytest.approx(residual_power(law, np.array([omega]), timing)[0, 0], rel=0.01)
    assert np.mean((sinusoid + mirror)[500:-100] ** 2) < 0.8 * residual_nm2.mean()
    earlier = continuous_residual_nm2(sinusoid[:, None], mirror[:, None], 0.5)[500:-100].mean()
    assert earlier == pytest.approx(residual_power(law, np.array([omega]), Timing(1, 0.5, 0.0))[0, 0], rel=0.01)
    assert Timing.measured(1.0, 0.5, 0.6) == Timing.of(1.0, 0.5)  # 1.1 periods are too late for a delay of one


def test_the_held_residual_is_recovered_from_noisy_measurements() -> None:
    """A sinusoid with 1 nm of white noise: the residual of the means over each command's period agrees with theory."""
    timing, law, rng = Timing(1, 1, 0.5), integrator_of_tip(0.3, 1), np.random.default_rng(3)
    k, omega, frames = np.arange(20_000), 0.2, 20_000
    sinusoid = 2 * np.sqrt(2) * np.exp(1j * (omega * k + 1))
    measured = (sinusoid * mean_over(np.array([omega]), 0.5)).real + rng.standard_normal(frames)
    c, x = np.zeros(frames), 0.0
    for frame in range(frames):
        c[frame] = x = x - 0.3 * (measured[frame] + x)
    squares, counted = held_residual_nm2(law, measured[:, None], c[:, None], np.ones(1), timing)
    theory = 4 * (residual_power(law, np.array([omega]), timing)[0, 0] - hold_floor(np.array([omega]))[0]) + 0.3 / 1.7
    assert squares[0] / counted == pytest.approx(theory, rel=0.03)


def test_mean_over_of_a_model_agrees_with_a_fine_sum() -> None:
    model = Model(1e-3, 40.0, (Line(37.0, 2.0, 9.0), Line(120.0, 1.0, 1.0)), 1.0, RATE_HZ)
    A = model.states()[0]
    values, vectors = np.linalg.eig(A)
    for start, length in ((1.0, 1.0), (0.0, 0.5), (2.4, 1.0)):
        u = start + (np.arange(4000) + 0.5) / 4000 * length
        means = np.array([np.mean(value**u) for value in values.astype(complex)])
        expected = np.real(vectors @ np.diag(means) @ np.linalg.inv(vectors))
        np.testing.assert_allclose(model.mean_over(start, length), expected, atol=1e-6)
    np.testing.assert_allclose(model.mean_over(1.0, 0.0), A, atol=1e-12)
    np.testing.assert_array_equal(model.mean_over(0.0, 0.0), np.eye(6))
