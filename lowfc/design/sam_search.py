"""Simulated annealing of the holes of a sparse aperture mask, in blocks that can be stopped, stored and continued.

Positions and diameters are integer thousandths of the pupil's diameter, so that a layout is written without loss. With
a mirror symmetry a chain moves orbits: a hole on the axis, or a hole together with its mirror image.
"""

from dataclasses import dataclass, replace
from math import ceil, exp, hypot, inf, log

import numpy as np

from lowfc.arrays import SingleComplex
from lowfc.control.loop.wording import counted
from lowfc.design.goal import Goal, merit
from lowfc.design.sam_merit import RELAY_SAMPLES, Optics, SamCandidate, hole_fields

Orbit = tuple[int, int, int]
"""One hole of an orbit: centre x, y and diameter, in thousandths of the pupil's diameter; `images` adds the other."""

UNIT = 1000  # the pupil's diameter, in the unit of all lengths
SMALLEST = ceil(UNIT / RELAY_SAMPLES)
"""Smallest diameter of a hole: one sample of the relay pupil, since a smaller hole may cover none."""
SYMMETRIES = ("none", "x", "y")
BLOCK = 200
"""Steps of a block; the state of a chain can be stored after each block."""

_ATTEMPTS = 60  # attempts to place a hole at random
_PACKINGS = 200  # attempts to find a random starting layout
_WARM, _COLD = 0.01, 0.0003  # temperature at the start and at the end, in relative change of the merit
_FAR, _NEAR = 80.0, 1.5  # scale of the moves at the start and at the end, thousandths of the pupil's diameter


@dataclass(frozen=True)
class Bounds:
    """Constraints on every layout of a search; lengths in thousandths of the pupil's diameter.

    Attributes:
        count: Smallest and largest number of holes.
        diameter: Smallest and largest diameter.
        gap: Least distance between the rims of two holes.
        edge: Least distance between a hole's rim and the pupil's edge.
        symmetry: "none", or the axis, "x" or "y", about which the mask is its own mirror image.
    """

    count: tuple[int, int] = (27, 27)
    diameter: tuple[int, int] = (70, 70)
    gap: int = 10
    edge: int = 0
    symmetry: str = "none"

    def __post_init__(self) -> None:
        if not 1 <= self.count[0] <= self.count[1]:
            raise ValueError(f"the number of holes must be at least 1, and fewest:most in order, got {self.count}")
        if not SMALLEST <= self.diameter[0] <= self.diameter[1] <= UNIT - 2 * self.edge:
            raise ValueError(
                f"hole diameters must be in order and lie between {SMALLEST / UNIT} and {1 - 2 * self.edge / UNIT:g} "
                f"pupil diameters, got {self.diameter[0] / UNIT} to {self.diameter[1] / UNIT}"
            )
        if self.gap < 0 or self.edge < 0:
            raise ValueError(f"gap and edge must not be negative, got {self.gap / UNIT} and {self.edge / UNIT}")
        if self.symmetry not in SYMMETRIES:
            raise ValueError(f"symmetry must be one of {', '.join(SYMMETRIES)}, got {self.symmetry!r}")


@dataclass(frozen=True)
class Chain:
    """State of one annealing chain between two blocks.

    Attributes:
        seed: Seed of the search.
        index: Index of this chain.
        steps: Total number of steps.
        step: Number of steps made.
        orbits: Current layout.
        best: Best layout found.
        best_merit: Merit of the best layout.
    """

    seed: int
    index: int
    steps: int
    step: int
    orbits: tuple[Orbit, ...]
    best: tuple[Orbit, ...]
    best_merit: float = inf


def start(bounds: Bounds, seed: int, index: int, steps: int) -> Chain:
    """Start a chain at a random layout; ValueError if the holes could not be placed."""
    rng = np.random.default_rng([seed, index])
    for _ in range(_PACKINGS):
        orbits = _packed(rng, bounds)
        if orbits is not None:
            return Chain(seed, index, steps, 0, orbits, orbits)
    raise ValueError(
        f"{counted(bounds.count[0], 'hole')} of at least {bounds.diameter[0] / UNIT} pupil diameters with gaps of "
        f"{bounds.gap / UNIT} could not be placed in {_PACKINGS} attempts; ask for fewer, smaller or closer holes"
    )


def advance(optics: Optics, goal: Goal, bounds: Bounds, chain: Chain) -> Chain:
    """Make the next block of steps, if any remain; the result depends only on the arguments."""
    if chain.step >= chain.steps:
        return chain
    rng = np.random.default_rng([chain.seed, chain.index, 1 + chain.step])
    orbits, best, best_merit = list(chain.orbits), chain.best, chain.best_merit
    fields = [orbit_fields(optics, orbit, bounds.symmetry) for orbit in orbits]
    total = np.sum(fields, axis=0)
    current = merit(SamCandidate(optics, total), goal)
    if current < best_merit:
        best, best_merit = tuple(orbits), current
    end = min(chain.step + BLOCK, chain.steps)
    for step in range(chain.step, end):
        progress = step / chain.steps
        temperature = _WARM * (_COLD / _WARM) ** progress
        move = _move(rng, bounds, orbits, progress)
        if move is None:
            continue
        removed, added = move
        field = None if added is None else orbit_fields(optics, added, bounds.symmetry)
        changed = total if removed is None else total - fields[removed]
        changed = changed if field is None else changed + field
        value = merit(SamCandidate(optics, changed), goal)
        # The change is relative: a layout 1 % worse is accepted equally often at any merit.
        accepted = value < current or (value < inf and rng.random() < exp(-log(value / current) / temperature))
        if not accepted:
            continue
        if removed is not None:
            del orbits[removed], fields[removed]
        if added is not None and field is not None:
            orbits.append(added)
            fields.append(field)
        total, current = changed, value
        if current < best_merit:
            best, best_merit = tuple(orbits), current
    return replace(chain, step=end, orbits=tuple(orbits), best=best, best_merit=best_merit)


