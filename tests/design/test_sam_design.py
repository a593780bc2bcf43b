import json
import shlex
import sys
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from typer.testing import CliRunner

from lowfc.adapters.layouts import SHIPPED, load_layout
from lowfc.adapters.masks import load_pupil
from lowfc.adapters.terminal import new_app
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.design import sam_search
from lowfc.design.sam_goal import MERITS, Goal, figures, merit, paper_ratios
from lowfc.design.sam_merit import (
    TABLE3_NONLINEARITY_WAVES,
    build_optics,
    covariance_nm2,
    hole_fields,
    signal,
)
from lowfc.design.sam_search import BLOCK, Bounds, advance, holes, images, start
from lowfc.optics.band import monochromatic, uniform
from lowfc.optics.focal_mask import disk
from lowfc.optics.fourier import to_image, to_pupil
from lowfc.optics.grid import OPEN_AREA, pupil_axis
from lowfc.optics.photometry import Photometry, electrons, tilt_nm_per_mas
from lowfc.optics.sam import Layout, check, transmission
from lowfc.optics.zernike import NOLLS_20, zernikes
from lowfc.programs import design_sam as program
from lowfc.programs.design_commands import design_app
from lowfc.programs.design_sam_files import front, read_state
from lowfc.programs.design_sam_request import Search, command_of, request

RECORDED = {
    name: entry["command"] for name, entry in json.loads(SHIPPED.read_text())["layouts"].items() if "command" in entry
}
SMALL = {"merit": "table4", "holes": "4", "diameter": "0.1:0.2", "steps": BLOCK + 50, "chains": 2, "seed": 7}


@pytest.fixture(scope="module")
def pupil():
    return load_pupil()


@pytest.fixture(scope="module")
def optics():
    return build_optics(load_pupil(256))


@pytest.fixture(scope="module")
def layout():
    return load_layout("sam27d07_bal14")


@pytest.fixture(scope="module")
def modes():
    u = 2.0 * pupil_axis(512)
    return zernikes(NOLLS_20, u, u[:, None])


@pytest.fixture(scope="module")
def fields(optics, layout):
    return np.sum([hole_fields(optics, hole) for hole in layout.holes], axis=0)


def relay_of(amplitude, scale=1.0):
    mask = disk()
    return to_pupil(to_image(amplitude.astype(complex), len(mask), 8, scale) * mask, 512, 8, scale)


def at_pixels(values):
    """Sums over 2 x 2 samples, as fractions of the open circle's light."""
    return values.reshape(80, 2, 80, 2).sum(axis=(1, 3)).ravel() / (64 * OPEN_AREA)


def by_the_chain(pupil, modes, mask, wavelength_nm):
    """I0 (pixels,) and H (pixels, modes) per nm, by the full chain of Table 1."""
    scale = 550.0 / wavelength_nm
    E0, *Ek = (to_image(relay_of(a, scale) * mask, 160, 8, scale) for a in (pupil, *(pupil * modes)))
    slopes = [at_pixels(4 * np.pi / wavelength_nm * (E0 * np.conj(1j * E)).real) for E in Ek]
    return at_pixels(np.abs(E0) ** 2), np.stack(slopes, axis=1)


def noise_nm2(I0, H, light_e, read_noise_e, estimator):
    """Covariance of the modes, by propagating the noise of each pixel through the reconstructor."""
    variance = (I0 * light_e + read_noise_e**2) / light_e**2
    root = np.ones(len(I0)) if estimator == "pinv" else variance**-0.5
    R = np.linalg.pinv(H * root[:, None]) * root
    return (R * variance) @ R.T


