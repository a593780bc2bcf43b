"""The twin against the full optical chain from which it is built, and the report of its benchmark."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lowfc.adapters.files.layouts import layout_names
from lowfc.adapters.files.sensors import sensor_from, sensor_named
from lowfc.adapters.files.twin_cache import load_or_build, load_or_fit_mirror
from lowfc.contract.sections import SENSORS, SensorSection
from lowfc.optics.chain.band import gauss_legendre
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.mirror import Mirror, influence_factors, modes_to_actuators
from lowfc.optics.chain.sensor import image, reference, response
from lowfc.optics.chain.zernike import NOLLS_20, zernikes
from lowfc.optics.twin.nodes import interpolation, node_axis
from lowfc.optics.twin.twin import ACCURATE, FAST, Evaluator, TwinSpec, node_radii, projected_response, wavefront_rms_nm
from lowfc.optics.twin.twin import reference as twin_reference
from lowfc.optics.twin.twin import response as twin_response
from lowfc.optics.twin.twin_build import build
from lowfc.optics.twin.twin_mirror import poke_wavefronts_nm, wavefront_nm
from lowfc.programs.measure.bench import twin as bench


def fast_twin(name):
    return load_or_build(sensor_named(name), FAST)


@pytest.fixture(scope="module")
def tilts_nm():
    """Mirror commands for tilts of 34 nm rms of wavefront, and their surfaces at the pupil's samples."""
    factors = influence_factors(Mirror(), pupil_axis(512), 34)
    shapes = [34.0 * tilt.reshape(34, 34) for tilt in modes_to_actuators(Mirror(), [2, 3]).T]
    return [(shape, factors @ shape @ factors.T) for shape in shapes]


def relative_l2(ours, truth):
    return np.linalg.norm(ours - truth) / np.linalg.norm(truth)


def full_images(sensor, modes, coefficients_nm, band=None):
    return [image(sensor, np.tensordot(each, modes, 1), band) for each in coefficients_nm]


@pytest.fixture(scope="module")
def default_images(sensor, modes, coefficients_nm):
    """Images of the first eight wavefronts by the full chain of the default sensor."""
    return full_images(sensor, modes, coefficients_nm[:8])


def worst_error(twin, coefficients_nm, images):
    """Largest relative error of the twin's images; the full chain's `images` may cover only the first wavefronts."""
    evaluator, at_nodes = Evaluator(twin), zernikes(NOLLS_20, *node_radii(twin))
    return max(
        relative_l2(evaluator.image((each @ at_nodes).astype(np.float32)), full)
        for each, full in zip(coefficients_nm, images, strict=False)
    )


@pytest.mark.parametrize(("name", "limit"), [("fast", 1e-4), ("accurate", 2e-6)])
def test_twin_of_the_default_sensor_agrees_with_the_full_chain(name, limit, request, coefficients_nm, default_images):
    assert worst_error(request.getfixturevalue(name), coefficients_nm, default_images) < limit


def test_broadband_twin_agrees_with_the_full_chain(broadband, sensor, modes, coefficients_nm):
    images = full_images(sensor, modes, coefficients_nm[:3], gauss_legendre(550.0))
    assert worst_error(broadband, coefficients_nm, images) < 1e-4


FAST_LIMITS = {
    **{name: 1e-4 for name in (*SENSORS, *layout_names()) if name not in ("sam", "sam27d07")},  # tested above
    "clowfs": 1e-5,
    "aplc": 3e-5,
}
SLOW = FAST_LIMITS.keys() - {"clowfs", "zwfs", "lyot"}
ACCURATE_LIMITS = {"clowfs": 1e-6, "zwfs": 2e-6, "bar": 1e-6, "lyot": 2e-6, "aplc": 2e-6, "bowtie": 2e-6}


@pytest.mark.parametrize(
    ("spec", "name", "limit"),
    [
        *(
            pytest.param(FAST, *item, marks=[pytest.mark.slow] if item[0] in SLOW else [])
            for item in FAST_LIMITS.items()
        ),
        *(pytest.param(ACCURATE, *item, marks=pytest.mark.slow) for item in ACCURATE_LIMITS.items()),
    ],
)
def test_twin_of_every_sensor_agrees_with_the_full_chain(spec, name, limit, modes, coefficients_nm):
    sensor = sensor_named(name)
    twin = fast_twin(name) if spec is FAST else build(sensor, spec)
    assert worst_error(twin, coefficients_nm, full_images(sensor, modes, coefficients_nm[:3])) < limit
    if (spec, name) == (FAST, "bowtie"):
        assert len(twin.operators[0].to_modes) == 171  # the rank increases with the area of the mask


