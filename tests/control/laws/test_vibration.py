"""Models of drift, lines and noise identified from known processes, and their LQG residuals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.fft import fft, ifft, irfft

from lowfc.arrays import Array
from lowfc.control.laws.continuous import Timing
from lowfc.control.laws.kalman import covariance_nm2, lqg
from lowfc.control.laws.margins import check_stable, rejection
from lowfc.control.laws.spectra import TimeSeries
from lowfc.control.laws.tuning import predicted_nm
from lowfc.control.laws.vibration import FEWEST, Line, Model, identify, resolution_hz
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from sim_camera.disturbance import LINES_HZ, preset_disturbance
from tests.support.theory import modes_nm, one_piece, realised, run

RATE_HZ = 1000.0
NM_PER_MAS = tilt_nm_per_mas(2.0)
SAMPLED = Timing.sampled(1.0)


def ideal_wheel() -> TimeSeries:
    """Tilt Z2 (frames, 1), nm, of the ideal reaction wheel, measured with white noise."""
    simulated = preset_disturbance("reaction-wheel-ideal", (2, 3, 4), 1, NM_PER_MAS, 550.0)
    noise = 0.8 * np.random.default_rng(1).standard_normal((12_000, 1))
    return one_piece(modes_nm(simulated, 0, 12_000, RATE_HZ)[:, :1] + noise)


def test_the_lines_of_the_reaction_wheel_are_identified() -> None:
    model = identify(ideal_wheel(), RATE_HZ)
    assert [line.frequency_hz for line in model.lines] == pytest.approx(LINES_HZ, abs=0.02)
    rms_mas = [np.sqrt(line.variance_nm2) / NM_PER_MAS for line in model.lines]
    assert rms_mas == pytest.approx([9.0, 8.3, 5.0, 3.0, 2.0], rel=0.06)
    assert np.sqrt(model.noise_nm2) == pytest.approx(0.8, rel=0.03)
    assert all(line.width_hz < RATE_HZ / 12_000 for line in model.lines)


def test_width_and_power_of_damped_lines_are_identified() -> None:
    truth = Model(1e-4, np.inf, (Line(20, 0.8, 25.0), Line(60, 2.5, 9.0)), 0.5, RATE_HZ)
    model = identify(one_piece(realised(truth, 40_000)), RATE_HZ)
    assert [line.frequency_hz for line in model.lines] == pytest.approx([20, 60], rel=0.01)
    assert [line.width_hz for line in model.lines] == pytest.approx([0.8, 2.5], rel=0.35)
    assert [line.variance_nm2 for line in model.lines] == pytest.approx([25, 9], rel=0.35)
    assert model.noise_nm2 == pytest.approx(0.5, rel=0.05)


def test_a_wide_line_stays_below_half_of_the_frame_rate() -> None:
    truth = Model(1e-8, np.inf, (Line(485, 120, 25.0),), 0.09, RATE_HZ)
    (line,) = identify(one_piece(realised(truth, 4096, 13)), RATE_HZ).lines
    assert 450 < line.frequency_hz < RATE_HZ / 2


def test_no_line_is_identified_in_noise() -> None:
    for seed in range(5):
        noise = np.random.default_rng(seed).standard_normal((4096, 1))
        model = identify(one_piece(noise), RATE_HZ)
        assert model.lines == ()
        assert model.noise_nm2 == pytest.approx(1, rel=0.1)


def test_the_spectrum_of_a_model_agrees_with_its_states() -> None:
    """The expected values are from the transfer function of the states, which shares no code with `spectrum_nm2`."""
    model = Model(0.01, 5.0, (Line(20, 0.8, 25.0), Line(60, 2.5, 9.0)), 0.5, RATE_HZ)
    F, Q, C = model.states()
    omega = np.array([0.01, 0.1257, 0.3, 0.377, 2.0])
    spectrum_nm2 = []
    for z in np.exp(1j * omega):
        passed = C @ np.linalg.inv(np.eye(len(F)) - F / z)
        spectrum_nm2.append(float((passed @ Q @ passed.conj()).real))
    np.testing.assert_allclose(model.spectrum_nm2(omega), spectrum_nm2, rtol=1e-6)


def test_lines_are_identified_in_two_pieces_and_not_in_a_piece_that_is_too_short() -> None:
    whole = ideal_wheel().values[0]
    model = identify(TimeSeries((whole[:6000], whole[6000:]), 0), RATE_HZ)
    assert [round(line.frequency_hz) for line in model.lines] == [6, 18, 37, 71, 117]
    assert identify(one_piece(whole[: FEWEST - 1]), RATE_HZ) is None
    assert resolution_hz(one_piece(whole), RATE_HZ) == RATE_HZ / 12_000
    assert resolution_hz(TimeSeries((), 0), RATE_HZ) == 0


def test_a_slow_mode_is_identified_as_drift() -> None:
    simulated = preset_disturbance("thermal", (4,), 3, NM_PER_MAS, 550.0)
    noise = 0.5 * np.random.default_rng(3).standard_normal((20_000, 1))
    model = identify(one_piece(modes_nm(simulated, 0, 20_000, RATE_HZ) + noise), RATE_HZ)
    assert all(line.frequency_hz < 1 for line in model.lines)
    assert model.drift_nm2 > 0
    assert model.noise_nm2 == pytest.approx(0.25, rel=0.05)


@pytest.mark.parametrize(("drift_nm2", "cutoff_hz", "frames"), [(1e-4, np.inf, 2048), (1.0, 0.5, 20_000)])
def test_the_drift_is_identified_down_to_the_lowest_frequencies(
    drift_nm2: float, cutoff_hz: float, frames: int
) -> None:
    truth, omega = Model(drift_nm2, cutoff_hz, (), 1.0, 250.0), 2 * np.pi * np.array([4, 8, 16]) / frames
    models = [identify(TimeSeries((realised(truth, frames, seed),), 0), 250.0) for seed in range(4)]
    ratio = [(model.spectrum_nm2(omega) + model.noise_nm2) / (truth.spectrum_nm2(omega) + 1) for model in models]
    assert np.exp(np.mean(np.log(ratio), axis=0)) == pytest.approx(1, rel=0.35)


def test_drift_is_not_identified_as_a_line() -> None:
    """The star is bright; the drift, up to 1 Hz, hardly exceeds the noise above this band."""
    simulated = preset_disturbance("thermal", tuple(range(2, 16)), 1, NM_PER_MAS, 550.0)
    drift = modes_nm(simulated, 0, 15_000, 250.0)
    noise = 0.2 * np.random.default_rng(1).standard_normal(drift.shape)
    model = identify(TimeSeries(((drift + noise)[:, :1],), 0), 250.0)
    assert model.spectrum_nm2(np.array([2 * np.pi * 2 / 250])) < model.noise_nm2


@pytest.mark.parametrize(("lines", "seed"), [((), 1), (LINES_HZ, 3)])
def test_a_model_without_noise_still_gives_a_stable_filter(lines: tuple[float, ...], seed: int) -> None:
    truth = Model(1.0, 50.0, tuple(Line(hz, 1e-3, 100.0) for hz in lines), 1e-12, RATE_HZ)
    model = identify(one_piece(realised(truth, 4096, seed)), RATE_HZ)
    assert model.noise_nm2 > 1e-8
    check_stable(lqg([model], (2,), SAMPLED), 1.0)


MODEL = Model(0.02, 5.0, (Line(18, 0.3, 60.0), Line(71, 0.5, 20.0)), 0.7, RATE_HZ)


def minimum_variance_nm2(spectrum_nm2: Array, noise_nm2: float, whole_frames: int) -> float:
    """Least residual variance of any linear law, for a known spectrum of the disturbance and a delay of whole frames.

    Kolmogorov's method: the spectrum of the measurements is factored into white innovations, of variance
    exp(mean(log(spectrum + noise))), and a filter 1 + h1/z + ...; innovations after the command are lost.
    The spectrum (frequencies,) is at even steps from 0 to pi rad per frame, both included.
    """
    cepstrum = irfft(np.log(spectrum_nm2 + noise_nm2))
    innovation = float(np.exp(cepstrum[0]))
    causal = np.zeros_like(cepstrum)
    causal[1 : len(causal) // 2] = cepstrum[1 : len(causal) // 2]
    factor = ifft(np.exp(fft(causal))).real
    return innovation * float(np.sum(factor[:whole_frames] ** 2)) - noise_nm2


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_three_predictions_of_the_residual_agree(delay: int) -> None:
    """They follow from the Riccati equation, the law's transfer functions, and the factored spectrum."""
    (A, Q, C), covariance, timing = MODEL.states(), covariance_nm2(MODEL), Timing.sampled(delay)
    for _ in range(delay - 1):  # further frames without a measurement
        covariance = A @ covariance @ A.T + Q
    riccati = C @ covariance @ C
    assert predicted_nm(lqg([MODEL], (2,), timing), [MODEL], timing)[0] ** 2 == pytest.approx(riccati, rel=0.01)
    omega = np.linspace(0, np.pi, (1 << 18) + 1)
    spectrum = MODEL.spectrum_nm2(np.maximum(omega, omega[1] / 2))
    assert minimum_variance_nm2(spectrum, MODEL.noise_nm2, delay) == pytest.approx(riccati, rel=0.02)


