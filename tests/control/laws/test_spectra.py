"""Spectra of noise, sines and series with gaps; transfer functions measured in loops, compared with theory."""

from dataclasses import replace

import numpy as np
import pytest

from lowfc.arrays import Array
from lowfc.control.calibration.excitation import MIN_CYCLES_OF_LINE, build_staircase, lines, multisine, with_lead_in
from lowfc.control.calibration.linearity import captured, gains, levels
from lowfc.control.laws import margins
from lowfc.control.laws.integrator import Integrator
from lowfc.control.laws.spectra import (
    LONGEST,
    MAX_INTERPOLATED_FRAMES,
    SHORTEST,
    TimeSeries,
    floor_nm2_hz,
    means_in_bins,
    spectrum,
    time_series,
)
from lowfc.control.laws.stability import delay_weights, settling_frames
from lowfc.control.laws.transfer_function import departure, measure_lines, modes_seen
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Request
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import Settings, State
from tests.support.theory import linear, one_piece
from tests.support.toy import NOLL, calibration, frame, frame_sequence, loaded, run_toy, settings

RATE_HZ = 500.0


def sequences(count: int, start: int = 1_700_000_000) -> np.ndarray:
    return frame_sequence(0, start) + np.arange(count, dtype=np.uint64)


def test_the_power_of_white_noise_equals_its_variance() -> None:
    noise = np.random.default_rng(1).standard_normal((40_000, 3)) * [1.0, 2.0, 5.0]
    power = spectrum(one_piece(noise), RATE_HZ)
    assert power.frequency_hz[0] == 0
    assert power.frequency_hz[-1] == RATE_HZ / 2
    assert power.variance_nm2() == pytest.approx([1, 4, 25], rel=0.03)
    level = 2 * np.array([1, 4, 25]) / RATE_HZ  # one-sided, from 0 to half the rate
    assert power.power_nm2_hz[10:-10].mean(axis=0) == pytest.approx(level, rel=0.03)
    assert floor_nm2_hz(power) == pytest.approx(level, rel=0.05)


def test_a_sine_keeps_its_power_and_its_frequency() -> None:
    time_s = np.arange(8192) / RATE_HZ
    power = spectrum(one_piece(3.0 * np.sin(2 * np.pi * 40.3 * time_s)[:, None]), RATE_HZ)
    assert power.frequency_hz[np.argmax(power.power_nm2_hz)] == pytest.approx(40.3, abs=power.spacing_hz / 2)
    near = (np.abs(power.frequency_hz - 40.3) < 3 * power.spacing_hz)[:, None]
    assert power.variance_nm2(near) == pytest.approx(4.5, rel=0.01)
    assert power.variance_nm2() == pytest.approx(4.5, rel=0.01)


def test_the_standard_error_of_a_variance_equals_its_scatter_over_trials() -> None:
    rng = np.random.default_rng(2)
    trials = [spectrum(one_piece(rng.standard_normal((2000, 1))), RATE_HZ) for _ in range(300)]
    band = (trials[0].frequency_hz < 50)[:, None]
    variances = [float(trial.variance_nm2(band)[0]) for trial in trials]
    errors = [float(trial.error_nm2(band)[0]) for trial in trials]
    assert np.mean(errors) == pytest.approx(np.std(variances), rel=0.2)


def test_short_gaps_are_interpolated_and_long_gaps_split_the_series() -> None:
    values = np.arange(20.0)[:, None] * [1.0, -2.0]
    present = np.ones(20, bool)
    present[5 : 5 + MAX_INTERPOLATED_FRAMES] = False
    present[12 : 13 + MAX_INTERPOLATED_FRAMES] = False
    series = time_series(sequences(20)[present], values[present])
    assert [len(piece) for piece in series.values] == [12, 20 - 13 - MAX_INTERPOLATED_FRAMES]
    assert series.interpolated == MAX_INTERPOLATED_FRAMES
    assert np.array_equal(series.values[0], values[:12])  # interpolation of a straight line is exact
    assert np.array_equal(series.values[1], values[13 + MAX_INTERPOLATED_FRAMES :])
    assert series.frames == 20 - 1 - MAX_INTERPOLATED_FRAMES


