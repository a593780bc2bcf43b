"""Predicted performance of aperture masks, and the search for better ones."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lowfc.adapters.files.layouts import load_layout
from lowfc.adapters.files.sensors import load_pupil, sensor_named
from lowfc.contract.sections import SensorSection
from lowfc.design import sam_merit, sam_search
from lowfc.design.goal import MERITS, Goal, merit, paper_ratios, predictions
from lowfc.design.merit import contrast_noise, covariance_nm2, table3_waves, throughput
from lowfc.design.sam_merit import TABLE3_NONLINEARITY_WAVES, SamCandidate, build_optics, hole_fields
from lowfc.design.sam_search import BLOCK, Bounds, advance, holes, images, start
from lowfc.optics.chain.band import uniform
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.chain.sam import Layout, check, transmission
from lowfc.optics.chain.sensor import propagate, pupil_radii, reference, response
from lowfc.optics.chain.zernike import NOLLS_20, zernikes
from lowfc.optics.detector.photometry import Photometry, electrons, tilt_nm_per_mas

LAYOUT = "sam27d07_bal14"
RECORDED_TABLES = Path(__file__).parents[2] / "docs" / "measured" / "paper.json"


@pytest.fixture(scope="module")
def sensor():
    """The full chain, with the sampling of the paper's Table 1."""
    return sensor_named(LAYOUT)


@pytest.fixture(scope="module")
def optics():
    """The optics before the mask, with the sampling of a search."""
    return build_optics(load_pupil(256))


@pytest.fixture(scope="module")
def modes(sensor):
    return zernikes(NOLLS_20, *pupil_radii(sensor))


def fields_of(optics, holes):
    return np.sum([hole_fields(optics, hole) for hole in holes], axis=0)


@pytest.fixture(scope="module")
def fields(optics):
    return fields_of(optics, load_layout(LAYOUT).holes)


def noise_nm2(I0, H, light_e, read_noise_e, estimator):
    """Covariance (modes, modes), nm^2, by propagating the noise of each pixel through the reconstructor."""
    variance = (I0 * light_e + read_noise_e**2) / light_e**2
    root = np.ones(len(I0)) if estimator == "pinv" else variance**-0.5
    R = np.linalg.pinv(H * root[:, None]) * root
    return (R * variance) @ R.T


def test_sum_over_holes_agrees_with_the_field_of_the_full_chain(sensor, modes, monkeypatch):
    monkeypatch.setattr(sam_merit, "RELAY_SAMPLES", 512)
    monkeypatch.setattr(sam_merit, "SAMPLES_PER", 8)
    three = Layout("three", "", ((0.2, -0.3, 0.07), (-0.414, 0.102, 0.12), (0.0, 0.05, 0.2)))
    fields = fields_of(build_optics(sensor.pupil), three.holes)
    u = pupil_axis(512)
    # Fraction of each sample that a hole covers, linear in the sample's distance to the edge.
    # The radii are slightly reduced, so that the covered area is exactly that of the hole.
    radii = {d: np.sqrt(d**2 / 4 - 1 / (12 * 512**2)) for *_, d in three.holes}
    covered = [np.clip((radii[d] - np.hypot(u[:, None] - y, u - x)) * 512 + 0.5, 0, 1) for x, y, d in three.holes]
    for mask, allowed in ((sum(covered), 1e-6), (transmission(three, 512), 5e-3)):
        full_chain = replace(sensor, relay=ApertureMask(mask))
        for k, shape in {0: 1.0, 1: modes[0], 13: modes[12]}.items():
            truth = propagate(full_chain, sensor.pupil * shape, 550.0)
            assert np.linalg.norm(fields[k] - truth) < allowed * np.linalg.norm(truth)


