"""Limits of the mirror, changes of the loop mode and the command timeout, independent of control law and estimate.

The controller applies the limits to the commands that it sends, and the mirror again to the commands that it receives.
The controller changes the mode, the mirror applies the timeout; `docs/explanation/safety.md` lists the hazards.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from math import frexp, isfinite, ldexp
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Single
from lowfc.control.loop.wording import mode_word

MAX_LIMIT_NM = 1e9
"""Largest modal limit and actuator value of a channel, nm; a much larger number squared overflows in float32."""
MARGIN_NM = 1e-3
"""Least distance kept from stroke and slew limit, and half of it from the neighbour limit, so that float32 rounding
(6e-5 nm at 750 nm) cannot cross them."""


class LoopMode(IntEnum):
    """Mode of the loop; numbered as on the wire."""

    IDLE = 1
    OPEN = 2
    CLOSED = 3
    SAFE = 4

    @property
    def in_words(self) -> str:
        """The mode in words."""
        return mode_word(self.name.lower())


class Rejection(IntEnum):
    """Why a frame or a command was refused, or a frame is missing; numbered as on the wire."""

    NO_CALIBRATION = 1
    WRONG_SIZE = 2
    OUT_OF_ORDER = 3
    REPEATED = 4
    LATE = 5
    SATURATED = 6
    DARK = 7
    NO_FRAME = 8
    STUCK = 9
    AHEAD = 10
    CAMERA_UNKNOWN = 11
    NO_MIRROR = 12
    HELD = 13


NOT_NEW = frozenset((Rejection.OUT_OF_ORDER, Rejection.REPEATED, Rejection.AHEAD))
"""Rejections of a frame that is no new exposure, or whose time is not the time of its exposure."""


class Limit(IntEnum):
    """Why a command was changed or refused; the last: the guard overrules the law. Numbered as on the wire."""

    MODAL_LIMIT = 20
    STROKE = 21
    SLEW = 22
    NEIGHBOUR = 23
    NOT_FINITE = 24
    WRONG_GRID = 25
    CHANNEL = 26
    LAW_OVERRULED = 27


Reason = Rejection | Limit
REASONS: tuple[Reason, ...] = (*Rejection, *Limit)


def reason_of(number: int) -> Reason:
    """The reason with this number on the wire; ValueError if there is none."""
    return Rejection(number) if number < Limit.MODAL_LIMIT else Limit(number)


def reason_name(number: int) -> str:
    """Name of a reason; its number if this version does not know it."""
    return next((reason.name for reason in REASONS if reason == number), str(number))


def mode_name(number: int) -> str:
    """Name of a loop mode; a numbered name if this version does not know it."""
    return LoopMode(number).name.lower() if number in list(LoopMode) else f"mode {number}"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the mirror, in nm of surface; ValueError unless each is finite and above twice the margin.

    Attributes:
        stroke_nm: largest deviation of an actuator from flat, in either direction.
        slew_nm: largest change of an actuator from one command to the next.
        neighbour_nm: largest difference between actuators side by side.
        margin_nm: distance kept from stroke and slew limit, half of it from the neighbour limit: 1e-3 nm, or 16
            spacings of float32 numbers at a long stroke.
        kept_stroke_nm: stroke minus the margin, a float32, so that a command clipped to it is not clipped again.
        kept_slew_nm: slew minus the margin, also a float32.
    """

    stroke_nm: float
    slew_nm: float
    neighbour_nm: float
    margin_nm: float = field(init=False)
    kept_stroke_nm: float = field(init=False)
    kept_slew_nm: float = field(init=False)

    def __post_init__(self) -> None:
        margin_nm = max(MARGIN_NM, ldexp(1.0, frexp(self.stroke_nm)[1] - 20))
        object.__setattr__(self, "margin_nm", margin_nm)
        object.__setattr__(self, "kept_stroke_nm", float(np.float32(self.stroke_nm - margin_nm)))
        object.__setattr__(self, "kept_slew_nm", float(np.float32(self.slew_nm - margin_nm)))
        for name in ("stroke_nm", "slew_nm", "neighbour_nm"):
            value = getattr(self, name)
            if not 2 * self.margin_nm < value < np.inf:
                raise ValueError(f"{name} must be a finite number above {2 * self.margin_nm:g} nm, got {value}")


class Limited(NamedTuple):
    """A limited command: (rows, columns) float32, nm of surface, and the limits that changed it."""

    actuators_nm: Single
    reasons: tuple[Reason, ...]


