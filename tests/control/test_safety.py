"""The limits of the mirror hold exactly, in float64, for any requested shape; tests detect mutations of the source."""

import importlib.util
import pkgutil
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lowfc.arrays import Single
from lowfc.control.loop import safety
from lowfc.control.loop.safety import Limit, Limits, LoopMode, limit, neighbour_difference_nm, request_mode
from tests.support.safety_checks import CASES, LIMITS, check_case, violations

GRID = (4, 5)


def boundary_values(bounds: tuple[float, ...]) -> list[float]:
    """Values at and next to each limit, the limit less 1e-3 nm, and half the limit; with both signs."""
    values = [0.0, 1e-40, -1e-45, 1e-3]
    for bound in bounds:
        for value in (np.float32(bound), np.float32(bound - 1e-3), np.float32(bound / 2)):
            below = np.nextafter(value, np.float32(0))
            above = np.nextafter(value, np.float32(np.inf))
            values += [float(v) for v in (value, below, above, np.nextafter(above, np.float32(np.inf)))]
    return values + [-value for value in values]


BOUNDARY_VALUES = boundary_values((LIMITS.stroke_nm, LIMITS.slew_nm, LIMITS.neighbour_nm))
finite = st.one_of(st.sampled_from(BOUNDARY_VALUES), st.floats(-2000, 2000, width=32))
any_value = st.one_of(finite, st.floats(width=32), st.sampled_from([np.inf, -np.inf, np.nan, 1e38, -3.4e38]))


def within_limits(shape: Single) -> Single:
    """The shape, clipped at the stroke limit and scaled down to the neighbour limit."""
    shape = np.clip(shape, -np.float32(LIMITS.stroke_nm), np.float32(LIMITS.stroke_nm))
    difference_nm = neighbour_difference_nm(shape.astype(np.float64))
    while difference_nm > LIMITS.neighbour_nm:
        shape = (shape * np.float32(LIMITS.neighbour_nm / difference_nm * (1 - 1e-7))).astype(np.float32)
        difference_nm = neighbour_difference_nm(shape.astype(np.float64))
    return shape


allowed_shapes = hnp.arrays(np.float32, GRID, elements=finite.map(np.float32)).map(within_limits)
"""Shapes within the limits, many of them exactly at a limit."""


@settings(max_examples=400, deadline=None, derandomize=True)
@given(previous=allowed_shapes, requested=hnp.arrays(np.float32, GRID, elements=any_value.map(np.float32)))
def test_the_limits_hold_for_any_requested_shape(previous: Single, requested: Single) -> None:
    assert violations(LIMITS, previous, previous) == []
    limited = limit(LIMITS, previous, requested)
    assert violations(LIMITS, previous, limited.actuators_nm) == []
    assert limited.actuators_nm.dtype == np.float32
    if not np.isfinite(requested).all():
        assert limited.reasons == (Limit.NOT_FINITE,)
        assert np.array_equal(limited.actuators_nm, previous)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(stroke=st.floats(5, 2e5), slew=st.floats(0.05, 1), neighbour=st.floats(0.05, 1), seed=st.integers(0, 2**32 - 1))
@example(stroke=2e5, slew=0.05, neighbour=0.05, seed=1)
def test_commands_are_within_the_limits_for_any_values_of_the_limits(
    stroke: float, slew: float, neighbour: float, seed: int
) -> None:
    """This holds for 20 successive commands, also for strokes at which float32 rounding exceeds the default margin."""
    limits = Limits(stroke, slew * stroke, neighbour * stroke)
    rng = np.random.default_rng(seed)
    shape = np.zeros(GRID, np.float32)
    for _ in range(20):
        requested = (rng.choice([0.01, 1, 3]) * stroke * rng.standard_normal(GRID)).astype(np.float32)
        after = limit(limits, shape, requested).actuators_nm
        assert violations(limits, shape, after) == []
        shape = after


@settings(max_examples=200, deadline=None, derandomize=True)
@given(previous=allowed_shapes, fraction=st.floats(0, 1))
def test_a_move_within_the_limits_is_not_changed(previous: Single, fraction: float) -> None:
    """The move is well within all limits; no reason is reported."""
    requested = (previous * np.float32(fraction)).astype(np.float32)
    assume(np.abs(requested.astype(np.float64) - previous).max() < LIMITS.slew_nm - 0.01)
    assume(np.abs(requested).max() < LIMITS.stroke_nm - 0.01)
    assume(neighbour_difference_nm(requested.astype(np.float64)) < LIMITS.neighbour_nm - 0.01)
    limited = limit(LIMITS, previous, requested)
    assert limited.reasons == ()
    assert np.array_equal(limited.actuators_nm, requested)


