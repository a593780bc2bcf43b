"""Science images of classical and apodised Lyot coronagraphs, against hcipy; fast images against exact ones."""

import numpy as np
import pytest

from lowfc.adapters.files.sensors import coronagraph_from
from lowfc.contract.sections import SENSORS, SensorSection
from lowfc.optics.chain.added_contrast import ModalContrast, contrast_form
from lowfc.optics.chain.coronagraph import Coronagraph, contrast, mean_contrast
from lowfc.optics.chain.zernike import NOLLS_14

WAVELENGTH_NM = 550.0


@pytest.fixture(scope="module", params=["lyot", "aplc"])
def coronagraph(request) -> Coronagraph:
    return coronagraph_from(SensorSection.model_validate(SENSORS[request.param]))


@pytest.fixture(scope="module")
def modes_nm():
    return np.random.default_rng(4).normal(0, 3.0, 14)


def test_lyot_image_agrees_with_hcipy(hcipy, coronagraph, modes, modes_nm):
    opd_nm, lyot, samples = np.tensordot(modes_nm, modes[:14], 1), coronagraph.lyot, 96
    found = contrast(coronagraph, opd_nm, WAVELENGTH_NM, samples, samples_per=4)

    def focal_grid(count, samples_per):
        step = 1 / samples_per
        return hcipy.CartesianGrid(hcipy.RegularCoords([step] * 2, [count] * 2, [-(count - 1) * step / 2] * 2))

    pupil_grid, mask_grid = hcipy.make_pupil_grid(512, 1.0), focal_grid(len(lyot.opaque), lyot.samples_per)
    passed = hcipy.Field(1.0 - lyot.opaque.ravel(), mask_grid)
    hcipy_lyot = hcipy.LyotCoronagraph(pupil_grid, passed, hcipy.Field(lyot.stop.ravel(), pupil_grid))
    camera = hcipy.FraunhoferPropagator(pupil_grid, focal_grid(samples, 4))
    field = (coronagraph.pupil * np.exp(2j * np.pi / WAVELENGTH_NM * opd_nm)).ravel()
    behind = hcipy_lyot.forward(hcipy.Wavefront(hcipy.Field(field, pupil_grid)))
    star = hcipy.Wavefront(hcipy.Field((coronagraph.pupil * lyot.stop).ravel() + 0j, pupil_grid))
    peak = np.abs(star.electric_field.sum() / 512**2) ** 2
    expected = np.asarray(camera.forward(behind).intensity).reshape(samples, samples) / peak
    assert np.linalg.norm(found - expected) < 1e-6 * np.linalg.norm(expected)


@pytest.mark.parametrize("coronagraph", ["sam", "lyot", "aplc"], indirect=True)
def test_fast_image_and_quadratic_form_agree_with_the_exact_image(coronagraph, modes, modes_nm):
    modal = ModalContrast(coronagraph, NOLLS_14, WAVELENGTH_NM)
    small_nm = [0.3 * np.random.default_rng(seed).choice([-1.0, 1.0], 14) for seed in range(6)]
    flat, large, *small = (
        mean_contrast(coronagraph, np.tensordot(one, modes[:14], 1), WAVELENGTH_NM, coronagraph.dark_zone, 4)
        for one in (0 * modes_nm, modes_nm, *small_nm)
    )
    assert modal.by_image(modes_nm) - modal.by_image(0 * modes_nm) == pytest.approx(large - flat, rel=0.02, abs=0)
    assert [one @ modal.form @ one for one in small_nm] == pytest.approx(np.array(small) - flat, rel=0.01, abs=0)


@pytest.mark.parametrize(("coronagraph", "ratio"), [("lyot", -39_000), ("aplc", 190)], indirect=["coronagraph"])
def test_lyot_coronagraphs_are_far_more_sensitive_to_tilt_than_a_shaped_pupil(coronagraph, ratio):
    """With the APLC, a tilt adds 190 times as much contrast as with the shaped pupil.

    With the classical mask, a tilt lowers the contrast of the dark zone.
    """
    shaped = coronagraph_from(SensorSection())
    lyot_form, shaped_form = (contrast_form(one, (2,), WAVELENGTH_NM).item() for one in (coronagraph, shaped))
    assert shaped_form > 0
    assert lyot_form / shaped_form == pytest.approx(ratio, rel=0.02)