def test_repeated_and_older_frames_are_ignored() -> None:
    order = [0, 1, 2, 2, 1, 3, 4]
    series = time_series(sequences(5)[order], np.array(order, float)[:, None])
    assert series.joined().ravel().tolist() == [0, 1, 2, 3, 4]


def test_a_camera_restart_starts_a_new_piece() -> None:
    sequence = np.concatenate([sequences(10), sequences(10, 1_700_000_001)])
    assert [len(piece) for piece in time_series(sequence, np.ones((20, 1))).values] == [10, 10]
    lower_after_a_clear = np.roll(sequence, 10)
    assert [len(piece) for piece in time_series(lower_after_a_clear, np.ones((20, 1))).values] == [10, 10]


def test_empty_and_short_series_have_no_spectrum() -> None:
    assert time_series(sequences(0), np.zeros((0, 2))) == TimeSeries((), 0)
    assert time_series(sequences(3), np.full((3, 2), np.nan)) == TimeSeries((), 0)
    noise = np.random.default_rng(1).standard_normal((SHORTEST, 1))
    all_series = TimeSeries((), 0), one_piece(noise[1:]), one_piece(noise)
    assert [spectrum(series, RATE_HZ) is not None for series in all_series] == [False, False, True]


def test_a_longer_series_has_a_finer_spectrum() -> None:
    rng = np.random.default_rng(3)
    spacings = [spectrum(one_piece(rng.standard_normal((n, 1))), RATE_HZ).spacing_hz for n in (100, 1000, 100_000)]
    assert spacings == [RATE_HZ / SHORTEST, RATE_HZ / 128, RATE_HZ / LONGEST]


def test_bins_are_even_in_the_logarithm_and_preserve_a_straight_line() -> None:
    frequency_hz = np.linspace(0, 250, 1025)
    centres_hz, (same,) = means_in_bins(frequency_hz, [frequency_hz])
    assert centres_hz[0] == frequency_hz[1]
    assert np.array_equal(centres_hz, same)
    assert (np.diff(centres_hz) > 0).all()
    steps = np.diff(np.log10(centres_hz[centres_hz > 10]))
    assert steps == pytest.approx(0.05, abs=0.015)


PERIOD = 3000  # frames
GAIN = (0.4, 0.1)
TOLERANCE_DB = 1.0


def law(gain: tuple[float, float] = GAIN) -> Integrator:
    return settings(gain=gain).integrator(NOLL)


def run_probe(setup: Settings, request: Request) -> tuple[Array, Array, State]:
    """Errors and commands (frames, modes), nm, of `run_toy` during a probe sequence, and the state afterwards.

    The disturbance is white noise and a slow sine that is not a line of the multisine.
    """
    state, _ = advance(setup, loaded(setup), frame(1))
    state, outputs = advance(setup, state, request)
    assert outputs.reply.accepted, outputs.reply.text
    frames = len(request.table)
    slow = 3 * np.sin(2e-4 * np.arange(frames))[:, None]
    noise = 0.3 * np.random.default_rng(3).standard_normal((frames, len(NOLL)))
    steps, _, state = run_toy(setup, slow + noise, state=state, first=2)
    error_nm, command_nm = [step.error_nm for step in steps], [step.command_nm for step in steps]
    return np.array(error_nm, float), np.array(command_nm, float), state