def test_diagonal_actuators_are_not_neighbours() -> None:
    shape = np.zeros((2, 2), np.float32)
    shape[0, 0], shape[1, 1] = 1, -1
    assert neighbour_difference_nm(shape.astype(np.float64)) == 1


@pytest.mark.parametrize("shape", [(5, 4), (4, 4), (20,), (0, 0), (1, 4, 5)])
def test_a_requested_shape_of_another_grid_is_refused(shape: tuple[int, ...]) -> None:
    previous = np.full(GRID, 7, np.float32)
    limited = limit(LIMITS, previous, np.zeros(shape, np.float32))
    assert limited.reasons == (Limit.WRONG_GRID,)
    assert np.array_equal(limited.actuators_nm, previous)


def test_a_requested_shape_beyond_the_range_of_float32_is_limited_too() -> None:
    limited = limit(LIMITS, np.zeros(GRID, np.float32), np.full(GRID, 1e300))
    assert violations(LIMITS, np.zeros(GRID, np.float32), limited.actuators_nm) == []
    assert limited.actuators_nm.dtype == np.float32


@pytest.mark.parametrize("stroke_nm", [100.0, 333.3, 700.0, 750.0])
def test_a_limited_shape_is_within_the_limits(stroke_nm: float) -> None:
    limits = Limits(stroke_nm, stroke_nm, 3 * stroke_nm)
    flat = np.zeros(GRID, np.float32)
    kept = limit(limits, flat, np.full(GRID, 2 * stroke_nm, np.float32))
    assert kept.reasons
    assert limit(limits, flat, kept.actuators_nm).reasons == ()
    assert limit(limits, kept.actuators_nm, kept.actuators_nm).reasons == ()


def test_the_arguments_are_not_modified() -> None:
    rng = np.random.default_rng(4)
    previous = (200 * rng.standard_normal(GRID)).astype(np.float32)
    requested = (900 * rng.standard_normal(GRID)).astype(np.float32)
    copies = previous.copy(), requested.copy()
    limit(LIMITS, previous, requested)
    assert np.array_equal(previous, copies[0])
    assert np.array_equal(requested, copies[1])


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    previous=hnp.arrays(np.float32, GRID, elements=st.floats(-3000, 3000, width=32)),
    requested=hnp.arrays(np.float32, GRID, elements=finite.map(np.float32)),
)
def test_a_shape_outside_the_limits_returns_to_them(previous: Single, requested: Single) -> None:
    """A shape outside the limits never moves further out, and returns at no more than the slew limit."""
    shape, steps = previous, 0
    while violations(LIMITS, shape, shape):
        after = limit(LIMITS, shape, requested).actuators_nm
        assert np.isfinite(after).all()
        largest, difference_nm = np.abs(shape).max(), neighbour_difference_nm(shape.astype(np.float64))
        assert np.abs(after.astype(np.float64) - shape).max() <= LIMITS.slew_nm
        assert np.abs(after).max() <= max(largest, LIMITS.stroke_nm)
        if largest > LIMITS.stroke_nm:
            assert np.abs(after).max() < largest
        if largest <= LIMITS.stroke_nm and difference_nm > LIMITS.neighbour_nm:
            assert neighbour_difference_nm(after.astype(np.float64)) < difference_nm
        shape, steps = after, steps + 1
        assert steps < 200
    assert violations(LIMITS, shape, limit(LIMITS, shape, requested).actuators_nm) == []


@settings(max_examples=200, deadline=None, derandomize=True)
@given(previous=st.one_of(allowed_shapes, hnp.arrays(np.float32, GRID, elements=st.floats(-3000, 3000, width=32))))
def test_repeated_requests_for_flat_reach_flat_within_the_slew_limit(previous: Single) -> None:
    shape, steps = previous, 0
    while shape.any():
        after = limit(LIMITS, shape, np.zeros(GRID, np.float32)).actuators_nm
        assert np.abs(after.astype(np.float64) - shape).max() <= LIMITS.slew_nm
        assert np.abs(after).max() < np.abs(shape).max()
        shape, steps = after, steps + 1
        assert steps <= 2 * np.ceil(np.abs(previous).max() / (LIMITS.slew_nm - 1e-3)) + 2


