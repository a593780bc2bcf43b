"""What a wavefront adds to the contrast: the quadratic form against full science images, and where it ends."""

import numpy as np
import pytest

from lowfc.adapters.files import factory
from lowfc.arrays import Array
from lowfc.contract.configuration import Configuration
from lowfc.optics.chain.added_contrast import ModalContrast, by_group, contrast_form, costliest, without_negative
from lowfc.optics.chain.coronagraph import DARK_ZONE, Coronagraph, mean_contrast
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.zernike import zernikes
from sim_camera.contrast import IMAGES, Contrast

NOLL, WAVELENGTH_NM = tuple(range(2, 16)), 550.0


@pytest.fixture(scope="module")
def pupil() -> Array:
    return factory.sensor(Configuration(), print).pupil


@pytest.fixture(scope="module")
def form(pupil: Array) -> Array:
    return contrast_form(pupil, NOLL, WAVELENGTH_NM)


def by_image(pupil: Array, modes_nm: Array) -> float:
    radius = 2 * pupil_axis(len(pupil))
    x, y = np.meshgrid(radius, radius)
    shapes = zernikes(NOLL, x.ravel(), y.ravel()).reshape(-1, *pupil.shape)
    flat, moved = (
        mean_contrast(pupil, np.tensordot(one, shapes, 1), WAVELENGTH_NM, DARK_ZONE, 2)
        for one in (0 * modes_nm, modes_nm)
    )
    return moved - flat


@pytest.mark.parametrize("seed", range(6))
def test_small_wavefronts_add_what_the_full_image_says(pupil: Array, form: Array, seed: int) -> None:
    modes_nm = 0.3 * np.random.default_rng(seed).choice([-1.0, 1.0], len(NOLL))
    assert modes_nm @ form @ modes_nm == pytest.approx(by_image(pupil, modes_nm), rel=0.01)


@pytest.mark.parametrize(("tilt_nm", "off"), [(1.0, 0.0), (10.0, -0.27), (40.0, -0.92)])
def test_the_form_ends_at_a_few_nm_of_tilt(pupil: Array, form: Array, tilt_nm: float, off: float) -> None:
    modes_nm = tilt_nm * np.eye(len(NOLL))[0]
    assert modes_nm @ form @ modes_nm / by_image(pupil, modes_nm) - 1 == pytest.approx(off, abs=0.01)


def test_spherical_costs_tens_of_thousands_of_times_what_tilt_costs(form: Array) -> None:
    each = np.diag(form)
    assert 20_000 < each[NOLL.index(11)] / each[0] < 50_000
    assert each.argmax() == NOLL.index(11)


def test_as_a_loss_it_rewards_nothing_and_keeps_what_costs(form: Array) -> None:
    loss = without_negative(form)
    assert np.linalg.eigvalsh(loss).min() > -1e-20
    assert np.linalg.norm(loss - form) < 1e-3 * np.linalg.norm(form)


def test_modes_of_a_kind_add_up_and_large_tilt_is_beyond_the_form(pupil: Array) -> None:
    """What two modes have in common is in the sum: half of it with each."""
    modal, coma, tilt = ModalContrast(Coronagraph(pupil), NOLL, WAVELENGTH_NM), NOLL.index(8), NOLL.index(2)
    shape = np.zeros(len(NOLL))
    shape[[coma, coma - 1, tilt]] = 0.3
    each = modal.by_mode(np.outer(shape, shape))
    assert each.sum() == pytest.approx(by_image(pupil, shape), rel=0.01)
    groups = by_group(NOLL, each)
    assert groups["coma"] == pytest.approx(each[coma] + each[coma - 1])
    assert costliest(groups) == ("coma", pytest.approx(groups["coma"] / each.sum()))
    assert not modal.is_beyond_quadratic(0.3**2 * np.eye(len(NOLL)))
    assert modal.is_beyond_quadratic(20**2 * np.diag(np.eye(len(NOLL))[tilt]))


def test_a_run_is_measured_by_images_of_its_second_half(pupil: Array) -> None:
    contrast = Contrast(ModalContrast(Coronagraph(pupil), NOLL, WAVELENGTH_NM))
    assert contrast.measure() is None
    modes_nm = 0.3 * np.eye(len(NOLL), dtype=np.float32)[NOLL.index(11)]
    for frame in range(5000):
        contrast.add(2 * modes_nm, (10 if frame < 2000 else 1) * modes_nm)
    found = contrast.measure()
    assert found is not None
    assert found.science_images == IMAGES
    expected = by_image(pupil, modes_nm.astype(float))
    assert (found.added_contrast, found.quadratic_added_contrast) == pytest.approx((expected, expected), rel=0.02)
    assert found.added_contrast_flat == pytest.approx(4 * expected, rel=0.02)
