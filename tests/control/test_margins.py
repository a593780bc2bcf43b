"""Margins against the integrator's known transfer functions, and against loops that are run."""

from dataclasses import replace

import numpy as np
import pytest

from lowfc.control.laws import stability
from lowfc.control.laws.linear_law import LinearLaw, Signal
from lowfc.control.laws.margins import (
    MOST_COUPLED,
    check_stable,
    margins,
    noise_gain,
    noise_transfer,
    rejection,
    sentence,
)
from lowfc.control.laws.pi_notch import Notch, pi_notch
from tests.support import theory
from tests.support.theory import LAWS, integrators, law_of, linear, run

FREQUENCY_HZ = np.geomspace(0.1, 499, 200)


RATE_HZ = 1000.0


def one(gain: float, delay_frames: float, leak: float = 0.0) -> LinearLaw:
    return linear(law_of(gain, leak, modes=1), (4,), delay_frames)


@pytest.mark.parametrize("delay_frames", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("leak", [0.0, 0.05])
def test_the_integrator_has_the_transfer_functions_of_stability(delay_frames: float, leak: float) -> None:
    law, gain = one(0.3, delay_frames, leak), float(np.float32(0.3))
    expected = theory.rejection(FREQUENCY_HZ, RATE_HZ, gain, leak, delay_frames)
    np.testing.assert_allclose(rejection(law, FREQUENCY_HZ, delay_frames)[:, 0], expected, rtol=1e-5)
    expected = theory.noise_transfer(FREQUENCY_HZ, RATE_HZ, gain, leak, delay_frames)
    np.testing.assert_allclose(noise_transfer(law, FREQUENCY_HZ, delay_frames)[:, 0], expected, rtol=1e-5)
    assert noise_gain(law, delay_frames)[0] == pytest.approx(theory.noise_gain(gain, leak, delay_frames), rel=1e-3)


@pytest.mark.parametrize("delay_frames", [1.0, 1.3, 1.5, 2.0, 3.0])
def test_the_gain_margin_leads_to_the_limiting_gain(delay_frames: float) -> None:
    found = margins(one(0.2, delay_frames), delay_frames)
    assert 0.2 * found.gain_margin[0] == pytest.approx(stability.limiting_gain(delay_frames), rel=1e-4)
    assert found.gain_reduction[0] == 0
    highest = stability.limiting_gain(delay_frames)
    assert margins(one(0.99 * highest, delay_frames), delay_frames).stable
    assert not margins(one(1.01 * highest, delay_frames), delay_frames).stable


def test_margins_of_half_a_gain_and_one_frame() -> None:
    """By hand: L = g / (z - 1), |L| = 1 at 2 sin(w/2) = g; L is never nearer to -1 than at pi, 1 - g/2."""
    found = margins(one(0.5, 1.0), 1.0)
    omega = 2 * np.arcsin(0.25)
    assert found.phase_margin_deg[0] == pytest.approx(np.degrees(np.pi / 2 - omega / 2), abs=0.05)
    assert found.peak[0] == pytest.approx(1 / (1 - 0.25), rel=1e-4)
    assert found.radius[0] == pytest.approx(0.5)
    assert sentence(found) == "gain margin 4, phase margin 76 deg, max |S| 1.33"


def test_the_true_delay_may_differ_from_the_law_s() -> None:
    """A law of pseudo-open-loop modes reckons with its own delay; the loop it closes has the true one."""
    law = integrators([(0.6, 0.0)], "pol", 1.0)
    assert margins(law, 1.0).gain_margin[0] == pytest.approx(2 / 0.6, rel=1e-3)
    # y[k] = c[k-2] - c[k-1], so that c[k] = 0.4 c[k-1] - 0.6 (c[k-2] - c[k-1]) = c[k-1] - 0.6 c[k-2]
    assert margins(law, 2.0).radius[0] == pytest.approx(np.abs(np.roots([1, -1, 0.6])).max(), rel=1e-6)


@pytest.mark.parametrize("gain", [0.3, 0.6, 0.9, 1.2])
@pytest.mark.parametrize("true_frames", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("signal", ["error", "pol"])
def test_stable_is_what_settles(gain: float, true_frames: float, signal: Signal) -> None:
    """Of a step, where the loop sees another delay than the law reckons with."""
    law = integrators([(gain, 0.0)], signal, 1.0)
    found = margins(law, true_frames)
    if abs(found.radius[0] - 1) > 0.03:
        left = run(law, np.ones((400, 1)), true_frames, limit_nm=1e6)[0][-1, 0]
        assert found.stable == (abs(left) < 0.01)


def test_rejection_is_what_a_loop_leaves_of_a_line() -> None:
    law = LAWS["notch"]
    for frequency_hz in (30.0, 71.0, 150.0):
        line = np.repeat(np.sin(2 * np.pi * frequency_hz * np.arange(8000) / RATE_HZ)[:, None], 3, axis=1)
        left = run(law, line, 1.0)[0][4000:].std(axis=0) / line.std(axis=0)
        np.testing.assert_allclose(left, rejection(law, np.array([frequency_hz]), 1.0)[0], rtol=0.02)


def test_a_notch_is_as_deep_and_as_wide_as_it_says() -> None:
    made = pi_notch((4,), np.array([0.3]), np.zeros(1), np.zeros(1), [(Notch(60, 6, 10),)], 1.0, RATE_HZ)
    bare = pi_notch((4,), np.array([0.3]), np.zeros(1), np.zeros(1), [()], 1.0, RATE_HZ)
    at = np.array([57.0, 60.0, 63.0])
    ratio = (rejection(made, at, 1.0) / rejection(bare, at, 1.0))[:, 0]
    assert ratio[1] == pytest.approx(0.1, rel=0.01)
    np.testing.assert_allclose(ratio[[0, 2]], np.sqrt(0.5), rtol=0.25)


def test_modes_of_which_none_moves_count_as_stable() -> None:
    law = one(0.0, 1.0)
    check_stable(law, 1.0)
    found = margins(law, 1.0)
    assert found.stable
    assert found.gain_margin[0] == np.inf
    assert found.phase_margin_deg[0] == 180


def test_an_unstable_law_is_refused_in_a_sentence() -> None:
    with pytest.raises(
        ValueError, match=r"unstable with a delay of 2 frames: closed, Z4 has a pole at 1\.\d+.*made for 1 frames"
    ):
        check_stable(one(1.2, 1.0), 2.0)


def test_a_law_that_runs_away_while_open_is_refused() -> None:
    law = one(0.5, 1.0)
    with pytest.raises(ValueError, match=r"without frames, Z4 has a pole at 1.0100"):
        check_stable(replace(law, predict_only=np.full((1, 1), 1.01)), 1.0)
    growing = replace(law, transition=np.full((1, 1), 1.01), command_gain=law.command_gain - np.float32(1.01))
    with pytest.raises(ValueError, match=r"open, Z4 has a pole at 1\.0100"):
        check_stable(growing, 1.0)


def test_modes_that_a_law_couples_are_taken_with_the_others_closed() -> None:
    """Turning the modes into each other and back is the same loop: poles and |S| of a turned law are known."""
    law = linear(law_of(modes=2), (4, 5))
    turn = np.array([[0.8, -0.6], [0.6, 0.8]], np.float32)
    turned = replace(
        law, measurement_gain=turn @ law.measurement_gain @ turn.T, command_gain=turn @ law.command_gain @ turn.T
    )
    found = margins(turned, 1.0)
    np.testing.assert_allclose(found.radius, 0.5, rtol=1e-5)
    np.testing.assert_allclose(found.gain_margin, 4, rtol=1e-3)
    np.testing.assert_allclose(rejection(turned, FREQUENCY_HZ, 1.0), rejection(law, FREQUENCY_HZ, 1.0), rtol=1e-4)


def test_a_law_that_is_one_large_system_is_refused_at_once() -> None:
    states, ones = MOST_COUPLED + 1, np.ones((MOST_COUPLED + 1, 1), np.float32)
    dense = np.full((states, states), 1e-3, np.float32)
    law = LinearLaw("error", dense, ones, 0 * ones, dense, -ones.T, "dense", (4,), 1.0, RATE_HZ)
    with pytest.raises(ValueError, match="have to do with each other"):
        check_stable(law, 1.0)
