"""Laws, their margins and their stability, against hand calculations, theory and simulated loops."""

from dataclasses import replace

import numpy as np
import pytest

from lowfc.arrays import Array
from lowfc.control.laws.integrator import integrate
from lowfc.control.laws.linear_law import LinearLaw, Signal, at_rest, predict, predict_and_update, respond
from lowfc.control.laws.margins import MAX_COUPLED_STATES, check_stable, margins, noise_gain, noise_transfer, rejection
from lowfc.control.laws.pi_notch import Notch, pi_notch
from lowfc.control.laws.stability import delay_weights, limiting_gain
from tests.support import theory
from tests.support.theory import LAWS, integrators, law_of, linear, run
from tests.support.toy import run_toy, settings

RATE_HZ = 1000.0


def test_the_integrator_subtracts_gain_times_error_from_the_leaked_command() -> None:
    command, error = np.array([10, -20, 0], np.float32), np.array([4, 4, -8], np.float32)
    after, clipped = integrate(law_of(leak=0.1), command, error)
    assert after.tolist() == pytest.approx([7, -20, 4], abs=1e-5)
    assert clipped is False
    assert after.dtype == np.float32


def test_each_mode_is_clipped_at_its_own_limit() -> None:
    uneven = law_of(1.0, 0.0, [5, 50, 500])
    after, clipped = integrate(uneven, np.zeros(3, np.float32), np.array([-60, 60, -60], np.float32))
    assert after.tolist() == [5, -50, 60]
    assert clipped is True


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
def test_an_integrator_with_a_value_out_of_range_is_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        law_of(**change)


@pytest.mark.parametrize(
    ("delay", "expected"), [(1, [1]), (2, [0, 1]), (3, [0, 0, 1]), (1.25, [0.75, 0.25]), (2.5, [0, 0.5, 0.5])]
)
def test_delay_weights_divide_an_exposure_among_the_commands_that_it_sees(delay: float, expected: list[float]) -> None:
    assert delay_weights(delay).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("delay", [0.99, 0, -1, np.nan, np.inf, 1e12])
def test_an_impossible_delay_is_refused(delay: float) -> None:
    with pytest.raises(ValueError, match="at least 1 frame"):
        delay_weights(delay)


@pytest.mark.parametrize("delay", [1.0, 1.5, 2.0, 3.0])
def test_pseudo_open_loop_modes_equal_the_disturbance(delay: float) -> None:
    setup = settings(delay_frames=delay, gain=(0.3, 0.2), leak=(0.01, 0.0))
    constant = np.array([12.0, -7.0, 5.0])
    steps, _, _ = run_toy(setup, np.tile(constant, (60, 1)))
    for step in steps:
        assert np.abs(step.pol_nm - constant).max() < 0.05
    assert np.abs(steps[-1].command_nm + constant * [0.3 / 0.31, 0.3 / 0.31, 1]).max() < 0.05


NOLL = (2, 3, 4)
GAIN, LEAK = np.array([0.5, 0.3, 0.1]), np.array([0.0, 0.01, 0.1])
PLAIN = law_of(GAIN, LEAK, 1e9)


def pi(gain: Array, proportional: Array, leak: Array) -> LinearLaw:
    """A PI law without notches."""
    return pi_notch(NOLL, gain, proportional, leak, [()] * len(NOLL), 1.0, RATE_HZ)