def limit(limits: Limits, previous_nm: Single, requested_nm: Single) -> Limited:
    """Limit the command `requested_nm` so that it may follow `previous_nm`.

    Both are (rows, columns) float32, nm of surface; `previous_nm` must be finite. The stroke limit, then the slew
    limit, clip each actuator separately; the neighbour limit shortens the whole move. For any `requested_nm`, the
    result is finite, and no actuator moves further than the slew limit. If `previous_nm` is within the stroke and
    neighbour limits, so is the result; otherwise it returns to them at the slew limit. A requested shape of another
    grid, or with a value that is not finite, leaves the previous command.
    """
    if requested_nm.shape != previous_nm.shape:
        return Limited(previous_nm, (Limit.WRONG_GRID,))
    lowest_nm, highest_nm = _range_nm(requested_nm)
    if not (isfinite(lowest_nm) and isfinite(highest_nm)):
        return Limited(previous_nm, (Limit.NOT_FINITE,))
    reasons: list[Reason] = []
    stroke, slew = limits.kept_stroke_nm, limits.kept_slew_nm
    kept = requested_nm
    if max(highest_nm, -lowest_nm) > stroke:
        reasons.append(Limit.STROKE)
        kept = np.clip(kept, -stroke, stroke)
    move = kept - previous_nm
    lowest_move, highest_move = _range_nm(move)
    if max(highest_move, -lowest_move) > slew:
        reasons.append(Limit.SLEW)
        move = np.clip(move, -slew, slew)
        kept = previous_nm + move
        lowest_nm, highest_nm = _range_nm(kept)
    apart_nm = limits.neighbour_nm - limits.margin_nm / 2
    # If no two actuators differ that much, no neighbours do; this check is far cheaper than a check of each pair.
    if highest_nm - lowest_nm > apart_nm and neighbour_difference_nm(kept) > apart_nm:
        reasons.append(Limit.NEIGHBOUR)
        kept = _shorten(limits, previous_nm, kept)
    return Limited(kept if kept.dtype == np.float32 else kept.astype(np.float32), tuple(reasons))


def _shorten(limits: Limits, previous_nm: Single, kept_nm: Single) -> Single:
    """Move from `previous_nm` towards `kept_nm` as far as the neighbour limit allows.

    If `previous_nm` is itself at the neighbour limit or beyond the stroke limit, it is only scaled down.

    The result is half a margin further below the neighbour limit than `limit` requires: otherwise a mirror
    exactly at it, by rounding, could no longer move.
    """
    margin_nm = limits.margin_nm
    neighbour_nm = limits.neighbour_nm - margin_nm
    apart_nm, largest_nm = neighbour_difference_nm(previous_nm.astype(np.float64)), float(np.abs(previous_nm).max())
    if apart_nm > neighbour_nm or largest_nm > limits.stroke_nm:
        stroke_nm = limits.stroke_nm - margin_nm
        within_limits = min(neighbour_nm / max(apart_nm, neighbour_nm), stroke_nm / max(largest_nm, stroke_nm))
        within_slew = 1.0 - (limits.slew_nm - margin_nm) / largest_nm
        return previous_nm * np.float32(max(within_limits, within_slew))
    fraction = 1.0
    for axis in (0, 1):
        before = np.diff(previous_nm.astype(np.float64), axis=axis)
        after = np.diff(kept_nm.astype(np.float64), axis=axis)
        beyond = np.abs(after) > neighbour_nm
        if beyond.any():
            room = neighbour_nm - np.sign(after[beyond]) * before[beyond]
            fraction = min(fraction, float((room / np.abs(after[beyond] - before[beyond])).min()))
    return previous_nm + np.float32(fraction) * (kept_nm - previous_nm)


def finite(values: Single) -> bool:
    """Whether all values (of any shape) are finite, whatever their unit."""
    return int(np.count_nonzero(np.isfinite(values))) == values.size  # faster than `all`


def _range_nm(actuators_nm: Single) -> tuple[float, float]:
    """Lowest and highest value; not finite if any value is not."""
    flat = actuators_nm.ravel()  # both functions propagate NaN
    return flat.item(flat.argmin()), flat.item(flat.argmax())


def neighbour_difference_nm(actuators_nm: npt.NDArray[np.floating]) -> float:
    """Largest difference between actuators (rows, columns) side by side, in nm, computed in the array's precision."""
    rows = np.abs(actuators_nm[1:] - actuators_nm[:-1]).max(initial=0)
    columns = np.abs(actuators_nm[:, 1:] - actuators_nm[:, :-1]).max(initial=0)
    return float(max(rows, columns))


def expired(age_ns: int, valid_for_ns: int) -> bool:
    """Whether a command received `age_ns` ago may no longer be held: it timed out, or the clock went back."""
    return not 0 <= age_ns <= valid_for_ns


def request_mode(mode: LoopMode, request: str, calibrated: bool) -> tuple[LoopMode, str]:
    """Mode after an operator's request, and why it was refused (empty if granted).

    `safe` is always granted and latched; only `clear` leaves it, and never straight to closed. ValueError for a request
    other than open, close, safe and clear.
    """
    match request:
        case "safe":
            return LoopMode.SAFE, ""
        case "clear" if mode is LoopMode.SAFE:
            return (LoopMode.OPEN if calibrated else LoopMode.IDLE), ""
        case "clear":
            return mode, f"the loop is {mode.in_words}, not in safe mode: there is nothing to clear"
        case "open" | "close" if mode is LoopMode.SAFE:
            return mode, "the loop is in safe mode: `lowfc ctl clear` first, when the mirror may move"
        case "open" if not calibrated:
            return LoopMode.IDLE, ""
        case "close" if not calibrated:
            return mode, "there is no calibration for these frames"
        case "open":
            return LoopMode.OPEN, ""
        case "close":
            return LoopMode.CLOSED, ""
    raise ValueError(f"{request!r} is not a request for a loop mode: open, close, safe or clear")