def test_predictions_agree_with_the_full_chain(sensor, modes, fields, optics):
    predicted = predictions(SamCandidate(optics, fields))
    I0, H = reference(sensor).ravel(), response(sensor, modes)
    overlap = np.cov(modes[:, sensor.pupil > 0.5], bias=True)  # its quadratic forms are variances over the open pupil
    for estimator in ("pinv", "weighted"):
        for count in (14, 20):
            C = noise_nm2(I0, H[:, :count], 40_000 / I0.max(), 3.0, estimator)
            drawn = np.linalg.cholesky(C) @ np.random.default_rng(1).standard_normal((count, 20 * count))
            rms = np.sqrt(np.mean(np.einsum("kn,kl,ln->n", drawn, overlap[:count, :count], drawn))) / 550.0
            expected = np.hypot(rms, TABLE3_NONLINEARITY_WAVES[count])
            assert predicted["table3_waves"][estimator][str(count)] == pytest.approx(expected, rel=0.05)
    assert predicted["throughput"] == pytest.approx(I0.sum(), rel=0.02)
    for count in (14, 20):
        assert predicted["condition"][str(count)] == pytest.approx(np.linalg.cond(H[:, :count]), rel=0.02)
    band = uniform(550.0)
    I0, H = reference(sensor, band).ravel(), response(sensor, modes[:2], band)
    for estimator in ("pinv", "weighted"):
        C = noise_nm2(I0, H, electrons(Photometry(), 0.05), 1.0, estimator)
        expected = np.sqrt(np.diag(C)) / tilt_nm_per_mas(2.0)
        assert predicted["table4_mas"][estimator]["2"] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("diameter", "allowed"), [(0.03, 0.02), (0.01, 0.05)])
def test_light_through_small_holes_agrees_with_the_full_chain(sensor, optics, diameter, allowed):
    rings = [(0.12 * ring * np.cos(k), 0.12 * ring * np.sin(k), diameter) for ring in (1, 2, 3) for k in range(6)]
    relay = ApertureMask(transmission(Layout("small", "", tuple(rings)), 512, 4))
    light = reference(replace(sensor, relay=relay)).sum()
    assert throughput(SamCandidate(optics, fields_of(optics, rings)).central("disk")) == pytest.approx(
        light, rel=allowed
    )


def test_the_light_through_the_smallest_hole_is_finite(optics):
    assert np.isfinite(hole_fields(optics, (0.0, 0.0, 1e-3))).all()


def test_merits_agree_with_their_definitions(optics, fields):
    mask = SamCandidate(optics, fields)
    predicted = predictions(mask)
    tilt = max(predicted["table4_mas"]["pinv"]["2"])
    expected = {
        "paper": max(paper_ratios(mask).values()),
        "table3": predicted["table3_waves"]["pinv"]["20"],
        "table4": tilt,
        "condition": predicted["condition"]["20"],
        "throughput": 1 / predicted["throughput"],
        "pareto": predicted["table3_waves"]["pinv"]["20"] ** 0.75 * tilt**0.25,
        "contrast": contrast_noise(optics.forms, mask.central("disk"), "pinv"),
    }
    assert set(expected) == set(MERITS)
    for name, value in expected.items():
        weight = 0.25 if name == "pareto" else None
        assert merit(mask, Goal(name, "pinv", 20, weight)) == pytest.approx(value, rel=1e-6)
    ratios = paper_ratios(mask)  # relative to the paper's values, 5.1e-4 waves and 0.36 mas
    assert ratios["table3 disk 14 modes"] == pytest.approx(predicted["table3_waves"]["pinv"]["14"] / 5.1e-4)
    assert ratios["table4"] == pytest.approx(tilt / 0.36)
    table4 = ratios.pop("table4")
    weighted = max(max(ratios.values()) ** 0.5, table4**1.5)
    assert merit(mask, Goal("paper", weight=0.25)) == pytest.approx(weighted)
    for name in ("paper", "pareto"):
        assert merit(mask, Goal(name)) == merit(mask, Goal(name, weight=0.5))
    assert merit(SamCandidate(optics, np.zeros_like(fields)), Goal("table4")) == np.inf


def test_the_weighted_estimator_is_never_noisier_than_the_pseudo_inverse(optics, fields):
    disk_signal = SamCandidate(optics, fields).central("disk")
    for count in (2, 14, 20):
        plain, weighted = (covariance_nm2(disk_signal, 1e6, 3.0, count, name) for name in ("pinv", "weighted"))
        assert np.linalg.eigvalsh(plain - weighted).min() > -1e-9 * np.trace(plain)
    with pytest.raises(ValueError, match="estimator must be one of"):
        covariance_nm2(disk_signal, 1e6, 3.0, 2, "best")


