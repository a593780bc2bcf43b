"""Whether a mirror keeps its own limits when it is told to go a little beyond them."""

from collections.abc import Iterator

import numpy as np

from lowfc.contract.messages import wire
from lowfc.programs.conformance.checks import Check, ok, warning, wrong
from lowfc.programs.conformance.dialogue import Dialogue, Single, surface_nm

_NEAR, _BEYOND = 0.9, 1.05
_FAR = 2.0
_ADVICE = "cut it in the driver's program, whatever is asked: the controller's limits are no reason to trust it"


def limit_checks(dialogue: Dialogue) -> Iterator[Check]:
    """Try stroke, slew and neighbour limits, all actuators together where that will do; it ends flat."""
    expected = dialogue.expected
    flat_nm = np.zeros(expected.grid, np.float32)
    dialogue.go(flat_nm)
    for check in (_stroke, _slew, _neighbour):
        yield check(dialogue, flat_nm)
        dialogue.go(flat_nm)


def _stroke(dialogue: Dialogue, flat_nm: Single) -> Check:
    """All actuators up, in moves of half the slew limit: to nine tenths of the stroke, then beyond it."""
    expected, stroke_nm = dialogue.expected, dialogue.expected.limits.stroke_nm
    want = f"no actuator above {stroke_nm:g} nm, when {_BEYOND * stroke_nm:.4g} nm are asked for"
    if not dialogue.reachable(stroke_nm):
        return _untried("stroke", want, "too many moves")
    state = dialogue.go(flat_nm + np.float32(_NEAR * stroke_nm))
    if state is None or _highest_nm(dialogue, state) < (_NEAR - 0.05) * stroke_nm:
        got = "no answer" if state is None else f"{_highest_nm(dialogue, state):.4g} nm when told {_NEAR:g} of it"
        return warning("stroke", want, got, "does mirror.stroke_nm (whole range) say what the mirror can do?")
    state = dialogue.go(flat_nm + np.float32(_BEYOND * stroke_nm))
    if state is None:
        return wrong("stroke", want, "no answer", "follow the command as far as it goes: a refusal stops the loop")
    highest_nm = _highest_nm(dialogue, state)
    got = f"{highest_nm:.4f} nm"
    if highest_nm > stroke_nm + expected.tolerance_nm:
        return wrong("stroke", want, got, _ADVICE)
    return _named(state, wire.REASON_STROKE, "stroke", want, got)


def _slew(dialogue: Dialogue, flat_nm: Single) -> Check:
    """From flat, one command further than one move may go."""
    expected, slew_nm = dialogue.expected, dialogue.expected.limits.slew_nm
    asked_nm = min(_FAR * slew_nm, _NEAR * expected.limits.stroke_nm)
    want = f"no actuator moves by more than {slew_nm:g} nm at once, when {asked_nm:.4g} nm are asked for"
    if asked_nm < _BEYOND * slew_nm:
        return _untried("slew", want, "the stroke is shorter than that")
    state, _, _ = dialogue.ask(flat_nm + np.float32(asked_nm))
    if state is None:
        return wrong("slew", want, "no answer", "follow the command as far as it goes: a refusal stops the loop")
    highest_nm = _highest_nm(dialogue, state)
    got = f"{highest_nm:.4f} nm"
    if highest_nm > slew_nm + expected.tolerance_nm:
        return wrong("slew", want, got, _ADVICE)
    return _named(state, wire.REASON_SLEW, "slew", want, got)


def _neighbour(dialogue: Dialogue, flat_nm: Single) -> Check:
    """One actuator up and those about it down, a little further apart than they may be."""
    expected, neighbour_nm = dialogue.expected, dialogue.expected.limits.neighbour_nm
    asked_nm = _BEYOND * neighbour_nm
    want = f"no two neighbours further apart than {neighbour_nm:g} nm, when {asked_nm:.4g} nm are asked for"
    if asked_nm / 2 > _NEAR * expected.limits.stroke_nm or not dialogue.reachable(asked_nm):
        return _untried("neighbours", want, "the stroke is shorter than that, or it takes too many moves")
    row, column = _inner(expected.moving)
    shape_nm = flat_nm - np.float32(asked_nm / 2)
    shape_nm[row, column] = asked_nm / 2
    state = dialogue.go(shape_nm)
    where_nm = surface_nm(state)
    if state is None or where_nm is None:
        return wrong("neighbours", want, "no answer", "follow the command as far as it goes: a refusal stops the loop")
    apart_nm = float(where_nm[row, column] - min(where_nm[row, column - 1], where_nm[row, column + 1]))
    got = f"{apart_nm:.4f} nm"
    if apart_nm > neighbour_nm + expected.tolerance_nm:
        return wrong("neighbours", want, got, _ADVICE)
    return _named(state, wire.REASON_NEIGHBOUR, "neighbours", want, got)


def _inner(moving: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> tuple[int, int]:
    """An actuator that moves, between two that do, as near to the middle as there is one."""
    good = np.zeros_like(moving)
    good[:, 1:-1] = moving[:, 1:-1] & moving[:, :-2] & moving[:, 2:]
    rows, columns = np.nonzero(good if good.any() else np.ones_like(good))
    middle = (moving.shape[0] - 1) / 2, (moving.shape[1] - 1) / 2
    nearest = int(np.argmin((rows - middle[0]) ** 2 + (columns - middle[1]) ** 2))
    return int(rows[nearest]), int(columns[nearest])


def _highest_nm(dialogue: Dialogue, state: wire.MirrorState) -> float:
    where_nm = surface_nm(state)
    return float("nan") if where_nm is None else float(np.abs(where_nm[dialogue.expected.moving]).max())


def _named(state: wire.MirrorState, reason: wire.Reason, name: str, want: str, got: str) -> Check:
    """Kept; is it also said?"""
    if reason in state.limits_hit:
        return ok(name, want, got)
    advice = f"put {wire.Reason.Name(reason)} into limits_hit: who looks on should know that the mirror was held"
    return warning(name, want, f"{got}, but limits_hit does not say so", advice)


def _untried(name: str, want: str, why: str) -> Check:
    return warning(name, want, f"not tried: {why}", "try it on the bench, by hand")
