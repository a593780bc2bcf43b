"""The checks of the safety code notice when it is wrong: each mutation of its source is caught by one of them."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from lowfc.control.loop import safety
from tests.support.safety_checks import CASES, LIMITS, check_kept, violations

SOURCE = Path(safety.__file__).read_text(encoding="utf-8")

MUTATIONS = {
    "stroke never looked at": ("if max(highest_nm, -lowest_nm) > stroke:", "if False:"),
    "stroke cut on one side": ("np.clip(kept, -stroke, stroke)", "np.clip(kept, None, stroke)"),
    "stroke cut on the other side": ("np.clip(kept, -stroke, stroke)", "np.clip(kept, -stroke, None)"),
    "stroke without a sign": ("if max(highest_nm, -lowest_nm) > stroke:", "if highest_nm > stroke:"),
    "stroke without a margin": ("np.float32(self.stroke_nm - margin_nm)", "np.float32(self.stroke_nm + margin_nm)"),
    "slew never looked at": ("if max(highest_move, -lowest_move) > slew:", "if False:"),
    "slew without a sign": ("if max(highest_move, -lowest_move) > slew:", "if highest_move > slew:"),
    "slew cut on one side": ("np.clip(move, -slew, slew)", "np.clip(move, None, slew)"),
    "slew cut on the other side": ("np.clip(move, -slew, slew)", "np.clip(move, -slew, None)"),
    "slew from flat": ("kept = previous_nm + move", "kept = move"),
    "slew the wrong way": ("kept = previous_nm + move", "kept = previous_nm - move"),
    "slew without a margin": ("np.float32(self.slew_nm - margin_nm)", "np.float32(self.slew_nm + margin_nm)"),
    "stroke limit for slew": ("np.float32(self.slew_nm - margin_nm)", "np.float32(self.stroke_nm - margin_nm)"),
    "neighbours never looked at": ("if highest_nm - lowest_nm > apart_nm and", "if False and"),
    "neighbours looked at where twice as far apart": (
        "if highest_nm - lowest_nm > apart_nm and",
        "if highest_nm - lowest_nm > 2 * apart_nm and",
    ),
    "neighbours without a margin": (
        "apart_nm = limits.neighbour_nm - limits.margin_nm / 2",
        "apart_nm = limits.neighbour_nm + limits.margin_nm",
    ),
    "neighbours in a column only": ("float(max(rows, columns))", "float(rows)"),
    "neighbours in a row only": ("float(max(rows, columns))", "float(columns)"),
    "neighbours without a sign": (
        "np.abs(actuators_nm[1:] - actuators_nm[:-1])",
        "(actuators_nm[1:] - actuators_nm[:-1])",
    ),
    "shortened along one axis": ("for axis in (0, 1):", "for axis in (0,):"),
    "shortened along the other axis": ("for axis in (0, 1):", "for axis in (1,):"),
    "shortened too little": ("fraction = min(fraction, float(", "fraction = max(fraction, float("),
    "shortened without a sign": ("np.sign(after[over]) * before[over]", "before[over]"),
    "not shortened": ("kept = _shorten(limits, previous_nm, kept)", "pass"),
    "apart, shrunk at once": ("max(enough, slowest)", "enough"),
    "apart, never shrunk": ("max(enough, slowest)", "1"),
    "apart, not noticed": ("if apart_nm > neighbour_nm or largest_nm > limits.stroke_nm:", "if False:"),
    "not finite let through": ("if not (isfinite(lowest_nm) and isfinite(highest_nm)):", "if False:"),
    "only one value finite": (
        "if not (isfinite(lowest_nm) and isfinite(highest_nm)):",
        "if not (isfinite(lowest_nm) or isfinite(highest_nm)):",
    ),
    "not finite becomes flat": (
        "Limited(previous_nm, (Reason.NOT_FINITE,))",
        "Limited(0 * previous_nm, (Reason.NOT_FINITE,))",
    ),
    "another grid let through": ("if wanted_nm.shape != previous_nm.shape:", "if False:"),
    "not said: stroke": ("reasons.append(Reason.STROKE)", "pass"),
    "not said: slew": ("reasons.append(Reason.SLEW)", "pass"),
    "not said: neighbours": ("reasons.append(Reason.NEIGHBOUR)", "pass"),
    "limits of nothing": ("if not 2 * self.margin_nm < value < np.inf:", "if False:"),
    "margin for short strokes only": ("max(MARGIN_NM, ldexp", "min(MARGIN_NM, ldexp"),
    "dead-man one early": ("not 0 <= age_ns <= valid_for_ns", "not 0 <= age_ns < valid_for_ns"),
    "dead-man asleep": ("not 0 <= age_ns <= valid_for_ns", "False"),
    "dead-man trusts the clock": ("not 0 <= age_ns <= valid_for_ns", "age_ns > valid_for_ns"),
    "clear closes": ("(LoopMode.OPEN if calibrated", "(LoopMode.CLOSED if calibrated"),
    "clear in any mode": ('case "clear" if mode is LoopMode.SAFE:', 'case "clear" if True:'),
    "safed is not latched": ('case "open" | "close" if mode is LoopMode.SAFE:', 'case "open" | "close" if False:'),
    "close without calibration": ('case "close" if not calibrated:', 'case "close" if False:'),
    "safe can be refused": ('return LoopMode.SAFE, ""', 'return (LoopMode.SAFE if calibrated else mode), ""'),
}


def module_of(source: str) -> ModuleType:
    """The safety module from this source, beside the real one."""
    spec = importlib.util.spec_from_loader("mutated_safety", loader=None)
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module  # dataclasses look their module up
    try:
        exec(compile(source, "mutated_safety.py", "exec"), module.__dict__)  # noqa: S102  # our own source
    finally:
        del sys.modules[module.__name__]
    return module


def check(module: Any) -> None:
    """AssertionError, or whatever the mutation raises, where the module does not do what it must."""
    for case in CASES:
        check_kept(module.limit, case)
    _check_random_walks(module)
    for bad in (0.0, -1.0, np.nan, np.inf):
        for limits in ((bad, 100.0, 400.0), (700.0, bad, 400.0), (700.0, 100.0, bad)):
            try:
                module.Limits(*limits)
            except ValueError:
                continue
            raise AssertionError(f"{limits} taken")
    assert not module.expired(0, 0)
    assert not module.expired(200, 200)
    assert module.expired(201, 200)
    assert module.expired(-1, 200)
    _check_modes(module)


def _check_random_walks(module: Any) -> None:
    """Towards random shapes at the edge of what is allowed, step after step; far strokes need a wider margin."""
    rng = np.random.default_rng(7)
    usual, far, free = (LIMITS.stroke_nm, LIMITS.slew_nm, LIMITS.neighbour_nm), (2e5, 1.5e5, 1.5e5), (700.0, 500.0, 2e3)
    for bounds in (usual, far, free):  # in the last, neighbours may be anywhere
        limits, shape = module.Limits(*bounds), np.zeros((3, 4), np.float32)
        for _ in range(60):
            wanted = (rng.choice([0.3, 1, 3]) * limits.stroke_nm * rng.standard_normal((3, 4))).astype(np.float32)
            after = module.limit(limits, shape, wanted).actuators_nm
            assert violations(limits, shape, after) == []
            shape = after


def _check_modes(module: Any) -> None:
    mode, ask = module.LoopMode, module.request_mode
    for now in mode:
        for calibrated in (True, False):
            assert ask(now, "safe", calibrated)[0] is mode.SAFE
            cleared = (mode.OPEN if calibrated else mode.IDLE) if now is mode.SAFE else now
            assert ask(now, "clear", calibrated)[0] is cleared
            free = calibrated and now is not mode.SAFE
            opened = mode.SAFE if now is mode.SAFE else mode.OPEN if calibrated else mode.IDLE
            assert ask(now, "open", calibrated)[0] is opened
            assert ask(now, "close", calibrated)[0] is (mode.CLOSED if free else now)


def test_the_checks_pass_on_the_real_source() -> None:
    check(module_of(SOURCE))


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_mutation_is_caught(name: str) -> None:
    before, after = MUTATIONS[name]
    assert SOURCE.count(before) == 1, f"{before!r} is {SOURCE.count(before)} times in the source: rewrite this mutation"
    with np.errstate(all="ignore"), pytest.raises((AssertionError, ArithmeticError, ValueError)):
        check(module_of(SOURCE.replace(before, after)))