def test_the_integrator_and_its_linear_law_give_the_same_commands_to_single_precision() -> None:
    law, rng = linear(PLAIN), np.random.default_rng(1)
    x, command = at_rest(law), np.zeros(3, np.float32)
    for error in rng.standard_normal((100, 3)).astype(np.float32):
        x = predict_and_update(law, x, error, command)
        command, _ = integrate(PLAIN, command, error)
        np.testing.assert_allclose(respond(law, x), command, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("delay_frames", [1.0, 1.4, 2.0, 3.0])
def test_an_integrator_of_pseudo_open_loop_modes_commands_like_an_integrator_of_the_error(delay_frames: float) -> None:
    disturbance = np.random.default_rng(2).standard_normal((300, 3))
    modes = list(zip(GAIN / 2, LEAK, strict=True))
    pol, error = integrators(modes, "pol", delay_frames), integrators(modes, "error", delay_frames)
    for from_pol, from_error in zip(
        run(pol, disturbance, delay_frames), run(error, disturbance, delay_frames), strict=True
    ):
        np.testing.assert_allclose(from_pol, from_error, atol=1e-4)


def test_a_pi_law_follows_its_difference_equation() -> None:
    proportional = np.array([0.2, 0.1, 0.0])
    law, rng = pi(GAIN, proportional, LEAK), np.random.default_rng(3)
    x, command, before = at_rest(law), np.zeros(3), np.zeros(3)
    for error in rng.standard_normal((50, 3)):
        x = predict_and_update(law, x, error.astype(np.float32), command.astype(np.float32))
        expected = (1 - LEAK) * (command + proportional * before) - (GAIN + proportional) * error
        np.testing.assert_allclose(respond(law, x), expected, atol=1e-5)
        command, before = np.clip(expected, -1, 1), error


@pytest.mark.parametrize("name", LAWS)
def test_a_law_starts_from_the_held_command_when_the_loop_closes(name: str) -> None:
    """After a long time without errors, the first command is the held one, whatever was measured before."""
    law = LAWS[name]
    held = np.array([30, -20, 10], np.float32)
    x = at_rest(law)
    for error in [5.0] * 300 + [0.0] * 2000:
        x = predict_and_update(law, x, np.full(3, error, np.float32), held)
    np.testing.assert_allclose(respond(law, x), held, rtol=1e-3)


@pytest.mark.parametrize("name", LAWS)
def test_a_limit_causes_no_wind_up(name: str) -> None:
    """After 3 s at a limit, the loop settles about as fast as from rest."""
    disturbance = np.concatenate([np.full((3000, 3), 50.0), np.full((200, 3), 5.0)])
    errors, commands = run(LAWS[name], disturbance, 1.0, limit_nm=10.0)
    np.testing.assert_allclose(commands[2900:3000], -10, rtol=1e-6)
    after_limit = np.abs(errors[3040:]).max()
    from_rest = np.abs(run(LAWS[name], np.full((200, 3), -5.0), 1.0)[0][40:]).max()
    assert after_limit < max(3 * from_rest, 0.5)


def test_a_pi_law_holds_its_command_while_frames_are_missing() -> None:
    law = LAWS["pi"]
    x, held = at_rest(law), np.array([3, 2, 1], np.float32)
    for _ in range(5):
        x = predict(law, x, held)
    np.testing.assert_allclose(respond(law, x), held, rtol=1e-6)


@pytest.mark.parametrize(
    ("gain", "delay_frames", "change"),
    [(0.5, 1.0, 1e-5), (0.5, 1.5, 1e-5), (0.5, 2.0, 1e-5), (1.11, 1.0, 0.05), (1.357, 1.1, 0.09)],
)
def test_an_integrator_of_pol_holds_its_command_while_frames_are_missing(
    gain: float, delay_frames: float, change: float
) -> None:
    law = integrators([(gain, 0.0)], "pol", delay_frames)
    check_stable(law, delay_frames)
    x, commands = at_rest(law), [np.zeros(1, np.float32)]
    for pol in (5, 3, 4, *20 * [None]):
        y = np.array([pol], np.float32)
        x = predict(law, x, commands[-1]) if pol is None else predict_and_update(law, x, y, commands[-1])
        commands.append(respond(law, x))
    np.testing.assert_allclose(commands[-1], commands[-2], rtol=1e-5)
    np.testing.assert_allclose(commands[4:], commands[3].item(), rtol=change)


@pytest.mark.parametrize(
    ("change", "message"),
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
def test_a_law_with_inconsistent_fields_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(linear(PLAIN), **change)


def test_a_law_computes_in_single_precision() -> None:
    law = LAWS["notch"]
    x = predict_and_update(law, at_rest(law), np.ones(3, np.float32), np.zeros(3, np.float32))
    assert {each.dtype for each in (law.transition, x, respond(law, x), predict(law, x, x[:3]))} == {np.dtype("f4")}


@pytest.mark.parametrize("notch", [Notch(0, 1, 5), Notch(600, 1, 5), Notch(20, 0, 5), Notch(20, 1, 1)])
def test_an_impossible_notch_is_refused(notch: Notch) -> None:
    with pytest.raises(ValueError, match="a notch lies between 0 and 500 Hz"):
        pi_notch(NOLL, GAIN, 0 * GAIN, LEAK, [(notch,), (), ()], 1.0, RATE_HZ)


def test_gains_for_the_wrong_number_of_modes_are_refused() -> None:
    with pytest.raises(ValueError, match="proportional must be given for each of 3 modes, got 2"):
        pi(GAIN, GAIN[:2], LEAK)


FREQUENCY_HZ = np.geomspace(0.1, 499, 200)


def one_mode_law(gain: float, delay_frames: float, leak: float = 0.0) -> LinearLaw:
    return linear(law_of(gain, leak, modes=1), (4,), delay_frames)


@pytest.mark.parametrize("delay_frames", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("leak", [0.0, 0.05])
def test_the_transfer_functions_of_the_integrator_agree_with_theory(delay_frames: float, leak: float) -> None:
    law, gain = one_mode_law(0.3, delay_frames, leak), float(np.float32(0.3))
    expected = theory.rejection(FREQUENCY_HZ, RATE_HZ, gain, leak, delay_frames)
    np.testing.assert_allclose(rejection(law, FREQUENCY_HZ, delay_frames)[:, 0], expected, rtol=1e-5)
    expected = theory.noise_transfer(FREQUENCY_HZ, RATE_HZ, gain, leak, delay_frames)
    np.testing.assert_allclose(noise_transfer(law, FREQUENCY_HZ, delay_frames)[:, 0], expected, rtol=1e-5)
    assert noise_gain(law, delay_frames)[0] == pytest.approx(theory.noise_gain(gain, leak, delay_frames), rel=1e-3)


@pytest.mark.parametrize("delay_frames", [1.0, 1.3, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("leak", [0.0, 0.01, 0.3])
def test_the_gain_margin_ends_at_the_limiting_gain(delay_frames: float, leak: float) -> None:
    margins_, highest = margins(one_mode_law(0.2, delay_frames, leak), delay_frames), limiting_gain(delay_frames, leak)
    assert 0.2 * margins_.gain_margin[0] == pytest.approx(highest, rel=1e-4)
    assert margins_.gain_reduction[0] == 0
    assert margins(one_mode_law(0.9999 * highest, delay_frames, leak), delay_frames).stable
    assert not margins(one_mode_law(1.0001 * highest, delay_frames, leak), delay_frames).stable


def test_the_margins_for_gain_one_half_and_one_frame_of_delay_agree_with_a_hand_calculation() -> None:
    """By hand: L = g / (z - 1), |L| = 1 at 2 sin(w/2) = g; L is nearest to -1 at pi, at a distance of 1 - g/2."""
    margins_ = margins(one_mode_law(0.5, 1.0), 1.0)
    omega = 2 * np.arcsin(0.25)
    assert margins_.phase_margin_deg[0] == pytest.approx(np.degrees(np.pi / 2 - omega / 2), abs=0.05)
    assert margins_.peak[0] == pytest.approx(1 / (1 - 0.25), rel=1e-4)
    assert margins_.radius[0] == pytest.approx(0.5)
    assert margins_.gain_margin[0] == pytest.approx(4, rel=1e-3)


def test_margins_are_computed_for_the_true_delay_also_if_the_law_assumes_another_delay() -> None:
    """A law of pseudo-open-loop modes uses its own delay; the loop has the true delay."""
    law = integrators([(0.6, 0.0)], "pol", 1.0)
    assert margins(law, 1.0).gain_margin[0] == pytest.approx(2 / 0.6, rel=1e-3)
    # y[k] = c[k-2] - c[k-1], so that c[k] = 0.4 c[k-1] - 0.6 (c[k-2] - c[k-1]) = c[k-1] - 0.6 c[k-2]
    assert margins(law, 2.0).radius[0] == pytest.approx(np.abs(np.roots([1, -1, 0.6])).max(), rel=1e-6)


@pytest.mark.parametrize("gain", [0.3, 0.6, 0.9, 1.2])
@pytest.mark.parametrize("true_frames", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("signal", ["error", "pol"])
def test_a_stable_loop_settles(gain: float, true_frames: float, signal: Signal) -> None:
    """A loop that `margins` calls stable settles after a step, also if the true delay is not the law's."""
    law = integrators([(gain, 0.0)], signal, 1.0)
    margins_ = margins(law, true_frames)
    if abs(margins_.radius[0] - 1) > 0.03:  # otherwise 400 frames do not show whether the loop is stable
        residual = run(law, np.ones((400, 1)), true_frames, limit_nm=1e6)[0][-1, 0]
        assert margins_.stable == (abs(residual) < 0.01)


def test_rejection_is_the_ratio_of_the_residual_of_a_sine_to_the_sine() -> None:
    law = LAWS["notch"]
    for frequency_hz in (30.0, 71.0, 150.0):
        line = np.repeat(np.sin(2 * np.pi * frequency_hz * np.arange(8000) / RATE_HZ)[:, None], 3, axis=1)
        residual = run(law, line, 1.0)[0][4000:].std(axis=0) / line.std(axis=0)
        np.testing.assert_allclose(residual, rejection(law, np.array([frequency_hz]), 1.0)[0], rtol=0.02)


def test_a_notch_has_the_requested_depth_and_width() -> None:
    notch, zero = Notch(frequency_hz=60, width_hz=6, depth=10), np.zeros(1)
    notched, bare = (pi_notch((4,), zero + 0.3, zero, zero, [notches], 1.0, RATE_HZ) for notches in ((notch,), ()))
    at = np.array([57.0, 60.0, 63.0])
    ratio = (rejection(notched, at, 1.0) / rejection(bare, at, 1.0))[:, 0]
    assert ratio[1] == pytest.approx(0.1, rel=0.01)
    np.testing.assert_allclose(ratio[[0, 2]], np.sqrt(0.5), rtol=0.25)


def test_modes_without_gain_count_as_stable() -> None:
    law = one_mode_law(0.0, 1.0)
    check_stable(law, 1.0)
    margins_ = margins(law, 1.0)
    assert margins_.stable
    assert margins_.gain_margin[0] == np.inf
    assert margins_.phase_margin_deg[0] == 180


def test_the_refusal_of_an_unstable_law_names_the_pole() -> None:
    with pytest.raises(
        ValueError, match=r"unstable with a delay of 2 frames: closed, Z4 has a pole at 1\.\d+.*made for 1 frame"
    ):
        check_stable(one_mode_law(1.2, 1.0), 2.0)


def test_a_law_unstable_without_frames_or_in_open_loop_is_refused() -> None:
    law = one_mode_law(0.5, 1.0)
    with pytest.raises(ValueError, match=r"without frames, Z4 has a pole at 1.0100"):
        check_stable(replace(law, predict_only=np.full((1, 1), 1.01)), 1.0)
    growing = replace(law, transition=np.full((1, 1), 1.01), command_gain=law.command_gain - np.float32(1.01))
    with pytest.raises(ValueError, match=r"open, Z4 has a pole at 1\.0100"):
        check_stable(growing, 1.0)


def test_a_rotation_of_the_modes_changes_neither_poles_nor_margins() -> None:
    """The law acts on rotated modes, and its command is rotated back."""
    law = linear(law_of(modes=2), (4, 5))
    rotation = np.array([[0.8, -0.6], [0.6, 0.8]], np.float32)
    rotated = replace(
        law,
        measurement_gain=rotation @ law.measurement_gain @ rotation.T,
        command_gain=rotation @ law.command_gain @ rotation.T,
    )
    margins_ = margins(rotated, 1.0)
    np.testing.assert_allclose(margins_.radius, 0.5, rtol=1e-5)
    np.testing.assert_allclose(margins_.gain_margin, 4, rtol=1e-3)
    np.testing.assert_allclose(rejection(rotated, FREQUENCY_HZ, 1.0), rejection(law, FREQUENCY_HZ, 1.0), rtol=1e-4)


def test_a_law_with_too_many_coupled_states_is_refused() -> None:
    states, ones = MAX_COUPLED_STATES + 1, np.ones((MAX_COUPLED_STATES + 1, 1), np.float32)
    dense = np.full((states, states), 1e-3, np.float32)
    law = LinearLaw("error", dense, ones, 0 * ones, dense, -ones.T, "dense", (4,), 1.0, RATE_HZ)
    with pytest.raises(ValueError, match="are coupled"):
        check_stable(law, 1.0)