@pytest.fixture(scope="module")
def noisy_nm() -> Array:
    """Measurements (frames, 1) of a process with `MODEL`."""
    return realised(MODEL, 16_000, seed=4)


@pytest.mark.parametrize("delay_frames", [1.0, 1.5, 1.8])
def test_a_loop_leaves_the_predicted_residual(noisy_nm: Array, delay_frames: float) -> None:
    law = lqg([MODEL], (2,), Timing.sampled(delay_frames))
    check_stable(law, delay_frames)
    errors, _ = run(law, noisy_nm, delay_frames)
    residual_nm2 = np.mean(errors[2000:] ** 2) - MODEL.noise_nm2
    assert np.sqrt(residual_nm2) == pytest.approx(predicted_nm(law, [MODEL], Timing.sampled(delay_frames))[0], rel=0.1)


def test_a_constant_disturbance_is_rejected() -> None:
    law = lqg([replace(MODEL, drift_nm2=1e-6)], (2,), SAMPLED)
    assert rejection(law, np.array([1e-4]), 1.0)[0, 0] < 0.01


@pytest.mark.parametrize("noise_nm2", [1e-4, 0.7, 100.0])
@pytest.mark.parametrize("width_hz", [1e-9, 1e-6, 1e-2, 3.0])
def test_the_covariance_solves_the_riccati_equation(width_hz: float, noise_nm2: float) -> None:
    """Narrow lines put poles close to the unit circle, wide lines put them further inside."""
    lines = tuple(Line(frequency, width_hz, 1e-3 * frequency) for frequency in (0.3, 6, 6.5, 18, 117))
    model = Model(1e-8, 0.2, lines, noise_nm2, RATE_HZ)
    A, Q, C = model.states()
    covariance = covariance_nm2(model)
    gain = covariance @ C / (C @ covariance @ C + noise_nm2)
    after = covariance - np.outer(gain, C @ covariance)
    np.testing.assert_allclose(A @ after @ A.T + Q, covariance, rtol=1e-6, atol=1e-12 * covariance.max())
    assert np.abs(np.linalg.eigvals(A - np.outer(gain, C @ A))).max() < 1


def test_a_law_from_models_with_two_frame_rates_is_refused() -> None:
    with pytest.raises(ValueError, match=r"one frame rate, got \[500.0, 1000.0\]"):
        lqg([MODEL, replace(MODEL, rate_hz=500.0)], (2, 3), SAMPLED)
