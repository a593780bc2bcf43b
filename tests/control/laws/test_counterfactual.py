"""Loops recomputed by `lowfc what-if`, compared with the live loop's `advance` and with hand calculations."""

import numpy as np
import pytest

from lowfc.control.laws.stability import delay_weights, settling_frames
from lowfc.control.laws.what_if import (
    counterfactual,
    delay_from_times,
    delay_from_truth,
    frames_since,
    has_new_exposure,
    limited_integrator,
    missing_before,
    seen_nm,
)
from lowfc.control.loop.safety import Limits, Rejection
from lowfc.control.loop.state import Settings
from tests.support.theory import law_of
from tests.support.toy import frame_sequence, run_toy, settings

WIDE = {"limits": Limits(7000.0, 7000.0, 7000.0), "limit_nm": (5000.0, 5000.0)}
DELAYS = [1.0, 1.4, 2.0, 3.0]
WALK = np.array([15.0, -9.0, 6.0]) + np.cumsum(np.random.default_rng(4).normal(size=(160, 3)), axis=0)
MISSING = (30, 31, 32, 33, 34, 35, 60, 90, 91)  # numbers of missing frames
DARK = (45, 46, 100, 101, 102, 103)  # numbers of frames without light, which are refused


def one_mode(*values: float) -> np.ndarray:
    """Values (steps, 1) of one mode."""
    return np.array(values, np.float32)[:, None]


def weights(delay_frames: float) -> np.ndarray:
    return delay_weights(delay_frames).astype(np.float32)


