"""Interlocks: conditions on values published by other devices on the bench, and their actions.

An interlock only ever makes the loop safer: it holds, opens, relaxes to safe mode, refuses to close, or warns. It never
closes the loop, and a loop that it opened stays open.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

Value = bool | float | str
MAX_TEXT_LENGTH = 200
"""Largest number of characters of a text value."""


class Action(StrEnum):
    """Action of an interlock, the mildest first."""

    WARN = "warn"
    REFUSE_CLOSE = "refuse_close"
    HOLD = "hold"
    OPEN = "open"
    SAFE = "safe"


IN_WORDS = {
    Action.WARN: "only a warning",
    Action.REFUSE_CLOSE: "the loop cannot be closed",
    Action.HOLD: "a closed loop holds its command",
    Action.OPEN: "the loop opens",
    Action.SAFE: "the loop goes into safe mode",
}


class Interlock(NamedTuple):
    """A condition on a bench value.

    Attributes:
        name: name of the bench value.
        test: equal, different, above or below.
        value: value to compare with.
        action: action while the condition holds.
        max_age_ns: age above which the bench value is too old.
        acts_when_old: whether the interlock acts if the value is too old, of another type, or was never received.
    """

    name: str
    test: str
    value: Value
    action: Action
    max_age_ns: int
    acts_when_old: bool = True

    def cause(self, value: Value | None, age_ns: int) -> str:
        """Why the interlock acts on a value of this age (None if never received); empty if it does not act."""
        max_age_s = self.max_age_ns * 1e-9
        if value is None:
            return f"no value of {self.name} has been received" if self.acts_when_old else ""
        if age_ns > self.max_age_ns:
            return f"no value of {self.name} for more than {max_age_s:g} s" if self.acts_when_old else ""
        if type(value) is not type(self.value):
            return f"{self.name} is {shown(value)}, not {_KINDS[type(self.value)]}" if self.acts_when_old else ""
        return f"{self.name} is {shown(value)}{self._compared()}" if self._holds(value) else ""

    def _holds(self, value: Value) -> bool:
        if isinstance(value, float) and isinstance(self.value, float) and self.test in _BOUNDS:
            return value > self.value if self.test == "above" else value < self.value
        return value == self.value if self.test == "equal" else value != self.value

    def _compared(self) -> str:
        return "" if self.test == "equal" else f", {self.test if self.test in _BOUNDS else 'not'} {shown(self.value)}"


class Acting(NamedTuple):
    """An interlock that acts.

    Attributes:
        number: index of the interlock in the settings.
        action: the interlock's action.
        why: cause when the interlock began to act; the value may change afterwards.
    """

    number: int
    action: Action
    why: str


@dataclass(frozen=True, slots=True)
class BenchReport:
    """The newest bench value of this name, None if none was received; the process computes its age before `advance`."""

    time_ns: int
    name: str
    value: Value | None
    age_ns: int = 0


def judged(interlocks: tuple[Interlock, ...], acting: tuple[Acting, ...], report: BenchReport) -> tuple[Acting, ...]:
    """The interlocks that act after a report; the same object if nothing changed.

    An interlock that acts already keeps its cause, unless its missing value is received or its value becomes missing.
    """
    before = {each.number: each for each in acting}
    after = dict(before)
    for number, interlock in enumerate(interlocks):
        if interlock.name == report.name:
            why = interlock.cause(report.value, report.age_ns)
            if not why:
                after.pop(number, None)
            elif number not in after or _by_value(after[number].why, report) is not _by_value(why, report):
                after[number] = Acting(number, interlock.action, why)
    return acting if after == before else tuple(after[number] for number in sorted(after))


def refusal(acting: tuple[Acting, ...], name: str) -> str:
    """Why acting interlocks refuse to `close` the loop or `clear` safe mode; empty if they do not."""
    return "; ".join(
        f"an interlock acts: {interlock.why}" for interlock in acting if interlock.action in _REFUSING.get(name, ())
    )


def shown(value: Value) -> str:
    """Format a value for people."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:g}" if isinstance(value, float) else repr(value)


def _by_value(why: str, report: BenchReport) -> bool:
    """Whether an interlock with this cause acts because of the value, not because a value is missing."""
    return why.startswith(f"{report.name} is ")


_REFUSING = {"clear": (Action.SAFE,), "close": (Action.REFUSE_CLOSE, Action.HOLD, Action.OPEN, Action.SAFE)}
_BOUNDS = ("above", "below")
_KINDS = {bool: "true or false", float: "a number", str: "a text"}
