from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lowfc.design import sam_search
from lowfc.design.sam_goal import Goal, merit
from lowfc.design.sam_search import BLOCK, Bounds, advance, holes, images, start
from lowfc.optics.chain.sam import Layout, check


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