@pytest.mark.parametrize(
    ("target", "delay_frames"), [("offset", 1.0), ("offset", 1.5), ("mirror", 1.5), ("mirror", 2.0)]
)
def test_the_measured_rejection_agrees_with_theory(target: str, delay_frames: float) -> None:
    setup = settings(delay_frames=delay_frames, gain=GAIN)
    cycles = lines(PERIOD, len(NOLL), 12, MIN_CYCLES_OF_LINE / PERIOD, 0.3)
    period = multisine(PERIOD, cycles, 3.0, 1)
    lead = settling_frames(law().gain, law().leak)
    table = with_lead_in(period, lead)
    shapes = np.zeros(0) if target == "offset" else calibration().modes_to_actuators.T.reshape(-1)
    request = Request(0, "play", text=target, table=table, actuators_nm=shapes.astype(np.float32))
    error_nm, _, _ = run_probe(setup, request)
    weights = delay_weights(delay_frames)
    added = -period.astype(float) if target == "offset" else modes_seen(period.astype(float), weights)
    measured = measure_lines(error_nm[lead:], added)

    assert [np.sort(np.round(measured.frequency[measured.mode == mode] * PERIOD)).tolist() for mode in range(3)] == [
        cycles_of_mode.tolist() for cycles_of_mode in cycles
    ]
    theory, rows = linear(law(), NOLL, delay_frames, 1.0), np.arange(measured.mode.size)
    transfer = margins.rejection, margins.noise_transfer
    S, T = (function(theory, measured.frequency)[rows, measured.mode] for function in transfer)
    departure_from_s = departure(measured.rejection, S, measured.error, TOLERANCE_DB)
    departure_from_t = departure(measured.noise_transfer, T, measured.error, TOLERANCE_DB)
    assert departure_from_s.judged.sum() > 0.8 * rows.size
    assert departure_from_t.judged.sum() > 0.5 * rows.size
    for compared in (departure_from_s, departure_from_t):
        judged = compared.judged
        assert np.array_equal(judged, compared.within)
        assert 0.6 < np.sqrt(np.mean((compared.db[judged] / compared.error_db[judged]) ** 2)) < 1.6
    assert (np.abs(departure_from_s.db[departure_from_s.judged & (measured.frequency > 0.02)]) < 0.5).all()

    other_theory = linear(law((0.6, 0.15)), NOLL, delay_frames, 1.0)
    S = margins.rejection(other_theory, measured.frequency)[rows, measured.mode]
    departure_from_other = departure(measured.rejection, S, measured.error, TOLERANCE_DB)
    assert not departure_from_other.within[departure_from_other.judged].all()


