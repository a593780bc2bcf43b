"""Linear laws: what the loop's integrator does, bumpless closing, no wind-up, and shapes that are checked."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.control.laws.law import integrate
from lowfc.control.laws.linear_law import LinearLaw, at_rest, coast, follow, respond
from lowfc.control.laws.pi_notch import Notch, pi_notch
from tests.support.theory import LAWS, integrators, law_of, linear, run

NOLL, RATE_HZ = (2, 3, 4), 1000.0
GAIN, LEAK = np.array([0.5, 0.3, 0.1]), np.array([0.0, 0.01, 0.1])
PLAIN = law_of(GAIN, LEAK, 1e9)
Array = npt.NDArray[np.float64]


def pi(gain: Array, proportional: Array, leak: Array) -> LinearLaw:
    """A PI law without notches."""
    return pi_notch(NOLL, gain, proportional, leak, [()] * len(NOLL), 1.0, RATE_HZ)


def test_the_integrator_as_a_linear_law_is_the_integrator_to_the_bit() -> None:
    law, rng = linear(PLAIN), np.random.default_rng(1)
    x, command = at_rest(law), np.zeros(3, np.float32)
    for error in rng.standard_normal((100, 3)).astype(np.float32):
        x = follow(law, x, error, command)
        command, _ = integrate(PLAIN, command, error)
        np.testing.assert_allclose(respond(law, x), command, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("delay_frames", [1.0, 1.4, 2.0, 3.0])
def test_an_integrator_of_pseudo_open_loop_modes_is_the_same_loop(delay_frames: float) -> None:
    disturbance = np.random.default_rng(2).standard_normal((300, 3))
    modes = list(zip(GAIN / 2, LEAK, strict=True))
    pol, error = integrators(modes, "pol", delay_frames), integrators(modes, "error", delay_frames)
    for one, other in zip(run(pol, disturbance, delay_frames), run(error, disturbance, delay_frames), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)


def test_a_pi_law_follows_its_difference_equation() -> None:
    proportional = np.array([0.2, 0.1, 0.0])
    law, rng = pi(GAIN, proportional, LEAK), np.random.default_rng(3)
    x, kept, before = at_rest(law), np.zeros(3), np.zeros(3)
    for error in rng.standard_normal((50, 3)):
        x = follow(law, x, error.astype(np.float32), kept.astype(np.float32))
        wanted = (1 - LEAK) * (kept + proportional * before) - (GAIN + proportional) * error
        np.testing.assert_allclose(respond(law, x), wanted, atol=1e-5)
        kept, before = np.clip(wanted, -1, 1), error


@pytest.mark.parametrize("name", LAWS)
def test_closing_starts_from_the_held_command(name: str) -> None:
    """A quiet sensor for long, then closed: the first command is the held one, whatever was measured before."""
    law = LAWS[name]
    held = np.array([30, -20, 10], np.float32)
    x = at_rest(law)
    for error in [5.0] * 300 + [0.0] * 2000:
        x = follow(law, x, np.full(3, error, np.float32), held)
    np.testing.assert_allclose(respond(law, x), held, rtol=1e-3)


@pytest.mark.parametrize("name", LAWS)
def test_a_limit_does_not_wind_a_law_up(name: str) -> None:
    """After seconds against a limit the command turns back as soon as the error does."""
    disturbance = np.concatenate([np.full((3000, 3), 50.0), np.full((200, 3), 5.0)])
    errors, commands = run(LAWS[name], disturbance, 1.0, limit_nm=10.0)
    np.testing.assert_allclose(commands[2900:3000], -10, rtol=1e-6)
    free = np.abs(errors[3040:]).max()
    fresh = np.abs(run(LAWS[name], np.full((200, 3), -5.0), 1.0)[0][40:]).max()
    assert free < max(3 * fresh, 0.5)


@pytest.mark.parametrize("frequency_hz", [18, 71])
def test_a_notch_takes_its_line_out(frequency_hz: float) -> None:
    time_s = np.arange(6000) / RATE_HZ
    line = np.repeat(10 * np.sin(2 * np.pi * frequency_hz * time_s)[:, None], 3, axis=1)
    with_notch = run(LAWS["notch"], line, 1.0)[0][3000:]
    without = run(pi(GAIN, 0 * GAIN, 0 * LEAK), line, 1.0)[0][3000:]
    ratio = with_notch.std(axis=0) / without.std(axis=0)
    np.testing.assert_allclose(ratio, 1 / (10 if frequency_hz == 18 else 5), rtol=0.15)


def test_coasting_holds_an_integrator_and_lets_a_resonator_ring() -> None:
    law = LAWS["pi"]
    x, held = at_rest(law), np.array([3, 2, 1], np.float32)
    for _ in range(5):
        x = coast(law, x, held)
    np.testing.assert_allclose(respond(law, x), held, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"signal": "errors"}, "signal of a law must be one of error, pol"),
        ({"measurement_gain": np.zeros((3, 2))}, r"measurement_gain must have shape \(3, 3\), got \(3, 2\)"),
        ({"output": np.zeros((2, 3))}, "output must have shape"),
        ({"predict_only": np.full((3, 3), np.nan)}, "predict_only holds values that are not finite"),
        ({"delay_frames": 0.5}, "a delay is at least 1 frame"),
        ({"rate_hz": 0.0}, "rate_hz must be above 0"),
        ({"noll": (2, 3)}, "gain must have shape"),
    ],
)
def test_a_law_that_does_not_fit_itself_is_refused(change: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        replace(linear(PLAIN), **change)


def test_a_law_is_in_single_precision() -> None:
    law = LAWS["notch"]
    x = follow(law, at_rest(law), np.ones(3, np.float32), np.zeros(3, np.float32))
    assert {law.transition.dtype, x.dtype, respond(law, x).dtype, coast(law, x, x[:3]).dtype} == {np.dtype(np.float32)}


@pytest.mark.parametrize("notch", [Notch(0, 1, 5), Notch(600, 1, 5), Notch(20, 0, 5), Notch(20, 1, 1)])
def test_an_impossible_notch_is_refused(notch: Notch) -> None:
    with pytest.raises(ValueError, match="a notch lies between 0 and 500 Hz"):
        pi_notch(NOLL, GAIN, 0 * GAIN, LEAK, [(notch,), (), ()], 1.0, RATE_HZ)


def test_gains_of_another_number_of_modes_are_refused() -> None:
    with pytest.raises(ValueError, match="proportional must be given for each of 3 modes, got 2"):
        pi(GAIN, GAIN[:2], LEAK)
