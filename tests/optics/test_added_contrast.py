"""Contrast added by a wavefront: a quadratic form in its modes, compared with full science images."""

from collections.abc import Callable

import numpy as np
import pytest

from lowfc.arrays import Array
from lowfc.optics.chain.added_contrast import ModalContrast, by_group, contrast_form, costliest, without_negative
from lowfc.optics.chain.coronagraph import DARK_ZONE, Coronagraph, mean_contrast
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.sensor import Sensor
from lowfc.optics.chain.zernike import zernikes
from sim_camera.contrast import IMAGES, Contrast

NOLL, WAVELENGTH_NM = tuple(range(2, 16)), 550.0
AddedInImage = Callable[[Array], float]


@pytest.fixture(scope="module")
def coronagraph(sensor: Sensor) -> Coronagraph:
    return Coronagraph(sensor.pupil)


@pytest.fixture(scope="module")
def form(coronagraph: Coronagraph) -> Array:
    return contrast_form(coronagraph, NOLL, WAVELENGTH_NM)


@pytest.fixture(scope="module")
def added_in_image(coronagraph: Coronagraph, modes: Array) -> AddedInImage:
    def added(modes_nm: Array) -> float:
        flat, aberrated = (
            mean_contrast(coronagraph, np.tensordot(each_nm, modes[: len(NOLL)], 1), WAVELENGTH_NM, DARK_ZONE, 4)
            for each_nm in (0 * modes_nm, modes_nm)
        )
        return aberrated - flat

    return added


@pytest.mark.parametrize(("tilt_nm", "relative_error"), [(1.0, 0.0), (10.0, -0.14), (40.0, -0.74)])
def test_quadratic_form_underestimates_large_tilt(
    added_in_image: AddedInImage, form: Array, tilt_nm: float, relative_error: float
) -> None:
    modes_nm = tilt_nm * np.eye(len(NOLL))[0]
    assert modes_nm @ form @ modes_nm / added_in_image(modes_nm) - 1 == pytest.approx(relative_error, abs=0.01)


def test_spherical_adds_thousands_of_times_more_contrast_than_tilt(form: Array) -> None:
    added_by_mode = np.diag(form)
    assert 3000 < added_by_mode[NOLL.index(11)] / added_by_mode[0] < 6000
    assert added_by_mode.argmax() == NOLL.index(11)


def test_contrast_added_by_tilt_agrees_with_more_finely_sampled_images(coronagraph: Coronagraph, form: Array) -> None:
    axis = 2 * pupil_axis(len(coronagraph.pupil))
    tilt_nm = zernikes((2,), axis, axis[:, None])[0]
    flat, plus, minus = (mean_contrast(coronagraph, x * tilt_nm, WAVELENGTH_NM, DARK_ZONE, 16) for x in (0, 1, -1))
    assert form[0, 0] == pytest.approx((plus + minus) / 2 - flat, rel=0.12, abs=0)


def test_form_without_negative_eigenvalues_differs_little(form: Array) -> None:
    semidefinite = without_negative(form)
    assert np.linalg.eigvalsh(semidefinite).min() > -1e-20
    assert np.linalg.norm(semidefinite - form) < 1e-3 * np.linalg.norm(form)


def test_added_contrast_is_summed_by_group_and_that_of_large_tilt_is_not_quadratic(
    coronagraph: Coronagraph, added_in_image: AddedInImage
) -> None:
    """The cross term of two modes is shared: half of it counts for each mode."""
    modal, coma, tilt = ModalContrast(coronagraph, NOLL, WAVELENGTH_NM), NOLL.index(8), NOLL.index(2)
    shape = np.zeros(len(NOLL))
    shape[[coma, coma - 1, tilt]] = 0.3
    by_mode = modal.by_mode(np.outer(shape, shape))
    assert by_mode.sum() == pytest.approx(added_in_image(shape), rel=0.01, abs=0)
    groups = by_group(NOLL, by_mode)
    assert groups["coma"] == pytest.approx(by_mode[coma] + by_mode[coma - 1], abs=0)
    assert costliest(groups) == ("coma", 1.0), "the cross term with coma makes the share of tilt negative"
    assert costliest({"coma": 3.0, "focus": 1.0, "tilt": -9.0}) == ("coma", 0.75)
    assert not modal.is_beyond_quadratic(0.3**2 * np.eye(len(NOLL)))
    assert modal.is_beyond_quadratic(20**2 * np.diag(np.eye(len(NOLL))[tilt]))
    assert not modal.is_beyond_quadratic(0.5**2 * np.diag(np.eye(len(NOLL))[tilt])), "form and image differ by rounding"


def test_added_contrast_is_of_the_second_half_of_a_run(coronagraph: Coronagraph, added_in_image: AddedInImage) -> None:
    contrast = Contrast(ModalContrast(coronagraph, NOLL, WAVELENGTH_NM))
    assert contrast.measure() == {}
    modes_nm = 0.3 * np.eye(len(NOLL), dtype=np.float32)[NOLL.index(11)]
    for frame in range(5000):  # the residual is ten times larger in the first 2000 frames
        contrast.add(2 * modes_nm, (10 if frame < 2000 else 1) * modes_nm)
    found = contrast.measure()
    assert found["science_images"] == IMAGES
    expected = added_in_image(modes_nm.astype(float))
    assert (found["added_contrast"], found["quadratic_added_contrast"]) == pytest.approx(
        (expected, expected), rel=0.02, abs=0
    )
    assert found["added_contrast_flat"] == pytest.approx(4 * expected, rel=0.02, abs=0)