@pytest.mark.parametrize(
    ("defocus_mm", "limit"),
    [(3.0, 5e-5), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((1.5, 2e-4), (12.0, 5e-5)))],
)
def test_defocused_twin_is_accurate_at_several_distances(defocus_mm, limit, modes, coefficients_nm):
    sensor = sensor_from(SensorSection(kind="clowfs", defocus_mm=defocus_mm))
    images = full_images(sensor, modes, coefficients_nm[:1])
    assert worst_error(build(sensor, FAST), coefficients_nm, images) < limit


def test_twin_of_a_clowfs_with_an_annulus_thinner_than_a_sample_agrees_with_the_full_chain():
    """Some rows of the focal-plane mask's samples, which are 0.125 lambda/D apart, have no sample in the annulus."""
    sensor = sensor_from(SensorSection(kind="clowfs", inner_radius=3.9))
    assert relative_l2(twin_reference(build(sensor, FAST)), reference(sensor)) < 5e-4


@pytest.mark.parametrize(("name", "limit"), [("fast", 3e-4), ("accurate", 1e-5)])
def test_twin_reference_and_response_agree_with_the_full_chain(name, limit, request, sensor, modes):
    twin = request.getfixturevalue(name)
    chosen = [0, 1, 2, 5, 9, 19]
    ours = twin_response(twin, zernikes([NOLLS_20[k] for k in chosen], *node_radii(twin)))
    full = response(sensor, modes[chosen])
    for k in range(len(chosen)):
        assert relative_l2(ours[:, k], full[:, k]) < limit
    assert relative_l2(twin_reference(twin), image(sensor, np.zeros((512, 512)))) < limit


@pytest.mark.parametrize("name", ["fast", "broadband"])
def test_twin_response_is_the_derivative_of_the_evaluator(name, request):
    twin = request.getfixturevalue(name)
    mode = zernikes([4], *node_radii(twin))
    evaluator = Evaluator(twin)
    up, down = (evaluator.image((step * mode[0]).astype(np.float32)).astype(float) for step in (1.0, -1.0))
    assert relative_l2(twin_response(twin, mode)[:, 0], ((up - down) / 2).ravel()) < 1e-3
    assert relative_l2(evaluator.image(np.zeros(twin.used.size, np.float32)), twin_reference(twin)) < 2e-6


@pytest.mark.parametrize("name", ["fast", "broadband", "zwfs"])
def test_the_image_of_several_wavefronts_is_the_weighted_sum_of_their_images(name, request):
    twin = fast_twin(name) if name == "zwfs" else request.getfixturevalue(name)
    evaluator = Evaluator(twin)
    opds_nm = np.random.default_rng(1).normal(scale=5.0, size=(3, twin.used.size)).astype(np.float32)
    weights = np.array([0.5, 2.0, 0.0], np.float32)
    images = np.array([evaluator.image(opd_nm) for opd_nm in opds_nm])
    assert relative_l2(evaluator.image(opds_nm, weights), np.tensordot(weights, images, 1)) < 1e-6
    assert relative_l2(evaluator.image(opds_nm), images.sum(axis=0)) < 1e-6


@pytest.mark.parametrize("name", ["fast", "broadband", "zwfs"])
@pytest.mark.parametrize("tilt_nm", [None, 20.0])
def test_projected_response_is_the_projection_of_the_response(name, tilt_nm, request):
    twin = fast_twin(name) if name == "zwfs" else request.getfixturevalue(name)
    rng = np.random.default_rng(1)
    opd_nm = None if tilt_nm is None else tilt_nm * zernikes([2], *node_radii(twin))[0]
    shapes, projections = rng.normal(size=(5, twin.used.size)), rng.normal(size=(3, len(twin.to_pixels) ** 2))
    expected = projections @ twin_response(twin, shapes, opd_nm)
    np.testing.assert_allclose(projected_response(twin, projections, opd_nm) @ shapes.T, expected, rtol=1e-9)


