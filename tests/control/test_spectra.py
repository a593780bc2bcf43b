"""Spectra of what is known: noise, sines, gaps, and a loop whose rejection theory gives."""

import numpy as np
import pytest

from lowfc.control.laws.spectra import LONGEST, MOST_BRIDGED, SHORTEST, Pieces, floor_nm2_hz, in_bins, pieces, spectrum
from tests.support.theory import rejection

RATE_HZ = 500.0


def whole(values: np.ndarray) -> Pieces:
    return Pieces((values,), 0)


def numbers(count: int, start: int = 1_700_000_000) -> np.ndarray:
    return (np.uint64(start) << np.uint64(32)) + np.arange(count, dtype=np.uint64)


def test_the_power_of_white_noise_is_its_variance() -> None:
    noise = np.random.default_rng(1).standard_normal((40_000, 3)) * [1.0, 2.0, 5.0]
    found = spectrum(whole(noise), RATE_HZ)
    assert found.frequency_hz[0] == 0
    assert found.frequency_hz[-1] == RATE_HZ / 2
    assert found.variance_nm2() == pytest.approx([1, 4, 25], rel=0.03)
    level = 2 * np.array([1, 4, 25]) / RATE_HZ  # one-sided: all of it between 0 and half of the rate
    assert found.power_nm2_hz[10:-10].mean(axis=0) == pytest.approx(level, rel=0.03)
    assert floor_nm2_hz(found) == pytest.approx(level, rel=0.05)


def test_a_sine_keeps_its_power_and_its_frequency() -> None:
    time_s = np.arange(8192) / RATE_HZ
    found = spectrum(whole(3.0 * np.sin(2 * np.pi * 40.3 * time_s)[:, None]), RATE_HZ)
    assert found.frequency_hz[np.argmax(found.power_nm2_hz)] == pytest.approx(40.3, abs=found.spacing_hz / 2)
    near = (np.abs(found.frequency_hz - 40.3) < 3 * found.spacing_hz)[:, None]
    assert found.variance_nm2(near) == pytest.approx(4.5, rel=0.01)
    assert found.variance_nm2() == pytest.approx(4.5, rel=0.01)


def test_the_standard_error_is_the_scatter() -> None:
    rng = np.random.default_rng(2)
    trials = [spectrum(whole(rng.standard_normal((2000, 1))), RATE_HZ) for _ in range(300)]
    band = (trials[0].frequency_hz < 50)[:, None]
    variances = [float(one.variance_nm2(band)[0]) for one in trials if one is not None]
    errors = [float(one.error_nm2(band)[0]) for one in trials if one is not None]
    assert np.mean(errors) == pytest.approx(np.std(variances), rel=0.2)


def test_short_gaps_are_bridged_and_long_ones_cut() -> None:
    values = np.arange(20.0)[:, None] * [1.0, -2.0]
    kept = np.ones(20, bool)
    kept[5 : 5 + MOST_BRIDGED] = False
    kept[12 : 13 + MOST_BRIDGED] = False
    found = pieces(numbers(20)[kept], values[kept])
    assert [len(piece) for piece in found.values] == [12, 20 - 13 - MOST_BRIDGED]
    assert found.bridged == MOST_BRIDGED
    assert np.array_equal(found.values[0], values[:12])  # a straight line is bridged exactly
    assert np.array_equal(found.values[1], values[13 + MOST_BRIDGED :])
    assert found.frames == 20 - 1 - MOST_BRIDGED


def test_a_row_without_a_value_is_a_missing_frame() -> None:
    values = np.arange(10.0)[:, None].repeat(2, axis=1)
    values[4, 1] = np.nan
    found = pieces(numbers(10), values)
    assert found.bridged == 1
    assert np.array_equal(found.joined(), np.arange(10.0)[:, None].repeat(2, axis=1))


def test_repeated_and_older_frames_are_left_out() -> None:
    order = [0, 1, 2, 2, 1, 3, 4]
    found = pieces(numbers(5)[order], np.array(order, float)[:, None])
    assert found.joined().ravel().tolist() == [0, 1, 2, 3, 4]


def test_a_restart_of_the_camera_begins_a_piece() -> None:
    sequence = np.concatenate([numbers(10), numbers(10, 1_700_000_001)])
    assert [len(piece) for piece in pieces(sequence, np.ones((20, 1))).values] == [10, 10]


def test_nothing_gives_no_pieces() -> None:
    assert pieces(numbers(0), np.zeros((0, 2))) == Pieces((), 0)
    assert pieces(numbers(3), np.full((3, 2), np.nan)) == Pieces((), 0)
    assert spectrum(Pieces((), 0), RATE_HZ) is None


@pytest.mark.parametrize(("frames", "there"), [(SHORTEST - 1, False), (SHORTEST, True)])
def test_what_is_too_short_has_no_spectrum(frames: int, there: bool) -> None:
    found = spectrum(whole(np.random.default_rng(1).standard_normal((frames, 1))), RATE_HZ)
    assert (found is not None) == there


def test_a_long_run_has_finer_and_more_segments() -> None:
    rng = np.random.default_rng(3)
    spacings = [spectrum(whole(rng.standard_normal((n, 1))), RATE_HZ).spacing_hz for n in (100, 1000, 100_000)]
    assert spacings == [RATE_HZ / SHORTEST, RATE_HZ / 128, RATE_HZ / LONGEST]


def test_gaps_leave_the_level_of_noise_as_it_is() -> None:
    rng = np.random.default_rng(4)
    kept = np.ones(20_000, bool)
    for start in range(1500, 20_000, 1700):
        kept[start : start + 10] = False
    found = spectrum(pieces(numbers(20_000)[kept], rng.standard_normal((20_000, 1))[kept]), RATE_HZ)
    assert found.segments > 50
    assert float(found.variance_nm2()[0]) == pytest.approx(1.0, rel=0.04)


def test_bins_are_even_in_the_logarithm_and_keep_a_straight_line() -> None:
    frequency_hz = np.linspace(0, 250, 1025)
    centres_hz, (same,) = in_bins(frequency_hz, [frequency_hz], per_decade=10)
    assert centres_hz[0] == frequency_hz[1]
    assert np.array_equal(centres_hz, same)
    assert (np.diff(centres_hz) > 0).all()
    steps = np.diff(np.log10(centres_hz[centres_hz > 5]))
    assert steps == pytest.approx(0.1, abs=0.03)


@pytest.mark.parametrize(("gain", "leak", "delay"), [(0.5, 0.0, 1), (0.3, 0.02, 2)])
def test_closed_over_open_is_the_rejection(gain: float, leak: float, delay: int) -> None:
    disturbance = np.random.default_rng(5).standard_normal(60_000)
    residual = np.empty_like(disturbance)
    commands = [0.0] * delay
    for index, wave_nm in enumerate(disturbance):
        residual[index] = wave_nm + commands[-1]
        commands = [(1 - leak) * commands[0] - gain * residual[index], *commands[:-1]]
    found = spectrum(whole(np.stack([disturbance, residual], axis=1)), RATE_HZ)
    frequency_hz, (before, after) = in_bins(found.frequency_hz, list(found.power_nm2_hz.T), per_decade=10)
    above = frequency_hz > 2
    expected = rejection(frequency_hz[above], RATE_HZ, gain, leak, delay)
    assert np.sqrt(after / before)[above] == pytest.approx(expected, rel=0.08)
