"""The verdict as tiles, before it is drawn, and how figures are written on them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

_LONGEST = 110  # letters


class Level(IntEnum):
    """How a tile is; from `WARNING` on somebody should look."""

    NEUTRAL = 0
    GOOD = 1
    WARNING = 2
    BAD = 3


@dataclass(frozen=True, slots=True)
class Tile:
    """One tile of the annunciator.

    Attributes:
        title: what it is about.
        value: the one word or figure.
        detail: what it means.
        level: of the tile.
        advice: for the headline: what is the matter, and what to do.
    """

    title: str
    value: str
    detail: str
    level: Level = Level.NEUTRAL
    advice: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The tiles, the worst of them in one sentence, and the facts: what is set, in words by title."""

    headline: str
    level: Level
    tiles: tuple[Tile, ...]
    facts: Mapping[str, str] = field(default_factory=dict)


def worst_of(tiles: Sequence[Tile]) -> Tile:
    """The first of the highest level: causes stand before what follows from them."""
    return max(tiles, key=lambda tile: tile.level)


def figure(value: float) -> str:
    """In two or three digits: nobody reads more at a glance."""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.2f}"


def duration(seconds: float) -> str:
    """A span of time in words, up to a night."""
    if seconds < 120:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.2g} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def short(text: str) -> str:
    """A text from outside, as long as a tile has room for."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