def test_the_holes_add_up_to_the_field_of_the_full_chain(pupil, modes):
    fine = build_optics(pupil, band=monochromatic(550.0), relay_samples=512, samples_per=8)
    some = Layout("three", "", ((0.2, -0.3, 0.07), (-0.414, 0.102, 0.12), (0.0, 0.05, 0.2)))
    found = np.sum([hole_fields(fine, hole) for hole in some.holes], axis=0)
    u = pupil_axis(512)
    covered = [np.clip((d / 2 - np.hypot(u[:, None] - y, u - x)) * 512 + 0.5, 0, 1) for x, y, d in some.holes]
    for mask, allowed in ((sum(covered), 1e-6), (transmission(some, 512), 5e-3)):
        for k, amplitude in {0: pupil, 1: pupil * modes[0], 13: pupil * modes[12]}.items():
            truth = to_image(relay_of(amplitude) * mask, 160, 8, 1.0)
            assert np.linalg.norm(found[k] - truth) < allowed * np.linalg.norm(truth)


def test_the_predictions_are_those_of_the_full_chain(pupil, modes, layout, fields, optics):
    shown = figures(optics, fields)
    mask = transmission(layout, 512)
    I0, H = by_the_chain(pupil, modes, mask, 550.0)
    open_ = modes[:, pupil > 0.5]
    for estimator in ("pinv", "weighted"):
        for count in (14, 20):
            C = noise_nm2(I0, H[:, :count], 40_000 / I0.max(), 3.0, estimator)
            drawn = np.linalg.cholesky(C) @ np.random.default_rng(1).standard_normal((count, 20 * count))
            rms = np.sqrt(np.mean(np.var(drawn.T @ open_[:count], axis=1))) / 550.0
            expected = np.hypot(rms, TABLE3_NONLINEARITY_WAVES[count])
            assert shown["table3_waves"][estimator][str(count)] == pytest.approx(expected, rel=0.05)
    assert shown["throughput"] == pytest.approx(I0.sum(), rel=0.02)
    for count in (14, 20):
        assert shown["condition"][str(count)] == pytest.approx(np.linalg.cond(H[:, :count]), rel=0.02)
    band = uniform(550.0)
    at = [by_the_chain(pupil, modes[:2], mask, nm) for nm in band.wavelengths_nm]
    I0, H = np.mean([image for image, _ in at], axis=0), np.mean([response for _, response in at], axis=0)
    for estimator in ("pinv", "weighted"):
        C = noise_nm2(I0, H, electrons(Photometry(), 0.05), 1.0, estimator)
        expected = np.sqrt(np.diag(C)) / tilt_nm_per_mas(2.0)
        assert shown["table4_mas"][estimator]["2"] == pytest.approx(expected, rel=0.02)


def test_merits_are_what_their_names_say(optics, fields):
    shown = figures(optics, fields)
    tilt = max(shown["table4_mas"]["pinv"]["2"])
    expected = {
        "paper": max(paper_ratios(optics, fields).values()),
        "table3": shown["table3_waves"]["pinv"]["20"],
        "table4": tilt,
        "condition": shown["condition"]["20"],
        "throughput": 1 / shown["throughput"],
        "pareto": shown["table3_waves"]["pinv"]["20"] ** 0.75 * tilt**0.25,
    }
    assert set(expected) == set(MERITS)
    for name, value in expected.items():
        weight = 0.25 if name == "pareto" else None
        assert merit(optics, Goal(name, "pinv", 20, weight), fields) == pytest.approx(value, rel=1e-6)
    ratios = paper_ratios(optics, fields)
    assert ratios["table3 disk 14 modes"] == pytest.approx(shown["table3_waves"]["pinv"]["14"] / 5.1e-4)
    assert ratios["table4"] == pytest.approx(tilt / 0.36)
    dark = np.zeros_like(fields)
    assert merit(optics, Goal("table4"), dark) == np.inf


def test_the_weighted_estimator_is_never_worse(optics, fields):
    seen = signal(optics, fields, "disk")
    for count in (2, 14, 20):
        plain, weighted = (covariance_nm2(seen, 1e6, 3.0, count, name) for name in ("pinv", "weighted"))
        assert np.linalg.eigvalsh(plain - weighted).min() > -1e-9 * np.trace(plain)
    with pytest.raises(ValueError, match="estimator must be one of"):
        covariance_nm2(seen, 1e6, 3.0, 2, "best")


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


