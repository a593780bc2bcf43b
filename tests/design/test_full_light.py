"""Sensors that use all light from the focal-plane mask, their optimisation, and the quantum limit of all sensors."""

import tomllib

import numpy as np
import pytest

from lowfc.adapters.files.layouts import load_layout
from lowfc.adapters.files.sensors import sensor_from, sensor_named
from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.sections import SensorSection
from lowfc.design.fisher import cramer_rao, quantum_information, variance_e2
from lowfc.design.full_light import FocalLight, FullLight, sweep
from lowfc.design.goal import Goal, merit, predictions
from lowfc.design.merit import contrast_noise
from lowfc.design.paper import STAR, TABLE4_EXPOSURE_S
from lowfc.optics.chain.added_contrast import contrast_form
from lowfc.optics.chain.coronagraph import Coronagraph
from lowfc.optics.chain.sam import transmission
from lowfc.optics.chain.sensor import pupil_radii, reference, response
from lowfc.optics.chain.zernike import NOLLS_14, NOLLS_20, zernikes
from lowfc.optics.detector.photometry import electrons
from tests.support.loops import json_of, refusal

LIGHT_E = electrons(STAR, TABLE4_EXPOSURE_S)
# By sensor: noise of 14 modes together, nm, and median over modes of the ratio (of variances) of the quantum limit to
# the Cramer-Rao bound. Both are from an independent calculation; None: not compared.
EXPECTED = {
    "sam": (None, 0.006),
    "sam18_sized": (None, 0.013),
    "sam27d10_bal14": (None, 0.011),
    "bar": (None, 0.035),
    "zwfs": (1.57, 0.051),
    "clowfs": (1.63, 0.062),
    "zwfs_tuned": (1.30, None),
    "clowfs_tuned": (1.22, None),
    "bowtie": (None, None),
    "lyot": (None, None),
    "aplc": (None, None),
}
SLOW = ("sam18_sized", "sam27d10_bal14", "bowtie", "lyot", "aplc")
SENSORS = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in EXPECTED]


@pytest.fixture(scope="module")
def focal_light():
    return FocalLight.of(sensor_named("zwfs"))


@pytest.fixture(scope="module")
def modes():
    return zernikes(NOLLS_20, *pupil_radii(sensor_named("zwfs")))


@pytest.mark.parametrize("name", SENSORS)
def test_cramer_rao_bound_exceeds_the_quantum_limit(name, modes):
    sensor = sensor_named(name)
    I0, H = reference(sensor).ravel() * LIGHT_E, response(sensor, modes[:14]) * LIGHT_E
    bound = cramer_rao(H, variance_e2(I0, 0.0))
    limit = np.linalg.inv(quantum_information(sensor.pupil, modes[:14], 550.0, LIGHT_E))
    assert np.linalg.eigvalsh(bound - limit).min() > 0
    noise_nm, ratio = EXPECTED[name]
    if noise_nm is not None:
        assert np.sqrt(np.trace(bound)) == pytest.approx(noise_nm, rel=0.05)
    if ratio is not None:
        assert np.median(np.diag(limit) / np.diag(bound)) == pytest.approx(ratio, rel=0.1)


def test_quantum_information_of_two_holes_is_that_of_their_fringe_at_quadrature():
    """N photons at quadrature give the information N (d phase difference / d mode)^2 = 4 N."""
    n, pupil = 64, np.zeros((64, 64))
    pupil[32, 8], pupil[32, 56] = 1.0, 1.0
    mode = np.zeros((1, n, n))
    mode[0, 32, 8], mode[0, 32, 56] = 1.0, -1.0
    information = quantum_information(pupil, mode, 2 * np.pi, light_e=n * n * np.pi / 4.0)  # 1 photon in each hole
    assert information.item() == pytest.approx(4 * 2 * 1.0)  # N = 2, phases +1 and -1 per unit of the mode


