"""Influence functions and the modes-to-actuators matrix of the mirror."""

import numpy as np
import pytest

from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.mirror import (
    Mirror,
    active_actuators,
    actuator_axis,
    influence_factors,
    modes_to_actuators,
)
from lowfc.optics.chain.zernike import NOLLS_20, zernikes

MIRROR = Mirror()


def test_poke_has_unit_height_and_neighbours_have_the_coupling():
    axis = actuator_axis(MIRROR, 34)
    assert axis[1] - axis[0] == pytest.approx(1 / 31)
    poke = np.zeros((34, 34))
    poke[10, 20] = 1.0
    factors = influence_factors(MIRROR, axis, 34)
    surface = factors @ poke @ factors.T
    assert surface[10, 20] == pytest.approx(1.0)
    assert surface[11, 20] == pytest.approx(0.15)
    assert surface[10, 19] == pytest.approx(0.15)
    assert surface[11, 21] == pytest.approx(0.15**2)
    assert np.unravel_index(surface.argmax(), surface.shape) == (10, 20)


def test_numbers_of_rows_and_columns_may_differ():
    mirror = Mirror(rows=3, columns=5, pitches_per_pupil=4)
    u = pupil_axis(16)
    commands = modes_to_actuators(mirror, [2, 3])
    assert commands.shape == (15, 2)
    surface = influence_factors(mirror, u, 3) @ commands[:, 0].reshape(3, 5) @ influence_factors(mirror, u, 5).T
    assert surface.shape == (16, 16)
    assert np.corrcoef(surface[8], u)[0, 1] > 0.9  # a tilt along x


def test_active_actuators_are_those_in_the_pupil_and_one_ring_around_it():
    active = active_actuators(MIRROR)
    assert active.sum() == 912
    np.testing.assert_array_equal(active, active.T)
    np.testing.assert_array_equal(active, active[::-1])


def wavefronts_and_modes(commands):
    """Wavefronts (20, samples in the pupil) of commands (actuators, 20), and the modes at the same samples."""
    u = pupil_axis(256)
    inside, factors = np.hypot(u[:, None], u) <= 0.5, influence_factors(MIRROR, u, 34)
    wavefronts = [2.0 * (factors @ each.reshape(34, 34) @ factors.T)[inside] for each in commands.T]
    return np.array(wavefronts), zernikes(NOLLS_20, 2 * u, 2 * u[:, None])[:, inside]


def test_the_command_of_a_mode_makes_a_surface_of_half_the_mode():
    commands = modes_to_actuators(MIRROR, NOLLS_20)
    assert commands.shape == (34 * 34, 20)
    assert not commands[~active_actuators(MIRROR).ravel()].any()
    wavefronts, targets = wavefronts_and_modes(commands)
    assert ((wavefronts - targets).std(axis=1) < 0.016).all()  # print-through: 1.3 % on average, 1.6 % at most
    assert (wavefronts * targets).sum(axis=1) / (targets**2).sum(axis=1) == pytest.approx(1.0, abs=2e-3)


def test_neighbours_compensate_for_unusable_actuators():
    """The modes are more accurate than those of a fit of all actuators whose unusable ones are then set to zero."""
    usable = np.ones((34, 34), bool)
    usable[10, 12] = usable[16, 17] = usable[17, 17] = usable[22, 9] = usable[25, 24] = False
    commands = modes_to_actuators(MIRROR, NOLLS_20, usable)
    assert not commands[~usable.ravel()].any()
    uncompensated = modes_to_actuators(MIRROR, NOLLS_20) * usable.ravel()[:, None]
    errors, uncompensated_errors = (
        np.subtract(*wavefronts_and_modes(each)).std(axis=1) for each in (commands, uncompensated)
    )
    assert (errors < 0.95 * uncompensated_errors).all()
    assert np.median(errors / uncompensated_errors) < 0.8
    few = np.zeros((34, 34), bool)
    few[16:18, 16:18] = True
    with pytest.raises(ValueError, match="4 active actuators in the pupil cannot make 20 modes"):
        modes_to_actuators(MIRROR, NOLLS_20, few)


def test_mirror_may_be_shifted_relative_to_the_pupil():
    moved = actuator_axis(Mirror(shift_pitches=0.5), 34) - actuator_axis(MIRROR, 34)
    np.testing.assert_allclose(moved, 0.5 / 31)


@pytest.mark.parametrize("bad", [{"rows": 0}, {"pitches_per_pupil": 0.0}, {"coupling": 0.0}, {"coupling": 1.0}])
def test_invalid_mirrors_are_refused(bad):
    with pytest.raises(ValueError, match="got"):
        Mirror(**bad)