@pytest.mark.parametrize("modes", [14, 20])
def test_prediction_of_table_3_agrees_with_the_measurement(optics, modes):
    (measured,) = (
        row["measured"]
        for table in json.loads(RECORDED_TABLES.read_text())["tables"]
        for row in table["rows"]
        if (table["table"], row["name"], row["modes"], row["estimator"], row["quantity"])
        == ("table3", "sam", modes, "pinv", "RMS residual, matched input")
    )
    default = load_layout(SensorSection().sam)
    mask = SamCandidate(optics, fields_of(optics, default.holes))
    assert table3_waves(mask, "disk", modes, "pinv") == pytest.approx(measured, rel=0.1)


@st.composite
def bounds(draw):
    smallest = draw(st.integers(10, 90))
    fewest = draw(st.integers(1, 9))
    return Bounds(
        (fewest, fewest + draw(st.integers(0, 5))),
        (smallest, smallest + draw(st.integers(0, 90))),
        draw(st.integers(0, 30)),
        draw(st.integers(0, 20)),
        draw(st.sampled_from(sam_search.SYMMETRIES)),
    )


def moved(orbits, at, orbit):
    """The orbits after a move that removes the orbit at index `at` and adds `orbit`; either may be None."""
    remaining = [each for index, each in enumerate(orbits) if index != at]
    return remaining if orbit is None else [*remaining, orbit]


@settings(max_examples=60, deadline=None)
@given(bounds(), st.integers(0, 1000))
def test_moves_stay_within_the_bounds(bounds, seed):
    rng = np.random.default_rng(seed)
    orbits = list(start(bounds, seed, 0, 1).orbits)
    for step in range(40):
        if step:
            move = sam_search._move(rng, bounds, orbits, step / 40)
            if move is None:
                continue
            at, orbit = move
            orbits = moved(orbits, at, orbit)
        placed = holes(tuple(orbits), bounds.symmetry)
        assert bounds.count[0] <= len(placed) <= bounds.count[1]
        gap = bounds.gap / 1000
        enlarged = tuple((x, y, d + min(gap, 2 * bounds.edge / 1000)) for x, y, d in placed)
        check(Layout("holes that fill gap and edge", "", enlarged))
        for i, (x, y, d) in enumerate(placed):
            assert np.hypot(x, y) + d / 2 <= 0.5 - bounds.edge / 1000 + 1e-9
            for a, b, other in placed[:i]:
                assert np.hypot(x - a, y - b) >= (d + other) / 2 + gap - 1e-9
        flip = {"none": (1, 1, 1), "x": (1, -1, 1), "y": (-1, 1, 1)}[bounds.symmetry]
        assert {tuple(np.multiply(hole, flip)) for hole in placed} == set(placed)


def test_every_kind_of_move_occurs():
    bounds = Bounds((3, 9), (50, 100), symmetry="y")
    orbits, kinds = list(start(bounds, 1, 0, 1).orbits), set()
    rng = np.random.default_rng(1)
    for _ in range(300):
        move = sam_search._move(rng, bounds, orbits, 0.5)
        if move is not None:
            at, orbit = move
            kind = "add" if at is None else "remove" if orbit is None else "move"
            resized = kind == "move" and orbit[2] != orbits[at][2]
            size = len(images(orbit, "y")) if orbit is not None else 0
            kinds.add((kind, size, resized))
            orbits = moved(orbits, at, orbit)
    expected = {("add", size, False) for size in (1, 2)} | {("remove", 0, False)}
    assert kinds == expected | {("move", size, resized) for size in (1, 2) for resized in (False, True)}


def test_search_improves_and_is_reproducible(optics):
    goal, bounds = Goal("table4"), Bounds((5, 5), (60, 150))
    chain = start(bounds, 3, 1, 2 * BLOCK)
    first = advance(optics, goal, bounds, chain)
    second = advance(optics, goal, bounds, first)
    assert (first.step, second.step) == (BLOCK, 2 * BLOCK)
    assert advance(optics, goal, bounds, second) == second
    at_start = np.sum([sam_search.orbit_fields(optics, orbit, "none") for orbit in chain.orbits], axis=0)
    assert second.best_merit <= first.best_merit < 0.7 * merit(SamCandidate(optics, at_start), goal)
    best = np.sum([sam_search.orbit_fields(optics, orbit, "none") for orbit in second.best], axis=0)
    assert merit(SamCandidate(optics, best), goal) == pytest.approx(second.best_merit, rel=1e-4)
    assert advance(optics, goal, bounds, chain) == first
    assert advance(optics, goal, bounds, replace(chain, index=2)) != replace(first, index=2)