@pytest.mark.parametrize("name", ["accurate", "broadband", "clowfs", "zwfs"])
def test_tilt_of_the_mirror_is_accurate_to_1e_4(name, request, sensor, tilts_nm):
    band = gauss_legendre(550.0) if name == "broadband" else None
    if name in FAST_LIMITS:
        sensor, twin = sensor_named(name), fast_twin(name)
    else:
        twin = request.getfixturevalue(name)
    on_nodes = load_or_fit_mirror(sensor, twin, Mirror())
    for actuators_nm, surface in tilts_nm:
        full = image(sensor, 2.0 * surface, band)
        assert relative_l2(Evaluator(twin).image(wavefront_nm(on_nodes, actuators_nm)), full) < 1e-4


def test_mirror_on_the_nodes_gives_the_commanded_wavefront(sensor, fast):
    on_nodes = load_or_fit_mirror(sensor, fast, Mirror())
    commands = modes_to_actuators(Mirror(), NOLLS_20)
    for command, mode in zip(commands.T, zernikes(NOLLS_20, *node_radii(fast)), strict=True):
        error = wavefront_nm(on_nodes, 10.0 * command.reshape(34, 34)) - 10.0 * mode
        assert wavefront_rms_nm(fast, error) < 0.35  # of which the fit by influence functions leaves up to 0.16 nm
    pokes_nm = poke_wavefronts_nm(on_nodes) @ commands
    for command, wavefront in zip(commands.T, pokes_nm.T, strict=True):
        np.testing.assert_allclose(wavefront, wavefront_nm(on_nodes, command.reshape(34, 34)), atol=1e-5)


def test_rms_is_over_the_open_pupil_and_without_piston(sensor, modes, fast):
    open_pupil = sensor.pupil > 0.5
    at_nodes = zernikes(NOLLS_20, *node_radii(fast))
    for k in (0, 1, 2, 9):
        truth = modes[k][open_pupil].std()
        assert wavefront_rms_nm(fast, 5.0 + at_nodes[k]) == pytest.approx(truth, rel=1e-3)
    assert fast.area_weights.sum() == pytest.approx(1)


def test_interpolation_is_exact_for_polynomials_of_its_order():
    for order in (2, 4, 6):
        weights = interpolation(512, 32, order)
        axis, u = node_axis(32, order), pupil_axis(512)
        assert len(axis) == 32 + order
        for power in range(order):
            np.testing.assert_allclose(weights @ axis**power, u**power, atol=1e-12)


def test_build_reports_progress(sensor):
    calls = []
    build(sensor, replace(FAST, nodes=16, order=4), progress=lambda done, total: calls.append((done, total)))
    assert calls == [(i, 32) for i in range(1, 33)]


def test_unsupported_optics_and_specifications_are_refused(sensor):
    lopsided = sensor.focal_mask.copy()
    lopsided[:, :20] = 0
    with pytest.raises(ValueError, match="symmetric about both axes"):
        build(replace(sensor, focal_mask=lopsided), FAST)
    with pytest.raises(ValueError, match="needs a real focal-plane mask"):
        build(replace(sensor, focal_mask=sensor.focal_mask * 1j), FAST)
    with pytest.raises(ValueError, match="rank must lie between 1 and"):
        build(sensor, TwinSpec(rank=5000, nodes=16))
    with pytest.raises(ValueError, match="must be even"):
        build(sensor, TwinSpec(order=5))


def test_wavefronts_that_are_not_at_the_used_nodes_are_refused(fast):
    with pytest.raises(ValueError, match=f"each of {fast.used.size} nodes"):
        Evaluator(fast).image(np.zeros(1444, np.float32))
    with pytest.raises(ValueError, match="at the used nodes"):
        twin_response(fast, np.zeros((2, 1444)))


@pytest.mark.usefixtures("fast", "accurate", "broadband")  # in the cache, so that they are not built again
def test_benchmark_reports_all_three_twins(monkeypatch):
    monkeypatch.setattr(bench, "WAVEFRONTS", 2)
    result = bench.bench_twin(seconds=0.0)
    assert json.loads(json.dumps(result)) == result
    cases = result["cases"]
    assert [(case["rank"], case["wavelengths"]) for case in cases] == [(60, 1), (80, 1), (60, 3)]
    assert {key: result[key] for key in ("twin_us", "full_us", "ratio", "relative_l2")}.items() <= cases[0].items()
    table = bench.render(result)
    for case, limit in zip(cases, (1e-4, 2e-6, 1e-4), strict=True):
        assert 0 < case["relative_l2"] < limit
        assert case["ratio"] == case["full_us"] / case["twin_us"]
        assert case["name"] in table
