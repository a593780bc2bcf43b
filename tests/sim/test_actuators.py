"""Errors of the simulated mirror's actuators, compared with simple models."""

import numpy as np
import pytest

from lowfc.contract.configuration import load
from lowfc.device import DriverOptions
from sim_dm.actuators import PLAY_NM, Actuators
from sim_dm.driver import SimulatedMirror

GRID = (2, 3)
SETTLED, AT_ONCE = np.inf, 0.0  # elapsed time, ns


def uniform(height_nm: float) -> np.ndarray:
    """Shape with all actuators at one height."""
    return np.full(GRID, height_nm, np.float32)


def test_gain_errors_differ_between_actuators_and_depend_on_the_seed() -> None:
    one, same, other = (Actuators((40, 50), 0.05, 0, 0, seed) for seed in (1, 1, 2))
    gains = [each.reach(np.full((40, 50), 100, np.float32), SETTLED) / 100 for each in (one, same, other)]
    assert gains[0].std() == pytest.approx(0.05, rel=0.05)
    np.testing.assert_array_equal(gains[0], gains[1])
    assert np.abs(gains[0] - gains[2]).max() > 0.05


def play(half_width_nm: float, heights_nm: list[float]) -> list[float]:
    """Play operator: positions of a block in a slot; the slot moves to these heights, and its ends push the block."""
    positions_nm, position_nm = [], 0.0
    for height_nm in heights_nm:
        if height_nm - position_nm > half_width_nm:
            position_nm = height_nm - half_width_nm
        elif position_nm - height_nm > half_width_nm:
            position_nm = height_nm + half_width_nm
        positions_nm.append(position_nm)
    return positions_nm


def test_hysteresis_agrees_with_play_operators_and_encloses_their_area() -> None:
    """The hysteresis loop of a play operator of half width r has the area 4 r (A - r) for a swing of +-A."""
    swing_nm, hysteresis = 80.0, 0.1
    cycle = swing_nm * np.sin(np.linspace(0, 2 * np.pi, 4001))
    heights = [*cycle, *cycle[1:]]
    actuators = Actuators(GRID, 0, hysteresis, 0, 1)
    reached = [float(actuators.reach(uniform(height), AT_ONCE)[0, 0]) for height in heights]
    played = np.mean([play(half_width, heights) for half_width in PLAY_NM], axis=0)
    np.testing.assert_allclose(reached, (1 - hysteresis) * np.array(heights) + hysteresis * played, atol=1e-3)
    # The second of the two cycles; the first begins inside the hysteresis loop.
    commanded_nm, reached_nm = np.array(heights[4000:]), np.array(reached[4000:])
    area = abs(np.sum((reached_nm[1:] + reached_nm[:-1]) / 2 * np.diff(commanded_nm)))
    expected = hysteresis * np.mean([4 * half_width * max(swing_nm - half_width, 0) for half_width in PLAY_NM])
    assert area == pytest.approx(expected, rel=0.01)


def test_creep_grows_with_the_logarithm_of_time() -> None:
    actuators = Actuators(GRID, 0, 0, 0.01, 1)
    actuators.reach(uniform(0), SETTLED)
    times_s = np.geomspace(1e-3, 1000, 600)
    reached = [float(actuators.reach(uniform(100), 1e9 * step_s)[1, 2]) for step_s in np.diff(times_s, prepend=0.0)]
    for start_s in (0.3, 1.0, 3.0):
        grown = np.interp([start_s, 10 * start_s], times_s, reached)
        assert np.diff(grown)[0] == pytest.approx(1.0, abs=0.06)
    assert reached[0] == pytest.approx(100, abs=0.05)
    assert reached[-1] == pytest.approx(104, abs=0.05)


def test_actuator_errors_are_off_by_default_and_reproducible() -> None:
    ideal, real = ({f"mirror.{key}": value for key in ("gain_error", "hysteresis", "creep")} for value in (0.0, 0.05))
    shapes = np.random.default_rng(1).normal(0, 20, (20, 34, 34)).astype(np.float32)
    plain, zero, one, same = (SimulatedMirror(DriverOptions(), load(None, keys)) for keys in ({}, ideal, real, real))
    for shape in shapes:
        surfaces = [mirror.settle(shape, 1e6) for mirror in (plain, zero, one, same)]
        np.testing.assert_array_equal(surfaces[0], surfaces[1])
        np.testing.assert_array_equal(surfaces[2], surfaces[3])
    assert np.abs(surfaces[0] - surfaces[2]).max() > 1