@settings(max_examples=100, deadline=None, derandomize=True)
@given(shape=allowed_shapes, seed=st.integers(0, 2**32 - 1))
def test_a_mirror_pressed_against_the_neighbour_limit_stays_there(shape: Single, seed: int) -> None:
    """Repeated requests beyond the limit neither move the mirror back towards flat nor make it oscillate."""
    rng = np.random.default_rng(seed)
    requested = (5000 * rng.standard_normal(GRID)).astype(np.float32)
    for _ in range(30):
        shape = limit(LIMITS, shape, requested).actuators_nm
    settled = shape
    for _ in range(10):
        shape = limit(LIMITS, shape, requested).actuators_nm
        assert np.abs(shape - settled).max() < 0.1


def test_safe_clear_open_and_close_lead_to_the_specified_modes() -> None:
    check_modes(safety)


def test_request_mode_refuses_an_unknown_request() -> None:
    with pytest.raises(ValueError, match="'dance'"):
        request_mode(LoopMode.OPEN, "dance", calibrated=True)


def test_the_document_on_safety_names_code_that_exists() -> None:
    text = (Path(__file__).parents[2] / "docs" / "explanation" / "safety.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| ")]
    names = {name for row in rows for name in re.findall(r"`([\w.]+)`", row[3])}
    assert len(names) > 30
    for name in names:
        pkgutil.resolve_name(f"lowfc.{name}")


SOURCE = Path(safety.__file__).read_text(encoding="utf-8")

MUTATIONS = {
    "stroke not checked": ("if max(highest_nm, -lowest_nm) > stroke:", "if False:"),
    "stroke clipped on one side": ("np.clip(kept, -stroke, stroke)", "np.clip(kept, None, stroke)"),
    "stroke clipped on the other side": ("np.clip(kept, -stroke, stroke)", "np.clip(kept, -stroke, None)"),
    "stroke without a sign": ("if max(highest_nm, -lowest_nm) > stroke:", "if highest_nm > stroke:"),
    "stroke without a margin": ("np.float32(self.stroke_nm - margin_nm)", "np.float32(self.stroke_nm + margin_nm)"),
    "slew not checked": ("if max(highest_move, -lowest_move) > slew:", "if False:"),
    "slew without a sign": ("if max(highest_move, -lowest_move) > slew:", "if highest_move > slew:"),
    "slew clipped on one side": ("np.clip(move, -slew, slew)", "np.clip(move, None, slew)"),
    "slew clipped on the other side": ("np.clip(move, -slew, slew)", "np.clip(move, -slew, None)"),
    "slew from flat": ("kept = previous_nm + move", "kept = move"),
    "slew in the wrong direction": ("kept = previous_nm + move", "kept = previous_nm - move"),
    "slew without a margin": ("np.float32(self.slew_nm - margin_nm)", "np.float32(self.slew_nm + margin_nm)"),
    "stroke limit for slew": ("np.float32(self.slew_nm - margin_nm)", "np.float32(self.stroke_nm - margin_nm)"),
    "neighbours not checked": ("if highest_nm - lowest_nm > apart_nm and", "if False and"),
    "neighbours checked at twice the limit": ("- lowest_nm > apart_nm and", "- lowest_nm > 2 * apart_nm and"),
    "neighbours without a margin": ("neighbour_nm - limits.margin_nm / 2", "neighbour_nm + limits.margin_nm"),
    "neighbours in a column only": ("float(max(rows, columns))", "float(rows)"),
    "neighbours in a row only": ("float(max(rows, columns))", "float(columns)"),
    "neighbours without a sign": ("np.abs(actuators_nm[1:]", "(actuators_nm[1:]"),
    "shortened along one axis": ("for axis in (0, 1):", "for axis in (0,):"),
    "shortened along the other axis": ("for axis in (0, 1):", "for axis in (1,):"),
    "shortened too little": ("fraction = min(fraction, float(", "fraction = max(fraction, float("),
    "shortened without a sign": ("np.sign(after[beyond]) * before[beyond]", "before[beyond]"),
    "not shortened": ("kept = _shorten(limits, previous_nm, kept)", "pass"),
    "shape outside the limits shrunk at once": ("max(within_limits, within_slew)", "within_limits"),
    "shape outside the limits not shrunk": ("max(within_limits, within_slew)", "1"),
    "shape outside the limits not detected": ("if apart_nm > neighbour_nm or", "if False and"),
    "non-finite values accepted": ("if not (isfinite(lowest_nm) and isfinite(highest_nm)):", "if False:"),
    "one finite value suffices": ("(isfinite(lowest_nm) and", "(isfinite(lowest_nm) or"),
    "non-finite values become flat": ("(previous_nm, (Limit.NOT_FINITE,))", "(0 * previous_nm, (Limit.NOT_FINITE,))"),
    "another grid accepted": ("if requested_nm.shape != previous_nm.shape:", "if False:"),
    "stroke not reported": ("reasons.append(Limit.STROKE)", "pass"),
    "slew not reported": ("reasons.append(Limit.SLEW)", "pass"),
    "neighbours not reported": ("reasons.append(Limit.NEIGHBOUR)", "pass"),
    "invalid limits accepted": ("if not 2 * self.margin_nm < value < np.inf:", "if False:"),
    "margin for short strokes only": ("max(MARGIN_NM, ldexp", "min(MARGIN_NM, ldexp"),
    "command timeout one nanosecond early": ("not 0 <= age_ns <= valid_for_ns", "not 0 <= age_ns < valid_for_ns"),
    "no command timeout": ("not 0 <= age_ns <= valid_for_ns", "False"),
    "command timeout without a check of the clock": ("not 0 <= age_ns <= valid_for_ns", "age_ns > valid_for_ns"),
    "clear closes": ("(LoopMode.OPEN if calibrated", "(LoopMode.CLOSED if calibrated"),
    "clear in any mode": ('case "clear" if mode is LoopMode.SAFE:', 'case "clear" if True:'),
    "safe mode is not latched": ('case "open" | "close" if mode is LoopMode.SAFE:', 'case "open" | "close" if False:'),
    "close without calibration": ('case "close" if not calibrated:', 'case "close" if False:'),
    "safe can be refused": ('return LoopMode.SAFE, ""', 'return (LoopMode.SAFE if calibrated else mode), ""'),
}


