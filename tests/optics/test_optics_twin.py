"""The twin against the full chain that it was made from, and what its benchmark reports."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lowfc.adapters.files.sensors import sensor_from, sensor_named
from lowfc.contract.configuration import SensorSection
from lowfc.optics.chain.band import gauss_legendre
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.mirror import Mirror, influence_factors, modes_to_actuators, surface_nm
from lowfc.optics.chain.sensor import image, response
from lowfc.optics.chain.zernike import NOLLS_20, zernikes
from lowfc.optics.twin.nodes import interpolation, node_axis
from lowfc.optics.twin.twin import ACCURATE, FAST, Evaluator, TwinSpec, node_radii, wavefront_rms_nm
from lowfc.optics.twin.twin import reference as twin_reference
from lowfc.optics.twin.twin import response as twin_response
from lowfc.optics.twin.twin_build import build
from lowfc.optics.twin.twin_mirror import twin_mirror, wavefront_nm
from lowfc.programs.measure.bench.twin import bench_twin, render


def relative_l2(ours, truth):
    return np.linalg.norm(ours - truth) / np.linalg.norm(truth)


@pytest.fixture(scope="module")
def full_images(sensor, modes, coefficients_nm):
    return [image(sensor, np.tensordot(coefficients, modes, 1)) for coefficients in coefficients_nm]


def twin_images(twin, coefficients_nm):
    evaluator = Evaluator(twin)
    wavefronts = (coefficients_nm @ zernikes(NOLLS_20, *node_radii(twin))).astype(np.float32)
    return [evaluator.image(wavefront).copy() for wavefront in wavefronts]


def worst_error(sensor, twin, modes, coefficients_nm, band=None):
    full = [image(sensor, np.tensordot(each, modes, 1), band) for each in coefficients_nm]
    return max(map(relative_l2, twin_images(twin, coefficients_nm), full))


def test_rank_60_is_right_to_1e_4_over_20_wavefronts(fast, coefficients_nm, full_images):
    errors = list(map(relative_l2, twin_images(fast, coefficients_nm), full_images))
    assert len(errors) == 20
    assert max(errors) < 1e-4


def test_rank_80_is_right_to_2e_6_over_20_wavefronts(accurate, coefficients_nm, full_images):
    assert max(map(relative_l2, twin_images(accurate, coefficients_nm), full_images)) < 2e-6


def test_broadband_is_right_to_1e_4(broadband, sensor, modes, coefficients_nm):
    assert worst_error(sensor, broadband, modes, coefficients_nm[:5], gauss_legendre(550.0)) < 1e-4


@pytest.mark.parametrize("sam", ["sam27d10_bal14", "sam27_crb20"])
def test_other_masks_are_right_to_1e_4(sam, modes, coefficients_nm):
    sensor = sensor_named(sam)
    twin = build(sensor, FAST)
    assert worst_error(sensor, twin, modes, coefficients_nm[:3]) < 1e-4


def test_the_bowtie_keeps_as_many_modes_as_its_area_needs(modes, coefficients_nm):
    sensor = sensor_named("bowtie")
    twin = build(sensor, FAST)
    assert len(twin.operators[0].to_modes) == 171
    assert worst_error(sensor, twin, modes, coefficients_nm[:3]) < 1e-4


@pytest.mark.parametrize(
    ("name", "limit"),
    [("clowfs", 1e-5), ("zwfs", 1e-4), ("bar", 1e-4), ("open", 1e-4), ("lyot", 1e-4), ("aplc", 3e-5)],
)
def test_the_twin_of_every_sensor_is_right_to_1e_4(name, limit, modes, coefficients_nm):
    sensor = sensor_named(name)
    assert worst_error(sensor, build(sensor, FAST), modes, coefficients_nm[:3]) < limit


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "limit"),
    [("clowfs", 1e-6), ("zwfs", 2e-6), ("bar", 1e-6), ("lyot", 2e-6), ("aplc", 2e-6), ("bowtie", 2e-6)],
)
def test_the_accurate_twin_of_every_sensor(name, limit, modes, coefficients_nm):
    sensor = sensor_named(name)
    assert worst_error(sensor, build(sensor, ACCURATE), modes, coefficients_nm[:3]) < limit


@pytest.mark.parametrize(("defocus_mm", "limit"), [(1.5, 2e-4), (3.0, 5e-5), (12.0, 5e-5)])
def test_the_defocused_twin_is_right_at_any_distance(defocus_mm, limit, modes, coefficients_nm):
    sensor = sensor_from(SensorSection(kind="clowfs", defocus_mm=defocus_mm))
    full = image(sensor, np.tensordot(coefficients_nm[0], modes, 1))
    assert relative_l2(twin_images(build(sensor, FAST), coefficients_nm[:1])[0], full) < limit


@pytest.mark.parametrize("name", ["clowfs", "zwfs"])
def test_without_a_relay_mask_the_mirrors_tilt_is_right_to_1e_4(name):
    sensor, mirror = sensor_named(name), Mirror()
    twin = build(sensor, FAST)
    on_nodes = twin_mirror(sensor, twin, mirror)
    factors = influence_factors(mirror, pupil_axis(512), 34)
    for tilt in modes_to_actuators(mirror, [2, 3]).T:
        actuators_nm = 34.0 * tilt.reshape(34, 34)
        full = image(sensor, 2.0 * surface_nm(factors, actuators_nm, factors))
        assert relative_l2(Evaluator(twin).image(wavefront_nm(on_nodes, actuators_nm)), full) < 1e-4


@pytest.mark.parametrize(("name", "limit"), [("fast", 3e-4), ("accurate", 1e-5)])
def test_reference_and_response_are_those_of_the_full_chain(name, limit, request, sensor, modes):
    twin = request.getfixturevalue(name)
    chosen = [0, 1, 2, 5, 9, 19]
    ours = twin_response(twin, zernikes([NOLLS_20[k] for k in chosen], *node_radii(twin)))
    full = response(sensor, modes[chosen])
    for k in range(len(chosen)):
        assert relative_l2(ours[:, k], full[:, k]) < limit
    assert relative_l2(twin_reference(twin), image(sensor, np.zeros((512, 512)))) < limit


@pytest.mark.parametrize("name", ["fast", "broadband"])
def test_response_is_the_slope_of_the_evaluator(name, request):
    twin = request.getfixturevalue(name)
    mode = zernikes([4], *node_radii(twin))
    evaluator = Evaluator(twin)
    up, down = (evaluator.image((step * mode[0]).astype(np.float32)).astype(float) for step in (1.0, -1.0))
    assert relative_l2(twin_response(twin, mode)[:, 0], ((up - down) / 2).ravel()) < 1e-3
    assert relative_l2(evaluator.image(np.zeros(twin.used.size, np.float32)), twin_reference(twin)) < 2e-6


@pytest.mark.parametrize("name", ["fast", "accurate", "broadband"])
def test_a_tilt_made_by_the_mirror_is_right_to_1e_4(name, request, sensor):
    twin = request.getfixturevalue(name)
    band = gauss_legendre(550.0) if name == "broadband" else None
    mirror = Mirror()
    factors = influence_factors(mirror, pupil_axis(512), 34)
    on_nodes = twin_mirror(sensor, twin, mirror)
    evaluator = Evaluator(twin)
    for tilt in modes_to_actuators(mirror, [2, 3]).T:
        actuators_nm = 34.0 * tilt.reshape(34, 34)
        full = image(sensor, 2.0 * surface_nm(factors, actuators_nm, factors), band)
        assert relative_l2(evaluator.image(wavefront_nm(on_nodes, actuators_nm)), full) < 1e-4


def test_the_mirror_on_the_nodes_makes_the_commanded_wavefront(sensor, fast):
    on_nodes = twin_mirror(sensor, fast, Mirror())
    commands = modes_to_actuators(Mirror(), NOLLS_20)
    for command, wanted in zip(commands.T, zernikes(NOLLS_20, *node_radii(fast)), strict=True):
        error = wavefront_nm(on_nodes, 10.0 * command.reshape(34, 34)) - 10.0 * wanted
        assert wavefront_rms_nm(fast, error) < 0.35  # the full surface's own fit errors reach 0.15 nm


def test_rms_is_taken_over_the_open_pupil_without_piston(sensor, modes, fast):
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


def test_progress_counts_up_to_the_end(sensor):
    seen = []
    build(sensor, replace(FAST, nodes=16, order=4), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i, 32) for i in range(1, 33)]


def test_what_cannot_be_compressed_is_refused(sensor):
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


def test_the_bench_reports_all_three_twins(cache_dir, fast, accurate, broadband):
    names = []
    result = bench_twin(seconds=0.05, progress=names.append, cache_dir=cache_dir)
    assert json.loads(json.dumps(result)) == result
    cases = result["cases"]
    assert [case["name"] for case in cases] == names
    assert [(case["rank"], case["wavelengths"]) for case in cases] == [(60, 1), (80, 1), (60, 3)]
    for key in ("twin_us", "full_us", "ratio", "relative_l2", "rank"):
        assert result[key] == cases[0][key]
    for case, limit in zip(cases, (1e-4, 2e-6, 1e-4), strict=True):
        assert 0 < case["relative_l2"] < limit
        assert case["ratio"] == case["full_us"] / case["twin_us"]
    table = render(result)
    assert all(name in table for name in names)
    assert "sensor sam" in table
