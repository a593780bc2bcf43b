"""Tiles of the verdict, and the format of the numbers on them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum

from lowfc.contract.printable import printable
from lowfc.programs.view.draw.colours import Colour
from lowfc.programs.view.verdicts.run_state import GRACE_S, Liveness, Process

_LONGEST = 110  # letters


class Level(IntEnum):
    """Level of a tile; `WARNING` and above need attention."""

    NEUTRAL = 0
    GOOD = 1
    WARNING = 2
    BAD = 3


FILL: dict[Level, Colour] = {
    Level.NEUTRAL: (38, 42, 52),
    Level.GOOD: (0, 98, 80),
    Level.WARNING: (240, 200, 40),
    Level.BAD: (222, 80, 10),
}
"""The colours also differ in lightness, from dark to bright: grey, green, orange red (bad), yellow (warning)."""
INK: dict[Level, Colour] = {
    Level.NEUTRAL: (235, 235, 240),
    Level.GOOD: (235, 245, 240),
    Level.WARNING: (20, 16, 0),
    Level.BAD: (255, 255, 255),
}
WORD: dict[Level, str] = {Level.NEUTRAL: "", Level.GOOD: "ok", Level.WARNING: "CHECK", Level.BAD: "ALARM"}
"""Words, so that levels do not depend on colour alone."""


@dataclass(frozen=True, slots=True)
class Tile:
    """One tile of a verdict: a word or number, its explanation, and the advice for the headline."""

    title: str
    value: str
    detail: str
    level: Level = Level.NEUTRAL
    advice: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The tiles, a headline for the worst of them, and the facts of the run by title."""

    headline: str
    level: Level
    tiles: tuple[Tile, ...]
    facts: Mapping[str, str]


def worst_of(tiles: Sequence[Tile]) -> Tile:
    """The first tile of the highest level; `tiles` are in an order in which causes precede their consequences."""
    return max(tiles, key=lambda tile: tile.level)


def rounded(value: float) -> str:
    """Text of a number with at most two decimals, readable at a glance."""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def numbers(values: Sequence[float]) -> str:
    """Text of up to three numbers, or of the range of more."""
    if len(values) < 4:
        return " ".join(f"{value:g}" for value in values)
    lowest, highest = f"{min(values):.3g}", f"{max(values):.3g}"
    return f"{lowest if lowest == highest else f'{lowest} to {highest}'} ({len(values)} modes)"


def duration(seconds: float) -> str:
    """Text of a time span, up to a night."""
    if seconds < 120:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.2g} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def clock(time_ns: int, form: str = "%H:%M:%S") -> str:
    """Text of the time of day, UTC."""
    return f"{datetime.fromtimestamp(time_ns // 10**9, UTC):{form}}"


def short(text: str) -> str:
    """Text from a message, with its control characters escaped, truncated to the length of a tile."""
    text = printable(text)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def absent(title: str, name: str, process: Process, running_s: float, harm: str) -> Tile | None:
    """Tile of a process that is silent, was stopped, or has not sent anything yet; None if it runs.

    `running_s` is the time since the first message of any process, `harm` the consequence of its absence.
    """
    since = duration(process.silent_s)
    if process.life is Liveness.SILENT:
        advice = f"{name.capitalize()} silent for {since}: {harm}. Check its last output and restart it."
        return Tile(title, "DEAD", f"{name} silent for {since}", Level.BAD, advice)
    if process.life is Liveness.STOPPED:
        return Tile(title, "STOPPED", f"the {name}, on request", advice=f"The {name} was stopped.")
    if process.life is Liveness.NEVER and running_s > GRACE_S:
        advice = f"There is no {name}: {harm}. Start it for this run."
        return Tile(title, f"NO {name.upper()}", "no message from it", Level.WARNING, advice)
    if process.life is Liveness.NEVER:
        return Tile(title, "WAITING", f"for the {name}", advice=f"Waiting for the {name}.")
    return None
