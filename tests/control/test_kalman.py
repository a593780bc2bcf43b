"""LQG: what it leaves against Riccati, Kolmogorov and a loop that is run, for whole and fractional delays."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.fft import fft, ifft, irfft

from lowfc.control.laws.kalman import covariance_nm2, lqg
from lowfc.control.laws.margins import check_stable, margins, rejection
from lowfc.control.laws.tuning import predicted_nm
from lowfc.control.laws.vibration import Line, Model
from tests.support.theory import integrators, realised, run

RATE_HZ = 1000.0
MODEL = Model(0.02, 5.0, (Line(18, 0.3, 60.0), Line(71, 0.5, 20.0)), 0.7, RATE_HZ)
Array = npt.NDArray[np.float64]


def residual_nm2(model: Model, whole_frames: int) -> float:
    """Variance that the law leaves, if the model is true, for a delay of whole frames: Riccati's, that far ahead."""
    A, Q, C = model.states()
    covariance = covariance_nm2(model)
    L = covariance @ C / (C @ covariance @ C + model.noise_nm2)
    covariance = covariance - np.outer(L, C @ covariance)
    for _ in range(whole_frames):
        covariance = A @ covariance @ A.T + Q
    return float(C @ covariance @ C)


def minimum_variance_nm2(spectrum_nm2: Array, noise_nm2: float, whole_frames: int) -> float:
    """Least variance that any linear law can leave of a disturbance of known spectrum, for a delay of whole frames.

    Kolmogorov's: the spectrum of what is measured is factored into white innovations, of variance
    exp(mean(log(spectrum + noise))), and a filter 1 + h1/z + ...; those that come after the command was made are lost.
    The spectrum (frequencies,) is at even steps from 0 to pi rad per frame, both included.
    """
    cepstrum = irfft(np.log(spectrum_nm2 + noise_nm2))
    innovation = float(np.exp(cepstrum[0]))
    causal = np.zeros_like(cepstrum)
    causal[1 : len(causal) // 2] = cepstrum[1 : len(causal) // 2]
    factor = ifft(np.exp(fft(causal))).real
    return innovation * float(np.sum(factor[:whole_frames] ** 2)) - noise_nm2


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_what_is_predicted_is_the_same_by_three_roads(delay: int) -> None:
    """Riccati's covariance, the law's own transfer functions, and the factor of the spectrum."""
    riccati = residual_nm2(MODEL, delay)
    assert predicted_nm(lqg([MODEL], (2,), delay), [MODEL], delay)[0] ** 2 == pytest.approx(riccati, rel=0.01)
    omega = np.linspace(0, np.pi, (1 << 18) + 1)
    spectrum = MODEL.spectrum_nm2(np.maximum(omega, omega[1] / 2))
    assert minimum_variance_nm2(spectrum, MODEL.noise_nm2, delay) == pytest.approx(riccati, rel=0.02)


@pytest.mark.parametrize("delay_frames", [1.0, 1.3, 1.5, 1.8, 2.0])
def test_a_loop_leaves_what_is_predicted(delay_frames: float) -> None:
    law = lqg([MODEL], (2,), delay_frames)
    check_stable(law, delay_frames)
    frames = 30_000
    noisy = realised(MODEL, frames, seed=4)
    noise = np.sqrt(MODEL.noise_nm2)
    errors, _ = run(law, noisy, delay_frames)
    left = np.mean(errors[2000:] ** 2) - noise**2
    assert np.sqrt(left) == pytest.approx(predicted_nm(law, [MODEL], delay_frames)[0], rel=0.1)


def test_a_fraction_of_a_frame_costs_something_in_between() -> None:
    delays = [1.0, 1.25, 1.5, 1.75, 2.0]
    left = [predicted_nm(lqg([MODEL], (2,), delay), [MODEL], delay)[0] for delay in delays]
    assert left[0] * 0.999 < left[1]
    assert left == sorted(left) or max(np.diff(left)) > 0
    assert left[2] < left[4] * 1.001
    assert left[3] < left[4] * 1.2


def test_no_integrator_comes_near() -> None:
    best = min(predicted_nm(integrators([(g, 0.0)], "error", 1.0), [MODEL], 1.0)[0] for g in np.arange(0.1, 1.5, 0.1))
    assert np.sqrt(residual_nm2(MODEL, 1)) < 0.5 * best


def test_a_constant_is_taken_out_whatever_the_noise() -> None:
    law = lqg([replace(MODEL, drift_nm2=1e-6)], (2,), 1.0)
    assert rejection(law, np.array([1e-4]), 1.0)[0, 0] < 0.01


@pytest.mark.parametrize("noise_nm2", [1e-4, 0.7, 100.0])
@pytest.mark.parametrize("width_hz", [1e-9, 1e-6, 1e-2, 3.0])
def test_the_covariance_solves_riccatis_equation(width_hz: float, noise_nm2: float) -> None:
    """With poles at any distance from the unit circle; where scipy finds a solution, it is the same."""
    lines = tuple(Line(frequency, width_hz, 1e-3 * frequency) for frequency in (0.3, 6, 6.5, 18, 117))
    model = Model(1e-8, 0.2, lines, noise_nm2, RATE_HZ)
    A, Q, C = model.states()
    covariance = covariance_nm2(model)
    gain = covariance @ C / (C @ covariance @ C + noise_nm2)
    after = covariance - np.outer(gain, C @ covariance)
    np.testing.assert_allclose(A @ after @ A.T + Q, covariance, rtol=1e-6, atol=1e-12 * covariance.max())
    assert np.abs(np.linalg.eigvals(A - np.outer(gain, C @ A))).max() < 1


def test_lines_all_but_undamped_have_a_filter_within_the_unit_circle() -> None:
    lines = tuple(Line(frequency, 1e-6, 100.0) for frequency in (6, 18, 37, 71, 117))
    law = lqg([replace(MODEL, lines=lines)], (2,), 2.0)
    found = margins(law, 2.0)
    assert found.stable
    assert found.gain_margin[0] > 2
    assert np.linalg.eigvalsh(covariance_nm2(replace(MODEL, lines=lines))).min() > 0


def test_models_of_two_rates_are_refused() -> None:
    with pytest.raises(ValueError, match=r"one frame rate, got \[500.0, 1000.0\]"):
        lqg([MODEL, replace(MODEL, rate_hz=500.0)], (2, 3), 1.0)


def test_the_least_variance_of_white_noise_is_its_own() -> None:
    """Nothing of it can be foreseen; of a random walk with little noise, one frame ahead, its own step is lost."""
    assert minimum_variance_nm2(np.full(4097, 4.0), 1.0, 1) == pytest.approx(4.0)
    omega = np.linspace(0, np.pi, (1 << 16) + 1)
    walk = 0.01 / (4 * np.sin(np.maximum(omega, omega[1] / 2) / 2) ** 2)
    assert minimum_variance_nm2(walk, 1e-9, 1) == pytest.approx(0.01, rel=0.05)
    assert minimum_variance_nm2(walk, 1e-9, 3) == pytest.approx(0.03, rel=0.05)
