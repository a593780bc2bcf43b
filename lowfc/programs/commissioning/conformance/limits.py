"""Whether a mirror keeps its own limits when it is commanded a little beyond them."""

from collections.abc import Iterator

import numpy as np

from lowfc.arrays import Mask, Single
from lowfc.contract.messages import wire
from lowfc.programs.commissioning.checks import Check, ok, warning, wrong
from lowfc.programs.commissioning.conformance.dialogue import Dialogue

_NEAR, _BEYOND, _FAR = 0.9, 1.05, 2.0


def limit_checks(mirror: Dialogue) -> Iterator[Check]:
    """Try stroke, slew and neighbour limits, all actuators together where that will do; it ends flat."""
    limits, flat_nm = mirror.expected.limits, np.zeros(mirror.expected.grid, np.float32)
    even = np.ones_like(flat_nm)
    peak, among = _peak(mirror.expected.moving)
    stroke_nm, slew_nm, apart_nm = limits.stroke_nm, limits.slew_nm, limits.neighbour_nm
    too_far_nm = min(_FAR * slew_nm, _NEAR * stroke_nm)
    fits = _BEYOND * apart_nm / 2 <= _NEAR * stroke_nm and mirror.reachable(_BEYOND * apart_nm)
    for name, words, reason, limit_nm, asked_nm, shape, possible in (
        ("stroke", "no actuator above", wire.REASON_STROKE, stroke_nm, _BEYOND * stroke_nm, even, _rises(mirror)),
        ("slew", "no move above", wire.REASON_SLEW, slew_nm, too_far_nm, even, too_far_nm >= _BEYOND * slew_nm),
        ("neighbours", "no step above", wire.REASON_NEIGHBOUR, apart_nm, _BEYOND * apart_nm, peak, fits),
    ):
        expected = f"{words} {limit_nm:g} nm, when {asked_nm:.4g} nm are asked for"
        check = warning("not tried: it cannot go there", "do mirror.stroke_nm (whole range) and the limits fit it?")
        if possible:
            wanted_nm = np.float32(asked_nm) * shape
            state = mirror.ask(wanted_nm)[0] if name == "slew" else mirror.go(wanted_nm)
            where_nm = mirror.surface_nm(state)
            if state is None or where_nm is None:
                check = wrong("no answer", "follow the command as far as it goes: a refusal stops the loop")
            else:
                found_nm = _highest_nm(mirror, where_nm) if shape is even else float(np.ptp(where_nm[among]))
                check = _kept(state, reason, found_nm, limit_nm + mirror.expected.tolerance_nm)
        yield check._replace(name=name, expected=expected)
        mirror.go(flat_nm)


def _kept(state: wire.MirrorState, reason: wire.Reason, found_nm: float, most_nm: float) -> Check:
    got = f"{found_nm:.4f} nm"
    if found_nm > most_nm:
        return wrong(got, "cut it in the driver's program, whatever is asked: do not rely on the controller's limits")
    if reason in state.limits_hit:
        return ok(got)
    advice = f"put {wire.Reason.Name(reason)} into limits_hit: an observer should know that the mirror was held"
    return warning(f"{got}, but limits_hit does not say so", advice)


def _rises(mirror: Dialogue) -> bool:
    """Whether the mirror follows to nine tenths of its stroke, in moves of half the slew limit; it stays there."""
    stroke_nm = mirror.expected.limits.stroke_nm
    mirror.go(np.zeros(mirror.expected.grid, np.float32))
    if not mirror.reachable(stroke_nm):
        return False
    where_nm = mirror.surface_nm(mirror.go(np.full(mirror.expected.grid, _NEAR * stroke_nm, np.float32)))
    return where_nm is not None and _highest_nm(mirror, where_nm) >= (_NEAR - 0.05) * stroke_nm


def _peak(moving: Mask) -> tuple[Single, tuple[int, list[int]]]:
    """One actuator half up and all others half down; where it and its two neighbours in its row are.

    It moves, between two that do, as near to the middle as there is one.
    """
    good = np.zeros_like(moving)
    good[:, 1:-1] = moving[:, 1:-1] & moving[:, :-2] & moving[:, 2:]
    places = np.argwhere(good if good.any() else np.ones_like(good))
    row, column = map(int, places[np.argmin(((places - (np.array(moving.shape) - 1) / 2) ** 2).sum(axis=1))])
    peak = np.full(moving.shape, -0.5, np.float32)
    peak[row, column] = 0.5
    return peak, (row, [column - 1, column, column + 1])


def _highest_nm(mirror: Dialogue, surface_nm: Single) -> float:
    return float(np.abs(surface_nm[mirror.expected.moving]).max())