@settings(max_examples=60, deadline=None)
@given(bounds(), st.integers(0, 1000))
def test_no_move_leaves_the_bounds(bounds, seed):
    rng = np.random.default_rng(seed)
    orbits = list(start(bounds, seed, 0, 1).orbits)
    for step in range(40):
        if step:
            move = sam_search._move(rng, bounds, orbits, step / 40)
            if move is None:
                continue
            at, orbit = move
            orbits = [*(o for i, o in enumerate(orbits) if i != at), *([orbit] if orbit is not None else [])]
        found = holes(tuple(orbits), bounds.symmetry)
        assert bounds.count[0] <= len(found) <= bounds.count[1]
        gap = bounds.gap / 1000
        check(Layout("with gaps", "", tuple((x, y, d + min(gap, 2 * bounds.edge / 1000)) for x, y, d in found)))
        for i, (x, y, d) in enumerate(found):
            assert np.hypot(x, y) + d / 2 <= 0.5 - bounds.edge / 1000 + 1e-9
            for a, b, other in found[:i]:
                assert np.hypot(x - a, y - b) >= (d + other) / 2 + gap - 1e-9
        flip = {"none": (1, 1, 1), "x": (1, -1, 1), "y": (-1, 1, 1)}[bounds.symmetry]
        assert {tuple(np.multiply(hole, flip)) for hole in found} == set(found)


def test_every_kind_of_move_happens():
    bounds = Bounds((3, 9), (50, 100), symmetry="y")
    orbits, seen = list(start(bounds, 1, 0, 1).orbits), set()
    rng = np.random.default_rng(1)
    for _ in range(300):
        move = sam_search._move(rng, bounds, orbits, 0.5)
        if move is not None:
            at, orbit = move
            kind = "add" if at is None else "remove" if orbit is None else "move"
            sized = kind == "move" and orbit[2] != orbits[at][2]
            size = len(images(orbit, "y")) if orbit is not None else 0
            seen.add((kind, size, sized))
            orbits = [*(o for i, o in enumerate(orbits) if i != at), *([orbit] if orbit is not None else [])]
    expected = {("add", size, False) for size in (1, 2)} | {("remove", 0, False)}
    assert seen == expected | {("move", size, sized) for size in (1, 2) for sized in (False, True)}


def test_a_search_gets_better_and_repeats_itself(optics):
    goal, bounds = Goal("table4"), Bounds((5, 5), (60, 150))
    chain = start(bounds, 3, 1, 2 * BLOCK)
    first = advance(optics, goal, bounds, chain)
    second = advance(optics, goal, bounds, first)
    assert (first.step, second.step) == (BLOCK, 2 * BLOCK)
    assert advance(optics, goal, bounds, second) == second
    at_start = np.sum([sam_search.orbit_fields(optics, orbit, "none") for orbit in chain.orbits], axis=0)
    assert second.best_merit <= first.best_merit < 0.7 * merit(optics, goal, at_start)
    best = np.sum([sam_search.orbit_fields(optics, orbit, "none") for orbit in second.best], axis=0)
    assert merit(optics, goal, best) == pytest.approx(second.best_merit, rel=1e-4)
    assert advance(optics, goal, bounds, chain) == first
    assert advance(optics, goal, bounds, replace(chain, index=2)) != replace(first, index=2)


class Interrupted(Executor):
    """The user's Ctrl-C after a number of blocks."""

    def __init__(self, blocks: int) -> None:
        self.blocks, self.inside = blocks, program.Here()

    def submit(self, fn, /, *args, **kwargs):
        if not self.blocks:
            raise KeyboardInterrupt
        self.blocks -= 1
        return self.inside.submit(fn, *args, **kwargs)


def searched(**options) -> Search:
    defaults = {"estimator": None, "modes": 14, "weight": None, "focal_mask": None, "gap": 0.01, "edge": 0.0}
    return request(**{**defaults, "symmetry": "none", "name": "small", **SMALL, **options})