def test_lines_have_odd_numbers_of_cycles_ascend_and_are_not_shared_by_modes() -> None:
    for modes in (1, 2, 3, 14):
        cycles = lines(15_000, modes, 12, 0.1 / 250, 0.3)
        all_cycles = np.sort(np.concatenate(cycles))
        assert all_cycles.size == np.unique(all_cycles).size == 12 * modes
        assert (all_cycles % 2 == 1).all()
        assert all_cycles[0] >= 0.1 / 250 * 15_000
        assert all_cycles[-1] <= 0.3 * 15_000
        assert all_cycles[-1] > 0.28 * 15_000
        for cycles_of_mode in cycles:
            assert (np.diff(cycles_of_mode) >= 6).all()


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ((1000, 3, 12, 0.001, 0.3), "cycles"),
        ((100, 14, 12, 0.05, 0.3), "room"),
        ((1000, 3, 12, 0.3, 0.1), "ascend"),
        ((1000, 3, 12, 0.1, 0.6), "ascend"),
    ],
)
def test_an_impossible_multisine_is_refused(arguments: tuple[int, int, int, float, float], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        lines(*arguments)


def test_a_multisine_has_the_requested_rms_and_lines_and_a_low_crest_factor() -> None:
    cycles = lines(4000, 4, 15, 0.001, 0.3)
    table = multisine(4000, cycles, 2.0, 5)
    assert np.std(table, axis=0) == pytest.approx(2.0, rel=1e-5)
    assert np.std(multisine(1002, lines(1002, 1, 8, 0.004, 0.5), 2.0, 5)) == pytest.approx(2.0, rel=1e-5)
    assert (np.abs(table).max(axis=0) < 3.3 * 2.0).all()
    amplitude = np.abs(np.fft.rfft(table, axis=0))
    for mode, cycles_of_mode in enumerate(cycles):
        assert np.array_equal(np.flatnonzero(amplitude[:, mode] > 1e-3 * amplitude[:, mode].max()), cycles_of_mode)
    with_lead = with_lead_in(table, 4500)
    assert np.array_equal(with_lead[500:4500], table)
    assert np.array_equal(with_lead[4500:], table)


def test_a_vibration_near_a_line_raises_the_standard_error_of_the_line() -> None:
    rng = np.random.default_rng(2)
    cycles = lines(PERIOD, 1, 10, 0.005, 0.3)
    period = multisine(PERIOD, cycles, 2.0, 1).astype(float)
    fifth = int(cycles[0][4])
    time = np.arange(PERIOD)
    error = 0.5 * period + 0.01 * rng.standard_normal(period.shape)
    quiet = measure_lines(error, period)
    vibrating = measure_lines(error + np.sin(2 * np.pi * (fifth + 0.4) / PERIOD * time)[:, None], period)
    assert np.abs(quiet.rejection - 0.5).max() < 0.02
    assert vibrating.error[4] > 10 * quiet.error[4]
    assert abs(vibrating.rejection[4] - 0.5) < 5 * vibrating.error[4]


def test_a_measurement_without_a_signal_is_refused() -> None:
    with pytest.raises(ValueError, match="nothing was added"):
        measure_lines(np.zeros((100, 3)), np.zeros((100, 3)))
    with pytest.raises(ValueError, match="same shape"):
        measure_lines(np.zeros((100, 3)), np.zeros((99, 3)))


def test_a_staircase_limits_its_steps_and_holds_its_levels() -> None:
    levels_nm = levels([2.0, 5.0], 2)
    assert levels_nm.tolist() == [2, -2, -2, 2] * 2 + [5, -5, -5, 5] * 2
    stairs, starts = build_staircase(levels_nm, 6, 3.0)
    assert np.abs(np.diff(stairs, prepend=0.0)).max() <= 3.0
    assert stairs[-1] == 0
    for start, level, previous in zip(starts, levels_nm, np.roll(levels_nm, 1), strict=True):
        assert (stairs[start : start + 6] == level).all()
        assert start == 0 or level == previous or stairs[start - 1] != level, "a start is the first frame at its level"


def test_the_gain_and_cross_talk_of_a_known_sensor_are_recovered() -> None:
    rng = np.random.default_rng(8)
    levels_nm = levels([4.0, 8.0, 16.0], 8)
    stairs, starts = build_staircase(levels_nm, 8, 10.0)
    true_nm = np.stack([0.1 * stairs, stairs * (1 - (stairs / 50) ** 2), np.zeros_like(stairs)], axis=1)
    drift = np.linspace(0, 20, len(stairs))[:, None]
    measured = gains(true_nm + drift + 0.2 * rng.standard_normal(true_nm.shape), 1, levels_nm, starts + 2, 6)
    assert measured.amplitude_nm.tolist() == [4, 8, 16]
    true_gain = np.stack([np.full(3, 0.1), 1 - (measured.amplitude_nm / 50) ** 2, np.zeros(3)], axis=1)
    assert (np.abs(measured.gain - true_gain) < 4 * measured.error).all()
    assert measured.error.max() < 0.02
    assert measured.within(0.05, 0.2) == [True, True, False]
    assert measured.within(0.5, 0.05) == [False] * 3
    too_noisy_nm = true_nm + 30 * rng.standard_normal(true_nm.shape)
    assert gains(too_noisy_nm, 1, levels_nm, starts + 2, 6).within(0.05, 0.2)[0] is None


@pytest.mark.parametrize(("gain", "expected"), [((0.4, 0.3), True), ((0.0, 0.0), False)])
def test_a_step_is_captured_if_the_loop_corrects_it(gain: tuple[float, float], expected: bool) -> None:
    setup = replace(settings(gain=gain), start_mode=LoopMode.CLOSED)
    shape = calibration().modes_to_actuators[:, 1][None]
    stairs, starts = build_staircase([0.0, 30.0], 40, 20.0)
    table = stairs.astype(np.float32)[:, None]
    request = Request(0, "play", text="mirror", table=table, actuators_nm=shape.reshape(-1))
    error_nm, command_nm, state = run_probe(setup, request)
    assert state.mode is LoopMode.CLOSED
    before, after = slice(20, 40), slice(int(starts[1]) + 30, int(starts[1]) + 40)
    assert captured(error_nm, command_nm, 1, 30.0, before, after) is expected
    assert not captured(np.zeros_like(error_nm), np.zeros_like(command_nm), 1, 30.0, before, after)