def module_of(source: str) -> ModuleType:
    """The safety module made from this source."""
    spec = importlib.util.spec_from_loader("mutated_safety", loader=None)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module  # dataclasses look their module up
    try:
        exec(compile(source, "mutated_safety.py", "exec"), module.__dict__)  # noqa: S102  # our own source
    finally:
        del sys.modules[module.__name__]
    return module


def check(module: Any) -> None:
    """Raise AssertionError, or an error that the mutation causes, if the module does not work."""
    for case in CASES:
        check_case(module.limit, case)
    _check_random_walks(module)
    for bad in (0.0, -1.0, 1e-3, np.nan, np.inf):
        for limits in ((bad, 100.0, 400.0), (700.0, bad, 400.0), (700.0, 100.0, bad)):
            try:
                module.Limits(*limits)
            except ValueError:
                continue
            raise AssertionError(f"{limits} accepted")
    assert not module.expired(0, 0)
    assert module.expired(1, 0)
    assert not module.expired(200, 200)
    assert module.expired(201, 200)
    assert module.expired(-1, 200)
    check_modes(module)


def _check_random_walks(module: Any) -> None:
    """Random walks at the limits; long strokes need a wider margin."""
    rng = np.random.default_rng(7)
    for bounds in (
        (LIMITS.stroke_nm, LIMITS.slew_nm, LIMITS.neighbour_nm),
        (2e5, 1.5e5, 1.5e5),
        (700.0, 500.0, 2e3),  # the neighbour limit has no effect
    ):
        limits, shape = module.Limits(*bounds), np.zeros((3, 4), np.float32)
        for _ in range(60):
            requested = (rng.choice([0.3, 1, 3]) * limits.stroke_nm * rng.standard_normal((3, 4))).astype(np.float32)
            after = module.limit(limits, shape, requested).actuators_nm
            assert violations(limits, shape, after) == []
            shape = after


def check_modes(module: Any) -> None:
    mode, ask = module.LoopMode, module.request_mode
    for before in mode:
        for calibrated in (True, False):
            assert ask(before, "safe", calibrated) == (mode.SAFE, "")
            safe, opened = before is mode.SAFE, mode.OPEN if calibrated else mode.IDLE
            after, refusal = ask(before, "clear", calibrated)
            assert (after, "nothing to clear" in refusal) == ((opened, False) if safe else (before, True))
            after, refusal = ask(before, "open", calibrated)
            assert (after, "clear" in refusal) == ((before, True) if safe else (opened, False))
            after, refusal = ask(before, "close", calibrated)
            if safe or not calibrated:
                assert (after, ("clear" if safe else "calibration") in refusal) == (before, True)
            else:
                assert (after, refusal) == (mode.CLOSED, "")


def test_the_checks_pass_on_the_source_without_a_mutation() -> None:
    check(module_of(SOURCE))


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_mutation_of_the_source_fails_the_checks(name: str) -> None:
    before, after = MUTATIONS[name]
    assert SOURCE.count(before) == 1, f"{before!r} is {SOURCE.count(before)} times in the source: rewrite this mutation"
    with np.errstate(all="ignore"), pytest.raises((AssertionError, ArithmeticError, ValueError)):
        check(module_of(SOURCE.replace(before, after)))