def run(search, folder, executor, chains=None, state=None, **files):
    out = folder / "mask.json"
    chains = program.begin(search) if chains is None else chains
    state = folder / "state.json" if state is None else state
    return program.design_sam(search, chains, out, state, executor, **files, console=Console(quiet=True)), out


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted search in this process: its result and what it wrote."""
    folder = tmp_path_factory.mktemp("whole")
    result, out = run(searched(), folder, program.Here())
    assert [path.name for path in folder.iterdir()] == ["mask.json"]
    return result, out.read_text()


def test_the_result_does_not_depend_on_where_the_chains_run(whole, tmp_path):
    with program.open_executor(2, None) as executor:
        result, out = run(searched(), tmp_path, executor)
    assert out.read_text() == whole[1]
    assert result["merits"] == whole[0]["merits"]
    assert len(set(result["merits"])) == 2


@pytest.fixture
def scheduler() -> Iterator[str]:
    """Address of a Dask scheduler with one worker, in threads of this process."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


def test_a_dask_cluster_finds_the_same(scheduler, whole, tmp_path):
    with program.open_executor(1, scheduler) as executor:
        _, out = run(searched(), tmp_path, executor)
    assert out.read_text() == whole[1]


@pytest.mark.parametrize("blocks", [2, 3])
def test_an_interrupted_search_keeps_its_best_and_goes_on(whole, tmp_path, blocks):
    result, out = run(searched(), tmp_path, Interrupted(blocks))
    assert result["interrupted"]
    assert result["steps"] < 2 * SMALL["steps"]
    load_layout(str(out))
    text = program.render(result)
    assert f"--resume {result['resume']}" in text
    search, chains = program.resumed(tmp_path / "state.json")
    assert search == searched()
    again, out = run(search, tmp_path, program.Here(), chains)
    assert (out.read_text(), again["merits"], again["interrupted"]) == (whole[1], whole[0]["merits"], False)
    assert not (tmp_path / "state.json").exists()


def test_an_interrupt_before_the_first_block_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(searched(), tmp_path, Interrupted(0))
    assert list(tmp_path.iterdir()) == []


def test_states_are_read_back_or_refused(tmp_path):
    search = searched()
    state = tmp_path / "state.json"
    with pytest.raises(DataFileError, match="no search to resume"):
        read_state(state, "pupil")
    state.write_text('{"search": {}}')
    with pytest.raises(DataFileError, match="not the state of a search"):
        read_state(state, "pupil")
    program.write_state(state, search, "pupil", program.begin(search))
    assert read_state(state, "pupil") == (search, program.begin(search))
    with pytest.raises(DataFileError, match="another shaped pupil"):
        read_state(state, "another")


def test_a_front_is_written_and_drawn(tmp_path):
    search = searched(merit="pareto", chains=3, steps=60, name="edge", estimator="pinv")
    table, picture = tmp_path / "front.csv", tmp_path / "front.png"
    result, out = run(search, tmp_path, program.Here(), front_file=table, plot_file=picture)
    head, *rows = [line.split(",") for line in table.read_text().splitlines()]
    assert head[:4] == ["layout", "holes", "table3_waves", "table4_mas"]
    assert [row[1] for row in rows] == ["4"] * 3
    on_front = [(float(row[2]), float(row[3])) for row in rows if row[-1] == "1"]
    assert all(b[0] > a[0] and b[1] < a[1] for a, b in pairwise(on_front))
    assert {shown["name"] for shown in result["layouts"]} == {row[0] for row in rows if row[-1] == "1"}
    assert picture.read_bytes().startswith(b"\x89PNG")
    for shown in result["layouts"]:
        assert len(load_layout(f"{out}:{shown['name']}").holes) == 4


def test_a_front_is_what_nothing_beats():
    at = [(1.0, 3.0), (2.0, 2.0), (2.0, 3.0), (3.0, 1.0), (3.0, 2.5), (1.0, 3.0)]
    points = [program.Point(Layout(str(i), "", ()), 0.0, *xy, 0.0) for i, xy in enumerate(at)]
    assert [point.layout.name for point in front(points)] == ["0", "1", "3", "5"]


