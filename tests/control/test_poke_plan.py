"""What is played: every mode is told apart, drift cancels, and what a lost frame spoils is left out."""

import numpy as np
import pytest

from lowfc.control.calibration.poke_plan import (
    REST,
    SIGNS,
    cycle,
    dither,
    frames_for,
    hadamard_patterns,
    ladder,
    poke_patterns,
    seen,
    usable,
)

MODES = 5


@pytest.mark.parametrize("patterns", [poke_patterns(MODES, 8.0), hadamard_patterns(MODES, 3.0)])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_cycle_tells_the_modes_apart_and_drift_up_to_the_second_order_cancels(
    patterns: np.ndarray, backwards: bool
) -> None:
    plan = cycle(patterns, hold=3, settle=2, rest=4, backwards=backwards)
    used = plan.table[plan.used]
    normal = used.T @ used
    assert np.array_equal(normal, np.diag(np.diag(normal)))
    assert np.all(np.diag(normal) == plan.per_column * np.abs(patterns).max() ** 2)
    time = np.flatnonzero(plan.used) / len(plan)
    for power in (0, 1, 2):
        assert np.abs(used.T @ time**power).max() < 1e-9
    assert np.abs(used.T @ time**3).max() > 1e-6  # or nothing above would mean anything


def test_a_cycle_has_rest_pushes_and_pulls_with_their_settling() -> None:
    plan = cycle(poke_patterns(2, 8.0), hold=3, settle=2, rest=4)
    assert len(plan) == 4 + 2 + 2 * SIGNS.size * 5
    assert np.count_nonzero(plan.used[plan.block == REST]) == 4
    assert not plan.table[plan.block == REST].any()
    changed = np.flatnonzero(np.diff(plan.table, axis=0).any(axis=1)) + 1
    for late in (0, 1):
        assert not plan.used[changed + late].any()
    with pytest.raises(ValueError, match="held for 1 frame or more"):
        cycle(poke_patterns(2, 8.0), hold=0, settle=2, rest=4)


def test_hadamard_pokes_every_mode_in_every_pattern() -> None:
    assert np.all(np.abs(hadamard_patterns(14, 3.0)) == 3.0)
    assert hadamard_patterns(14, 3.0).shape == (16, 14)
    assert hadamard_patterns(16, 3.0).shape == (16, 16)


def test_a_dither_is_another_one_with_another_seed() -> None:
    one, other = dither(3, 2.0, 100, 4, 1), dither(3, 2.0, 100, 4, 2)
    assert np.array_equal(one.table, dither(3, 2.0, 100, 4, 1).table)
    assert not np.array_equal(one.table, other.table)
    assert np.all(np.abs(one.table) == 2.0)
    assert one.per_column == 100


def test_a_ladder_pushes_and_pulls_each_mode_at_each_level() -> None:
    plan = ladder(np.array([[1.0, 2.0], [3.0, 4.0]]), hold=2, settle=1)
    for column, levels in ((0, {1.0, 3.0}), (1, {2.0, 4.0})):
        values = plan.table[:, column]
        assert set(np.abs(values)) == levels | {0.0}
        assert abs(values.sum()) < 1e-12


def test_the_frames_for_a_signal_to_noise_grow_with_its_square() -> None:
    assert frames_for(100, 2.0, 4.0) == 2500
    assert frames_for(200, 2.0, 4.0) == 10_000


def test_an_exposure_sees_the_rows_that_its_delay_says() -> None:
    table = np.arange(1.0, 6.0)[:, None]
    every = np.ones(8, np.bool_)
    whole = seen(table, np.array([0.0, 1.0]), np.arange(8), every)
    assert whole[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 0, 0]
    half = seen(table, np.array([0.0, 0.5, 0.5]), np.arange(8), every)
    assert half[:, 0].tolist() == [0, 0.5, 1.5, 2.5, 3.5, 4.5, 2.5, 0]


def test_where_no_command_was_made_the_mirror_kept_the_row_before() -> None:
    table = np.arange(1.0, 6.0)[:, None]
    weights = np.array([0.0, 1.0])
    refused = np.array([True, True, False, True, True, True, True])
    assert seen(table, weights, np.arange(7), refused)[:, 0].tolist() == [0, 1, 2, 2, 4, 5, 0]
    missing = np.array([0, 1, 3, 4, 5, 6])
    assert seen(table, weights, missing, np.ones(6, np.bool_))[:, 0].tolist() == [0, 1, 2, 4, 5, 0]


def test_what_a_missing_frame_spoils_is_left_out_and_no_more() -> None:
    plan = cycle(poke_patterns(2, 8.0), hold=3, settle=0, rest=0)
    every = np.arange(len(plan) + 3)
    whole = usable(plan, every, np.ones(every.size, np.bool_), 1)
    assert np.flatnonzero(whole).tolist() == list(range(1, len(plan) + 1))
    without = np.delete(every, 20)
    kept = usable(plan, without, np.ones(without.size, np.bool_), 1)
    assert sorted(set(np.flatnonzero(whole)) - set(without[kept])) == [20, 21, 22]