@pytest.mark.parametrize("name", ["zwfs_tuned", "clowfs_tuned"])
def test_prediction_of_a_candidate_agrees_with_the_full_chain(name, focal_light, modes):
    sensor = sensor_named(name)
    candidate = FullLight(sensor, focal_light)
    central = candidate.central()
    assert np.allclose(central.I0, reference(sensor).ravel(), rtol=1e-9, atol=1e-15)
    assert np.allclose(central.H[:, 7], response(sensor, modes[7:8])[:, 0], rtol=1e-9, atol=1e-15)
    bound = cramer_rao(central.H[:, :14] * LIGHT_E, variance_e2(central.I0 * LIGHT_E, 1.0))
    expected = np.sum(contrast_form(Coronagraph(sensor.pupil), NOLLS_14, 550.0) * bound)
    assert contrast_noise(candidate.forms, central, "weighted") == pytest.approx(expected, rel=0.01)
    assert merit(candidate, Goal("contrast", "weighted")) == contrast_noise(candidate.forms, central, "weighted")
    nonlinearity_waves = {"zwfs_tuned": 9.0e-4, "clowfs_tuned": 1.4e-3}[name]  # second order, with the pseudo-inverse
    assert candidate.nonlinearity_waves(14) == pytest.approx(nonlinearity_waves, rel=0.2)
    assert predictions(candidate)["table3_waves"]["pinv"]["14"] > candidate.nonlinearity_waves(14)


def test_sweep_finds_the_minimum_between_its_values():
    values, best = sweep(lambda x: (x - 1.234) ** 2, 0.0, 4.0, 5)
    assert values.tolist() == [0, 1, 2, 3, 4]
    assert best == pytest.approx(1.234, abs=0.01)
    assert sweep(abs, 2.0, 2.0, 5)[1] == 2.0


def test_the_command_writes_the_configuration_keys_of_the_best_sensor(focal_light, tmp_path, monkeypatch):
    by_pupil = {sensor_named("zwfs").pupil.tobytes(): focal_light}  # the light on the mask depends on the pupil only
    monkeypatch.setattr(FocalLight, "of", lambda sensor: by_pupil[sensor.pupil.tobytes()])
    monkeypatch.setattr("lowfc.programs.design.full_light._POINTS", 3)
    out = tmp_path / "clowfs.toml"
    found = json_of("design", "clowfs", "--defocus", "3.2:4.2", "--out", out)
    assert found["best"] == pytest.approx(3.7, abs=0.1)
    assert min(point["merit"] for point in found["points"]) == found["figures_of_best"]["contrast_noise"]
    assert load(out).sensor.defocus_mm == pytest.approx(found["best"], rel=1e-3)
    assert tomllib.loads(out.read_text())["sensor"]["kind"] == "clowfs"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("zwfs", "--spot", "3:0.5"), "in order"),
        (("clowfs", "--defocus", "8:1.5"), "in order"),
        (("zwfs", "--spot", "0:1"), "spot_diameter"),
        (("zwfs", "--spot", "1:100"), "spot_diameter = 100.0: must be less than or equal to 8"),
        (("zwfs", "--spot", "1:"), "--spot must be a number or LOW:HIGH, got '1:'"),
        (
            ("zwfs", "--weight", "0.3"),
            "a weight, 0 to 1, belongs to the merits paper and pareto; got 0.3 with 'contrast'",
        ),
        (("zwfs", "--out", "a.toml", "--plot", "./a.toml"), "must be different files"),
    ],
)
def test_impossible_options_are_refused_before_the_search(options, message, monkeypatch):
    monkeypatch.setattr("lowfc.programs.design.full_light.FocalLight", None)
    assert message in refusal("design", *options, kind=ConfigurationError)


def test_sampling_of_the_holes_changes_image_and_response_by_under_1_percent():
    layout = load_layout(SensorSection().sam)
    fine, centres = transmission(layout, 512, 4), transmission(layout, 512)
    area = sum(np.pi / 4 * diameter**2 for _, _, diameter in layout.holes)
    assert fine.mean() == pytest.approx(area, rel=1e-3)
    assert set(np.unique(centres)) == {0.0, 1.0}
    sensors = [sensor_from(SensorSection(hole_samples=points)) for points in (1, 4)]
    basis = zernikes(NOLLS_14, *pupil_radii(sensors[0]))
    for quantity, expected in ((reference, 0.0035), (lambda sensor: response(sensor, basis), 0.0049)):
        with_centres, with_fine = map(quantity, sensors)
        assert np.linalg.norm(with_centres - with_fine) / np.linalg.norm(with_fine) == pytest.approx(expected, rel=0.2)