def cli(*words):
    app = new_app("As the program has it.")
    app.add_typer(design_app, name="design")
    return CliRunner().invoke(app, ["design", "sam", *map(str, words)])


def test_the_command_records_itself_and_finds_the_same_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = cli("--merit", "condition", "--holes", 5, "--steps", 30, "--symmetry", "x", "--jobs", 1, "--json")
    assert ran.exit_code == 0, ran.output
    result = json.loads(ran.stdout)
    assert list(result["layouts"][0]["focal_masks"]) == ["disk", "bowtie"]
    first = json.loads((tmp_path / "sam.json").read_text())["layouts"]["sam"]
    assert (first["merit"], first["seed"], first["command"]) == ("condition", 1, result["command"])
    words = shlex.split(first["command"])
    assert words[:3] == ["lowfc", "design", "sam"]
    again = cli(*words[3:], "--jobs", 1, "--out", "again.json")
    assert again.exit_code == 0, again.output
    assert json.loads((tmp_path / "again.json").read_text())["layouts"]["sam"] == first
    assert command_of(searched()) in program.render({**result, "command": command_of(searched())})


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--merit", "beauty"), "merit must be one of paper, table3"),
        (("--estimator", "best"), "estimator must be one of"),
        (("--modes", "15"), "modes must be 14 or 20"),
        (("--merit", "table3", "--weight", "0.5"), "belongs to the merits paper and pareto"),
        (("--merit", "pareto", "--weight", "2"), "a weight, 0 to 1"),
        (("--merit", "pareto", "--chains", "1"), "at least 2 chains"),
        (("--merit", "table3", "--focal-mask", "both"), "only 'paper' takes both"),
        (("--focal-mask", "square"), "--focal-mask must be"),
        (("--holes", "many"), "--holes must be a number"),
        (("--holes", "9:4"), "number of holes"),
        (("--holes", "2.5"), "--holes must be in steps of 1,"),
        (("--diameter", "0.0705"), "--diameter must be in steps of 0.001"),
        (("--diameter", "2"), "hole diameters"),
        (("--diameter", "nan"), "--diameter must be a number"),
        (("--gap", "-0.1"), "gaps must not be negative"),
        (("--symmetry", "z"), "symmetry must be one of"),
        (("--seed", "-1"), "seed must not be negative"),
        (("--chains", "0"), "chains must be at least 1"),
        (("--steps", "0"), "steps must be at least 1"),
        (("--name", "a b"), "--name must be"),
        (("--holes", "40", "--diameter", "0.2"), "40 holes .* could not be placed"),
        (("--scheduler", "nowhere:1"), "no Dask scheduler answers at 'nowhere:1'"),
        (("--resume", "nowhere.json"), "no search to resume in nowhere.json"),
        (("--resume", "nowhere.json", "--focal-mask", "disk"), "leave out --focal-mask"),
        (("--out", "nowhere/mask.json", "--jobs", "1"), "nowhere/mask.state.json cannot be written"),
    ],
)
def test_mistakes_are_one_clear_error(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(program, "DASK_TIMEOUT_S", 0.2)
    ran = cli(*words)
    assert isinstance(ran.exception, (ConfigurationError, DataFileError)), ran.output
    ran_text = str(ran.exception)
    assert "\n" not in ran_text
    with pytest.raises(type(ran.exception), match=message):
        raise ran.exception
    assert list(tmp_path.iterdir()) == []


def test_missing_extras_are_named_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'lowfc\[cluster\]'"), program.open_executor(1, "x:1"):
        pass
    with pytest.raises(ConfigurationError, match=r"pip install 'lowfc\[plots\]'"):
        run(searched(), tmp_path, Interrupted(0), plot_file=tmp_path / "front.png")


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", RECORDED)
def test_the_recorded_command_finds_the_shipped_layout_again(tmp_path, name):
    ran = cli(*shlex.split(RECORDED[name])[3:], "--jobs", 1, "--out", tmp_path / "mask.json")
    assert ran.exit_code == 0, ran.output
    assert load_layout(f"{tmp_path / 'mask.json'}:{name}").holes == load_layout(name).holes