def holes(orbits: tuple[Orbit, ...], symmetry: str) -> tuple[tuple[float, float, float], ...]:
    """The holes (x, y, diameter) of the orbits in pupil diameters, sorted."""
    expanded = sorted(hole for orbit in orbits for hole in images(orbit, symmetry))
    return tuple((x / UNIT, y / UNIT, diameter / UNIT) for x, y, diameter in expanded)


def images(orbit: Orbit, symmetry: str) -> tuple[Orbit, ...]:
    """The orbit's one or two holes."""
    x, y, diameter = orbit
    mirrored = {"none": orbit, "x": (x, -y, diameter), "y": (-x, y, diameter)}[symmetry]
    return (orbit,) if mirrored == orbit else (orbit, mirrored)


def orbit_fields(optics: Optics, orbit: Orbit, symmetry: str) -> SingleComplex:
    """Contribution of the orbit's holes to the fields at the sensor."""
    return np.asarray(np.sum([hole_fields(optics, hole) for hole in holes((orbit,), symmetry)], axis=0))


def _packed(rng: np.random.Generator, bounds: Bounds) -> tuple[Orbit, ...] | None:
    """A random layout with the fewest holes and smallest diameters; None if a hole could not be placed."""
    orbits: list[Orbit] = []
    missing = bounds.count[0]
    while missing:
        paired = bounds.symmetry != "none" and missing >= 2
        orbit = _placed(rng, bounds, orbits, paired, bounds.diameter[0])
        if orbit is None:
            return None
        orbits.append(orbit)
        missing -= 1 + paired
    return tuple(orbits)


def _move(
    rng: np.random.Generator, bounds: Bounds, orbits: list[Orbit], progress: float
) -> tuple[int | None, Orbit | None] | None:
    """A random change: index of the removed orbit, and the added orbit (either may be None); None if there is none.

    `progress` is the fraction of the chain's steps made so far.
    """
    at = int(rng.integers(len(orbits)))
    if bounds.count[0] < bounds.count[1] and rng.random() < 0.1:
        count = sum(len(images(orbit, bounds.symmetry)) for orbit in orbits)
        if rng.random() < 0.5:
            remaining = count - len(images(orbits[at], bounds.symmetry))
            return (at, None) if remaining >= bounds.count[0] else None
        paired = bounds.symmetry != "none" and rng.random() < 0.8
        diameter = int(rng.integers(bounds.diameter[0], bounds.diameter[1] + 1))
        added = _placed(rng, bounds, orbits, paired, diameter) if count + 1 + paired <= bounds.count[1] else None
        return (None, added) if added is not None else None
    others = orbits[:at] + orbits[at + 1 :]
    paired = len(images(orbits[at], bounds.symmetry)) == 2
    jumps = rng.random() < 0.25 * (1.0 - progress)
    resizes = bounds.diameter[0] < bounds.diameter[1] and rng.random() < 0.4
    reach = _FAR * (_NEAR / _FAR) ** progress
    for _ in range(_ATTEMPTS):
        x, y, diameter = orbits[at]
        if resizes:
            diameter = int(np.clip(diameter + round(rng.normal(0.0, 0.3 * reach + 1.0)), *bounds.diameter))
        if jumps:
            orbit = _anywhere(rng, bounds, paired, diameter)
        else:
            x, y = x + round(rng.normal(0.0, reach)), y + round(rng.normal(0.0, reach))
            orbit = _on_axis(bounds, (x, y, diameter), paired)
        if orbit != orbits[at] and _fits(bounds, orbit, others, paired):
            return at, orbit
    return None


def _placed(rng: np.random.Generator, bounds: Bounds, others: list[Orbit], paired: bool, diameter: int) -> Orbit | None:
    """A random orbit that does not collide with the others; None if none was found."""
    for _ in range(_ATTEMPTS):
        orbit = _anywhere(rng, bounds, paired, diameter)
        if _fits(bounds, orbit, others, paired):
            return orbit
    return None


def _anywhere(rng: np.random.Generator, bounds: Bounds, paired: bool, diameter: int) -> Orbit:
    x, y = (int(value) for value in rng.integers(-UNIT // 2, UNIT // 2 + 1, 2))
    return _on_axis(bounds, (x, y, diameter), paired)


def _on_axis(bounds: Bounds, orbit: Orbit, paired: bool) -> Orbit:
    """The orbit; if it is a single hole, it is moved onto the symmetry axis, if there is one."""
    x, y, diameter = orbit
    if bounds.symmetry == "none" or paired:
        return orbit
    return (x, 0, diameter) if bounds.symmetry == "x" else (0, y, diameter)


def _fits(bounds: Bounds, orbit: Orbit, others: list[Orbit], paired: bool) -> bool:
    """Whether an orbit is a pair if required, inside the pupil, and clear of its own image and of the others."""
    own = images(orbit, bounds.symmetry)
    x, y, diameter = orbit
    if len(own) != 1 + paired or 2 * hypot(x, y) + diameter > UNIT - 2 * bounds.edge:
        return False
    if paired and hypot(own[0][0] - own[1][0], own[0][1] - own[1][1]) < diameter + bounds.gap:
        return False
    return all(
        2 * hypot(x - a, y - b) >= diameter + d + 2 * bounds.gap
        for other in others
        for a, b, d in images(other, bounds.symmetry)
    )
