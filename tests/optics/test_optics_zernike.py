import numpy as np
import pytest

from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.zernike import NOLLS_20, mode_name, noll_to_nm, zernike, zernikes


def test_every_mode_agrees_with_hcipy(hcipy):
    grid = hcipy.make_pupil_grid(128, 1.0)
    x, y = 2 * np.asarray(grid.x), 2 * np.asarray(grid.y)
    inside = np.hypot(x, y) <= 1
    for noll in range(1, 67):
        assert tuple(hcipy.noll_to_zernike(noll)) == noll_to_nm(noll)
        theirs = np.asarray(hcipy.zernike_noll(noll, 1.0, grid))[inside]
        np.testing.assert_allclose(zernike(noll, x, y)[inside], theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())


def test_modes_are_orthonormal_over_the_circle():
    u = 2 * pupil_axis(512)
    inside = np.hypot(u[:, None], u) <= 1
    modes = zernikes((1, *NOLLS_20), u, u[:, None])[:, inside]
    np.testing.assert_allclose(modes @ modes.T / modes.shape[1], np.eye(21), atol=2e-3)


def test_polynomials_continue_outside_the_circle():
    assert zernike(2, 3.0, 1.0) == pytest.approx(6.0)
    assert zernike(3, 3.0, 1.0) == pytest.approx(2.0)
    assert zernike(4, 2.0, 0.0) == pytest.approx(np.sqrt(3) * 7.0)
    assert zernike(11, 0.0, 2.0) == pytest.approx(np.sqrt(5) * (6 * 16 - 6 * 4 + 1))


def test_names_say_which_axis_a_mode_follows():
    assert [mode_name(noll) for noll in (2, 3, 4, 7, 8, 11)] == [
        "tilt x",
        "tilt y",
        "focus",
        "coma y",
        "coma x",
        "spherical",
    ]
    assert len({mode_name(noll) for noll in range(1, 30)}) == 29
    # "x" modes change sign with x and not with y
    for noll in range(2, 22):
        if mode_name(noll).endswith(" x"):
            assert zernike(noll, -0.3, 0.2) == pytest.approx(-zernike(noll, 0.3, 0.2))
            assert zernike(noll, 0.3, -0.2) == pytest.approx(zernike(noll, 0.3, 0.2))


def test_indices_below_one_are_refused():
    with pytest.raises(ValueError, match="start at 1"):
        zernike(0, 0.0, 0.0)
