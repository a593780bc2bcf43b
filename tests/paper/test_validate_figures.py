"""The figures of `lowfc validate`: their rows and plots with few trials, and the paper's claims with many."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lowfc.design.fisher import cramer_rao, variance_e2
from lowfc.design.paper import STAR, TABLE4_EXPOSURE_S
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.detector.photometry import electrons
from lowfc.programs.paper.cases import Context, prepared
from lowfc.programs.paper.figures import aberration
from lowfc.programs.paper.figures.exposure import ESTIMATORS
from lowfc.programs.paper.figures.modes import AMPLITUDES, deviations, linear_range
from lowfc.programs.paper.report import FIGURES
from lowfc.programs.paper.tables.pointing import NM_PER_MAS

FEW = Context(trials=4, seed=1, sensors=("sam",))


@pytest.fixture(scope="module")
def tables():
    """Rows of every figure by name, with few trials and the default sensor."""
    return {name: case.run(FEW) for name, case in FIGURES.items()}


def values(rows, quantity, estimator=None, name=""):
    """Measured values of the rows with this quantity and estimator and with names that begin with `name`."""
    measured = [
        row.measured
        for row in rows
        if row.quantity == quantity and row.estimator == estimator and row.name.startswith(name)
    ]
    assert measured
    return measured


@pytest.mark.parametrize("figure", FIGURES)
def test_every_row_is_finite_and_states_its_assumptions(tables, figure):
    rows = tables[figure]
    assert len({(row.name, row.modes, row.estimator, row.quantity) for row in rows}) == len(rows)
    for row in rows:
        assert row.assumption
        assert row.name.startswith("sam")
        for value in (row.measured, row.error, row.limit):
            assert value is None or isinstance(value, str) or np.isfinite(value)
        if row.estimator is not None:
            assert row.modes == 14
        if isinstance(row.measured, str):
            assert row.measured == "above 0.15"


LAID_OUT = ("fig3", "fig6")
"""Figures whose layout the quick tests compute, because they have few panels; layout takes half the time of a plot."""


@pytest.mark.parametrize(
    ("figure", "laid_out"),
    [
        *((figure, figure in LAID_OUT) for figure in FIGURES),
        *(pytest.param(figure, True, marks=pytest.mark.slow) for figure in FIGURES if figure not in LAID_OUT),
    ],
)
def test_every_figure_is_plotted(figure, laid_out, tables, tmp_path, request):
    if not laid_out:
        request.getfixturevalue("without_layout")
    from matplotlib.image import imread

    path = tmp_path / f"{figure}.png"
    FIGURES[figure].plot(FEW, path)
    picture = imread(path)
    assert min(picture.shape[:2]) > 300
    assert np.std(picture[..., :3]) > 0.05


def test_correction_restores_the_contrast(tables):
    rows = tables["fig1"]
    assert max(values(rows, "contrast, flat wavefront")) < 5e-10
    assert max(values(rows, "contrast, aberrated / flat wavefront", name="sam, coma Z8")) > 100
    assert min(values(rows, "contrast, aberrated / flat wavefront")) > 20
    for estimator in ("pinv", "weighted + 1 iteration", "weighted + 2 iterations"):
        assert max(values(rows, "contrast, corrected / flat wavefront", estimator)) < 2


def test_the_contrast_of_a_lyot_coronagraph_is_that_behind_its_stop():
    sensor = prepared("aplc")
    flat = aberration._contrast(sensor, np.zeros(14))
    assert flat < 1e-10
    curve = aberration._curve(sensor, np.zeros(14))
    assert curve[9] == pytest.approx(flat, rel=0.3)  # 4.75 to 5.25 lambda/D
    assert aberration._between_samples(sensor)[0].measured < 1e-8


def test_masks_and_throughputs_are_those_of_the_sensors(tables):
    assert values(tables["fig3"], "outer radius") == [4.0]
    assert values(tables["fig3"], "reflecting area")[0] == pytest.approx(16 * np.pi, rel=0.01)
    light = {row.quantity: row.measured for row in tables["fig2"]}
    reflected = light["reflected by the focal-plane mask / light on it"]
    assert [reflected] == values(tables["fig3"], "reflected / light on it")
    assert all(0 < fraction < 1 for fraction in light.values())


def test_estimates_agree_with_true_coefficients(tables):
    assert values(tables["fig5"], "slope", "pinv") == pytest.approx([1.0] * 4, abs=0.1)
    assert min(values(tables["fig5"], "correlation", "pinv")) > 0.95
    rows = tables["fig6"]
    assert all(row.limit < 1.0 for row in rows)
    assert len(values(rows, "R^2", "pinv")) == 14
    assert values(rows, "mean R^2", "pinv")[0] > 0.97
    assert values(rows, "least R^2", "pinv")[0] > 0.8  # with four wavefronts; the last test has a hundred


def test_two_iterations_approach_the_limit(tables):
    rows = tables["fig7"]
    assert {row.estimator for row in rows} == set(ESTIMATORS)
    for name in ("sam, coma Z7", "sam, coma Z8"):
        plain, one, two = (values(rows, "P-V residual", each, name)[0] for each in ESTIMATORS[3:])
        assert one < 0.6 * plain
        assert two < 1.6 * rows[0].limit


def test_pure_modes_are_linear_and_iterations_widen_the_range(tables):
    rows = tables["fig8"]
    mean = [values(rows, "mean relative deviation from linearity at lambda/20", each)[0] for each in ESTIMATORS[:3]]
    assert mean[0] < 0.06
    assert all(more < 0.5 * fewer for fewer, more in pairwise(mean))
    assert all(value < 0.01 for value in values(rows, "largest error of a random wavefront, matched input", "pinv"))
    assert len(values(rows, "amplitude of 10 % deviation", "pinv", "sam, Z")) == 14


def test_correction_of_screens_approaches_the_best_fit_of_fourteen_modes(tables):
    rows = tables["fig9"]
    for name in ("sam, cut from", "sam, periodic"):
        best = values(rows, "residual rms", "best possible fit", name)[0]
        assert 0.01 < best < 0.03
        total_rms = np.hypot(best, values(rows, "reconstructed rms", "best possible fit", name)[0])
        assert total_rms == pytest.approx(0.05, rel=0.03)  # squares add for each screen; these are means over screens
        assert all((row.limit is None) == (row.quantity != "residual rms") for row in rows)
        for estimator in ("pinv", "weighted", "weighted + 2 iterations"):
            assert best < values(rows, "residual rms", estimator, name)[0] < 2.5 * best


def test_the_signal_of_a_milliarcsecond_agrees_with_the_slope_of_the_image(tables):
    rows = tables["fig10"]
    sensor = prepared("sam")
    u = 2 * pupil_axis(512)
    tilt_nm = 1e-3 / 3600 * np.pi / 180 * 2.0 / 4 * 1e9 * 2 * np.broadcast_to(u, (512, 512))  # diameter 2 m; Z2 = 2 u
    np.testing.assert_allclose(sensor.opd_nm(np.array([NM_PER_MAS, 0.0])), tilt_nm, atol=1e-3)
    slope = sensor.band_tilt_H[:, 0] * NM_PER_MAS / sensor.band_I0.max()
    assert values(rows, "P-V change of the image / its peak", name="sam, tilt x")[0] == pytest.approx(
        np.ptp(slope), rel=0.02
    )


def test_the_signal_to_noise_ratio_of_an_image_agrees_with_the_bound_of_tilt(tables):
    rows, sensor = tables["fig10"], prepared("sam")
    light_e = electrons(STAR, TABLE4_EXPOSURE_S)
    slope_e, noise_e2 = light_e * NM_PER_MAS * sensor.band_tilt_H[:, 1:2], variance_e2(light_e * sensor.band_I0, 1.0)
    least_mas = np.sqrt(cramer_rao(slope_e, noise_e2)[0, 0])
    ratio = values(rows, "signal-to-noise ratio of the image", name="sam, tilt y")[0]
    assert ratio == pytest.approx(1.0 / least_mas, rel=0.03)
    expected = np.max(np.abs(slope_e[:, 0]) / np.sqrt(noise_e2))
    brightest = values(rows, "largest signal-to-noise ratio of a pixel", name="sam, tilt y")[0]
    assert brightest == pytest.approx(expected, rel=0.03)
    assert expected < ratio


def test_rows_depend_on_the_seed_but_not_on_the_number_of_threads():
    few = replace(FEW, trials=2)
    once, again = FIGURES["fig7"].run(few), FIGURES["fig7"].run(replace(few, jobs=2))
    assert once == again
    assert once != FIGURES["fig7"].run(replace(few, seed=2))


def test_the_linear_range_ends_at_a_deviation_of_ten_per_cent():
    estimates = np.stack([AMPLITUDES * (1 - 2 * AMPLITUDES), AMPLITUDES * 1.05, AMPLITUDES * (1 - 50 * AMPLITUDES)])
    deviation = deviations(estimates)
    np.testing.assert_allclose(deviation[0], 2 * AMPLITUDES)
    assert linear_range(deviation[0]) == pytest.approx(0.05)
    assert linear_range(deviation[1]) == np.inf
    assert linear_range(deviation[2]) == pytest.approx(0.002)


@pytest.mark.slow
def test_hundred_trials_reach_the_papers_values():
    many = Context(trials=100, seed=1, jobs=2)
    fig6 = FIGURES["fig6"].run(many)
    assert values(fig6, "least R^2", "pinv", "sam")[0] > 0.95
    assert values(fig6, "mean R^2", "pinv", "sam")[0] > 0.97
    fig7 = FIGURES["fig7"].run(many)
    for estimator in ESTIMATORS[4:]:
        assert values(fig7, "P-V residual", estimator, "sam, coma Z7")[0] <= 6e-3
        assert values(fig7, "P-V residual", estimator, "sam, coma Z8")[0] <= 8e-3
    fig1 = FIGURES["fig1"].run(many)
    for estimator in ("pinv", "weighted + 1 iteration", "weighted + 2 iterations"):
        assert max(values(fig1, "contrast, corrected / flat wavefront", estimator)) < 2
    fig8 = FIGURES["fig8"].run(many)
    assert values(fig8, "mean relative deviation from linearity at lambda/20", "pinv", "sam")[0] < 0.06
