"""Where the mirror is within a period: when its commands came into force, and how it settles."""

import numpy as np
import pytest

from sim_camera.path import MirrorPath

FLAT, ONE, TWO = (np.full((2, 2), height, np.float32) for height in (0.0, 1.0, 2.0))
MOMENTS = np.array([0.1, 0.5, 0.9])


def heights(path: MirrorPath, start: float) -> list[float]:
    shapes, weights = path.over(start, MOMENTS)
    found: list[float] = (weights @ np.array(shapes)[:, 0, 0]).tolist()
    return found


def test_a_shape_is_there_from_the_moment_at_which_it_came_into_force() -> None:
    path = MirrorPath(FLAT)
    assert heights(path, 0) == [0, 0, 0]
    path.applied(1.0, ONE)
    path.applied(2.4, TWO)
    assert heights(path, 1) == [1, 1, 1]
    assert heights(path, 2) == [1, 2, 2]
    assert heights(path, 3) == [2, 2, 2]


def test_a_delay_moves_it_by_a_part_of_a_period() -> None:
    path = MirrorPath(FLAT, delay=0.5)
    path.applied(1.0, ONE)
    assert heights(path, 1) == [0, 1, 1]


def test_it_settles_exponentially_through_every_shape() -> None:
    """Against small steps of the first-order response."""
    path, settling, moves = MirrorPath(FLAT, settling=0.2), 0.2, [(0.05, ONE), (0.45, TWO), (1.7, FLAT)]
    for moment, shape in moves:
        path.applied(moment, shape)
    step, where, found = 1e-4, 0.0, []
    for time in np.arange(0, 3, step):
        target = next((shape[0, 0] for moment, shape in reversed(moves) if moment <= time), 0.0)
        where += (target - where) * step / settling
        found.append(where)
    for start in (0, 1, 2):
        assert heights(path, start) == pytest.approx([found[int((start + m) / step)] for m in MOMENTS], abs=2e-3)


def test_what_is_long_past_is_forgotten() -> None:
    path = MirrorPath(FLAT, settling=0.1)
    for moment in range(1000):
        path.applied(moment, ONE)
        path.over(moment, MOMENTS)
    assert len(path.over(1000, MOMENTS)[0]) < 5


def test_a_moment_before_the_last_one_is_taken_for_that_one() -> None:
    """As after a stall of the host, when frames begin anew: the shares of the shapes stay whole."""
    path = MirrorPath(FLAT, settling=0.01)
    for moment, shape in ((0.7, ONE), (0.2, TWO), (0.75, ONE)):
        path.applied(moment, shape)
    _, weights = path.over(0, np.linspace(0, 1, 50))
    assert weights.sum(axis=1) == pytest.approx(np.ones(50), abs=1e-5)
    assert weights.min() >= 0


def test_a_shape_from_while_the_host_stood_still_is_there_when_frames_begin_anew() -> None:
    path = MirrorPath(FLAT, settling=0.01)
    path.applied(1004.2, ONE, latest=5)
    path.applied(5.2, TWO, latest=6)
    assert heights(path, 5) == pytest.approx([1, 2, 2], abs=1e-3)
    assert len(path.over(6, MOMENTS)[0]) == 1