def live_run(setup: Settings) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Errors, pseudo-open-loop modes and commands (steps, modes), nm, of the live loop; frames missing before each."""
    steps, _, _ = run_toy(setup, WALK, missing=MISSING, dark=DARK)
    not_measured = np.full(3, np.nan, np.float32)
    error = np.array([not_measured if step.error_nm is None else step.error_nm for step in steps])
    pol = np.array([not_measured if step.pol_nm is None else step.pol_nm for step in steps])
    sequence = np.array([step.frame_sequence for step in steps], np.uint64)
    return error, pol, np.array([step.command_nm for step in steps]), missing_before(sequence)


@pytest.mark.parametrize("delay", DELAYS)
def test_the_logged_gains_reproduce_the_logged_errors_and_commands(delay: float) -> None:
    """They agree up to float32 rounding in pol = error - seen, with missing and refused frames and a modal limit."""
    setup = settings(delay_frames=delay, gain=(0.3, 0.2), leak=(0.01, 0.0), limit_nm=(12.0, 50.0))
    error, pol, command, missing = live_run(setup)
    assert missing.sum() == 9
    assert np.isnan(error).any(axis=1).sum() == len(DARK)
    assert (np.abs(command[:, 0]) == 12.0).any()
    law = limited_integrator(setup.integrator((2, 3, 4)))
    replayed_error, replayed_command = counterfactual(law, weights(delay), pol, missing)
    np.testing.assert_allclose(replayed_error, error, atol=2e-5, rtol=0)
    np.testing.assert_allclose(replayed_command, command, atol=2e-5, rtol=0)


@pytest.mark.parametrize("delay", DELAYS)
def test_other_gains_give_the_errors_and_commands_of_a_loop_with_these_gains(delay: float) -> None:
    """The sensor is linear up to the rounding to DN, here 0.01 nm."""
    before = settings(delay_frames=delay, gain=(0.3, 0.1), **WIDE)
    after = settings(delay_frames=delay, gain=(0.1, 0.25), leak=(0.02, 0.01), **WIDE)
    _, pol, _, missing = live_run(before)
    error, _, command, _ = live_run(after)
    law = limited_integrator(after.integrator((2, 3, 4)))
    other_error, other_command = counterfactual(law, weights(delay), pol, missing)
    np.testing.assert_allclose(other_error, error, atol=0.05)
    np.testing.assert_allclose(other_command, command, atol=0.05)
    assert np.nanmax(np.abs(other_error - pol)) > 5


@pytest.mark.parametrize(
    ("delay", "errors"), [(1.0, [8, 4, 2, 1]), (2.0, [8, 8, 4, 0]), (3.0, [8, 8, 8, 4]), (1.5, [8, 6, 2.5, 0.375])]
)
def test_an_integrators_errors_after_a_step_agree_with_a_hand_calculation(delay: float, errors: list[float]) -> None:
    pol = one_mode(8, 8, 8, 8)
    error, command = counterfactual(limited_integrator(law_of(modes=1)), weights(delay), pol, np.zeros(4, np.int64))
    assert error[:, 0].tolist() == errors
    assert command[:, 0].tolist() == np.cumsum([-0.5 * value for value in errors]).tolist()


def test_any_function_of_state_and_error_can_be_the_controller() -> None:
    def every_other(state: int | None, error_nm: np.ndarray, pol_nm: np.ndarray) -> tuple[int, np.ndarray]:
        count = state or 0
        return count + 1, -error_nm if count % 2 else np.zeros_like(error_nm)

    _, command = counterfactual(every_other, weights(1.0), one_mode(8, 8, np.nan, 8, 8), np.zeros(5, np.int64))
    assert command[:, 0].tolist() == [0, -8, -8, 0, -8]


def test_an_exposure_sees_the_delayed_commands_also_after_missing_frames() -> None:
    command, first, missing = one_mode(1, 2, 4, 8), np.array([-1], np.float32), np.array([0, 0, 3, 0])
    assert seen_nm(weights(1.0), command, missing, first)[:, 0].tolist() == [-1, 1, 2, 4]
    assert seen_nm(weights(2.0), command, missing, first)[:, 0].tolist() == [-1, -1, 2, 2]
    assert seen_nm(weights(1.5), command, missing, first)[:, 0].tolist() == [-1, 0, 2, 3]


def test_repeated_and_older_frames_are_not_new_exposures() -> None:
    counts = [5, 6, 6, 4, 9, 8]
    sequence = np.array([*map(frame_sequence, counts), frame_sequence(1, 1_800_000_000)], np.uint64)
    repeated, older = 1 << Rejection.REPEATED, 1 << Rejection.OUT_OF_ORDER
    rows = has_new_exposure(np.array([0, 0, repeated, older, 0, older, 0]))
    assert rows.tolist() == [True, True, False, False, True, False, True]
    assert missing_before(sequence[rows]).tolist() == [0, 0, 2, 0]


def test_a_sequence_lowered_by_a_clear_does_not_count_as_missing_frames() -> None:
    sequence = np.array([*map(frame_sequence, [5, 9, 2, 3]), frame_sequence(7, 1_600_000_000)], np.uint64)
    assert missing_before(sequence).tolist() == [0, 3, 0, 0, 0]


@pytest.mark.parametrize("delay", [1.0, 1.4, 2.0, 2.7, 3.0])
def test_the_delay_is_recovered_from_the_true_mirror_motion(delay: float) -> None:
    rng = np.random.default_rng(3)
    command = np.cumsum(rng.normal(size=(400, 3)), axis=0).astype(np.float32)
    missing = (rng.random(400) < 0.02).astype(np.int64)
    true = seen_nm(weights(delay), command, missing, command[0]) * np.float32(1.03)  # 3 % more than commanded
    true[50:60] = np.nan
    assert delay_from_truth(true, command, missing) == pytest.approx(delay, abs=0.05)


def test_no_delay_follows_from_commands_that_do_not_change() -> None:
    motionless = np.full((400, 3), 7, np.float32)
    assert delay_from_truth(motionless, motionless, np.zeros(400, np.int64)) is None


def test_the_delay_is_recovered_from_message_times() -> None:
    """40 exposures from 1000 ns on, every 1000 ns; every fourth command comes 100 ns after the next exposure began."""
    sequence = np.array([frame_sequence(count) for count in range(40)], np.uint64)
    start_ns = 1000 + 1000 * np.arange(40)
    applied_ns = start_ns + 900
    applied_ns[::4] += 200
    repeated = slice(0, 40, 3)  # the mirror reports some of the commands again, 3000 ns later
    reported, times = np.append(sequence, sequence[repeated]), np.append(applied_ns, applied_ns[repeated] + 3000)
    assert delay_from_times(sequence, start_ns, reported, times) == pytest.approx(1.25, abs=0.02)
    assert delay_from_times(sequence, start_ns, reported[:5], times[:5]) is None


def test_commands_applied_next_to_a_missing_frame_do_not_count_for_the_delay() -> None:
    counts = [count for count in range(90) if count % 3 != 2]
    sequence = np.array([frame_sequence(count) for count in counts], np.uint64)
    start_ns = 1000 * np.array(counts)
    assert delay_from_times(sequence, start_ns, sequence, start_ns + 900) == 1.0


@pytest.mark.parametrize(
    ("gain", "leak", "frames"), [(0.5, 0.0, 250), ([0.5, 0.001, 0], [0, 0.001, 0], 2500), (0.0, 0.0, 250)]
)
def test_settling_takes_five_time_constants_and_at_least_250_frames(gain: object, leak: object, frames: int) -> None:
    law = law_of(gain, leak)
    assert settling_frames(law.gain, law.leak, 250.0) == frames


def test_frames_since_counts_from_the_first_running_step_or_a_later_beginning() -> None:
    running = np.array([0, 1, 1, 1, 0, 1, 1, 1], bool)
    begins = np.array([0, 0, 0, 0, 0, 0, 1, 0], bool)
    missing = np.array([0, 0, 3, 0, 0, 0, 0, 0])
    assert frames_since(begins, running, missing).tolist() == [-1, 0, 4, 5, -1, 0, 0, 1]
