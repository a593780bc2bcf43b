"""Shape of the simulated mirror within a frame period: times of its commands, and settling; times are in periods."""

import numpy as np
import pytest

from sim_camera.path import MirrorPath

FLAT, ONE, TWO = (np.full((2, 2), height, np.float32) for height in (0.0, 1.0, 2.0))
"""Shapes with all actuators at heights 0, 1 and 2."""
INSTANTS = np.array([0.1, 0.5, 0.9])


def heights(path: MirrorPath, start: float) -> list[float]:
    shapes, weights = path.motion(start, INSTANTS)
    return (weights @ np.array(shapes)[:, 0, 0]).tolist()


def test_a_shape_is_in_effect_from_its_time_on() -> None:
    path = MirrorPath(FLAT)
    assert heights(path, 0) == [0, 0, 0]
    path.applied(1.0, ONE)
    path.applied(2.4, TWO)
    assert heights(path, 1) == [1, 1, 1]
    assert heights(path, 2) == [1, 2, 2]
    assert heights(path, 3) == [2, 2, 2]


def test_delay_postpones_a_shape_by_a_fraction_of_a_period() -> None:
    path = MirrorPath(FLAT, delay=0.5)
    path.applied(1.0, ONE)
    assert heights(path, 1) == [0, 1, 1]


def test_mirror_settles_exponentially_from_shape_to_shape() -> None:
    """Compared with an integration of the first-order response in small steps."""
    path, settling, moves = MirrorPath(FLAT, settling=0.2), 0.2, [(0.05, ONE), (0.45, TWO), (1.7, FLAT)]
    for moment, shape in moves:
        path.applied(moment, shape)
    step, position, positions = 1e-4, 0.0, []
    for time in np.arange(0, 3, step):
        target = next((shape[0, 0] for moment, shape in reversed(moves) if moment <= time), 0.0)
        position += (target - position) * step / settling
        positions.append(position)
    for start in (0, 1, 2):
        expected = [positions[int((start + instant) / step)] for instant in INSTANTS]
        assert heights(path, start) == pytest.approx(expected, abs=2e-3)


def test_instants_long_before_a_shape_do_not_overflow() -> None:
    """At 1 Hz the mirror settles within 5e-5 periods; a warning of an overflow fails the test."""
    path = MirrorPath(FLAT, settling=5e-5)
    path.applied(0.6, ONE)
    assert heights(path, 0) == [0, 0, 1]


@pytest.mark.parametrize("settling", [0.1, 300.0])
def test_number_of_stored_shapes_is_bounded(settling: float) -> None:
    path = MirrorPath(FLAT, settling=settling)
    for moment in range(1000):
        path.applied(moment, ONE)
        path.motion(moment, INSTANTS)
    assert len(path.motion(1000, INSTANTS)[0]) < 5
    assert heights(path, 1000) == pytest.approx(1 - np.exp(-(1000 + INSTANTS) / settling), abs=1e-4)


def test_a_shape_with_an_earlier_time_than_the_previous_shape_applies_at_the_previous_time() -> None:
    """Such a time comes after a stall of the host, when frames restart; the weights of the shapes still sum to 1."""
    path = MirrorPath(FLAT, settling=0.001)
    for moment, shape in ((0.7, ONE), (0.2, TWO), (0.75, ONE)):
        path.applied(moment, shape)
    _, weights = path.motion(0, np.linspace(0, 1, 50))
    assert weights.sum(axis=1) == pytest.approx(np.ones(50), abs=1e-5)
    assert weights.min() >= 0


def test_shape_applied_during_a_host_stall_is_in_effect_at_the_next_frame() -> None:
    path = MirrorPath(FLAT, settling=0.01)
    path.applied(1004.2, ONE, latest=5)
    path.applied(5.2, TWO, latest=6)
    assert heights(path, 5) == pytest.approx([1, 2, 2], abs=1e-3)
    assert len(path.motion(6, INSTANTS)[0]) == 1
