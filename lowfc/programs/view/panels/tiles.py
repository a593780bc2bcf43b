"""The annunciator: the verdict as a picture, a headline above large coloured tiles with words on them."""

import io
from datetime import UTC, datetime
from functools import lru_cache
from itertools import pairwise
from math import ceil

import numpy as np
import numpy.typing as npt
import rerun as rr
from PIL import Image, ImageDraw, ImageFont

from lowfc.programs.view.draw.colours import Colour
from lowfc.programs.view.draw.plots import at
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.night import Night
from lowfc.programs.view.verdicts.tile import Level, Tile, Verdict
from lowfc.programs.view.verdicts.verdict import judge
from lowfc.programs.view.verdicts.watcher import Watcher

TILES = "status/tiles"
WIDTH, HEIGHT = 1760, 256
GROUND: Colour = (13, 16, 17)
"""Rerun's own, so that only the tiles are seen."""
FILL: dict[Level, Colour] = {
    Level.NEUTRAL: (38, 42, 52),
    Level.GOOD: (0, 98, 80),
    Level.WARNING: (240, 200, 40),
    Level.BAD: (222, 80, 10),
}
"""They differ in lightness too: dark grey, green, orange red, bright yellow."""
INK: dict[Level, Colour] = {
    Level.NEUTRAL: (235, 235, 240),
    Level.GOOD: (235, 245, 240),
    Level.WARNING: (20, 16, 0),
    Level.BAD: (255, 255, 255),
}
WORD: dict[Level, str] = {Level.NEUTRAL: "", Level.GOOD: "ok", Level.WARNING: "CHECK", Level.BAD: "ALARM"}
"""Never colour alone."""
SHORTEST_NS = 250_000_000
"""Between pictures with another word or colour."""
FIGURES_NS = 1_000_000_000
"""Between pictures where only figures differ: nobody reads them faster, and each stays in the viewer's memory. The
clock is drawn as often where nothing else is new: when it stands, the view does."""

_GAP, _INSET, _BAND, _CLOCK = 6, 9, 46, 190
_TILES_END = 196
_FACTS = (3, 4, 4, 4)  # widths of the facts below the tiles, to each other
_SMALLEST = 8
_SHADES = 16
_PITCH = 1.16

Box = tuple[int, int, int, int]
Shades = npt.NDArray[np.uint8]


class Tiles(Panel):
    """Watches the run, and draws the verdict when it is another one; at the end of a log, that on all of it."""

    def __init__(self, nm_per_mas: float | None = None) -> None:
        """With the wavefront rms of a tilt of 1 mas, where the telescope is known."""
        self._nm_per_mas = nm_per_mas
        self._watcher = Watcher()
        self._night = Night()
        self._drawn: Verdict | None = None
        self._drawn_ns = self._judged_ns = self._clock_ns = 0

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Judge, and show the verdict if it changed, or the clock did."""
        self._watcher.feed(snapshot)
        self._night.feed(snapshot, self._watcher)
        if snapshot.ended is not None:
            self._show(stream, snapshot.time_ns, self._night.verdict(self._watcher, snapshot.ended))
            return
        if 0 <= snapshot.host_ns - self._judged_ns < SHORTEST_NS:
            return
        self._judged_ns = snapshot.host_ns
        verdict = judge(self._watcher, self._nm_per_mas)
        if (
            self._drawn is not None
            and _gist(verdict) == _gist(self._drawn)
            and snapshot.time_ns // FIGURES_NS == self._clock_ns // FIGURES_NS
            and 0 <= snapshot.host_ns - self._drawn_ns < FIGURES_NS
        ):
            return
        self._show(stream, snapshot.time_ns, verdict)
        self._drawn, self._drawn_ns, self._clock_ns = verdict, snapshot.host_ns, snapshot.time_ns

    def _show(self, stream: rr.RecordingStream, time_ns: int, verdict: Verdict) -> None:
        at(stream, time_ns)
        stream.log(TILES, rr.EncodedImage(contents=png(picture(verdict, time_ns)), media_type="image/png"))


def picture(verdict: Verdict, time_ns: int) -> Image.Image:
    """The verdict and its time as a picture with a palette: of each level, shades from its fill to its ink."""
    headline, *boxes = places(len(verdict.tiles))
    colours = np.full((HEIGHT, WIDTH), _SHADES * len(Level), np.uint8)
    _put(colours, headline, verdict.level, _headline(WORD[verdict.level].upper(), verdict.headline))
    _put(colours, (WIDTH - _CLOCK, 0, WIDTH, _BAND), verdict.level, _clock(time_ns // 10**9))
    for box, tile in zip(boxes, verdict.tiles, strict=True):
        _put(colours, box, tile.level, _tile(tile, box[2] - box[0], box[3] - box[1]))
    for box, (title, text) in zip(fact_places(), verdict.facts.items(), strict=False):
        _put(colours, box, Level.NEUTRAL, _fact(title, text, box[2] - box[0], box[3] - box[1]))
    image = Image.fromarray(colours).convert("P")
    image.putpalette(_palette())
    return image


def places(tiles: int) -> list[Box]:
    """Where the headline and so many tiles are: left, top, and right, bottom just outside."""
    boxes = [(0, 0, WIDTH, _BAND)]
    for number in range(tiles):
        left, right = ((WIDTH + _GAP) * one // tiles for one in (number, number + 1))
        boxes.append((left, _BAND + _GAP, right - _GAP, _TILES_END))
    return boxes


def fact_places() -> list[Box]:
    """Where the facts are, below the tiles."""
    ends = [(WIDTH + _GAP) * sum(_FACTS[:number]) // sum(_FACTS) for number in range(len(_FACTS) + 1)]
    return [(left, _TILES_END + _GAP, right - _GAP, HEIGHT) for left, right in pairwise(ends)]


def png(image: Image.Image) -> bytes:
    """As PNG: a thirtieth of the pixels' size, which a viewer would keep for all of the night."""
    content = io.BytesIO()
    image.save(content, "PNG", compress_level=1)
    return content.getvalue()


def _gist(verdict: Verdict) -> tuple[tuple[str, Level, str], ...]:
    """A verdict without its figures."""
    return tuple(
        (tile.title, tile.level, "".join(letter for letter in tile.value if letter.isalpha())) for tile in verdict.tiles
    )


def _put(colours: Shades, box: Box, level: Level, shades: Shades) -> None:
    x0, y0, x1, y1 = box
    colours[y0:y1, x0:x1] = level * _SHADES + shades


@lru_cache(maxsize=8)
def _headline(word: str, sentence: str) -> Shades:
    page = _Page(WIDTH, _BAND)
    right, bottom = WIDTH - _CLOCK - _INSET, _BAND - _INSET // 2
    left = _INSET + page.line((_INSET, _INSET // 2, _INSET + 130, bottom), word, 30)
    page.write((left + (_INSET if word else 0), _INSET // 2, right, bottom), sentence, 27)
    return page.shades()


def _clock(seconds: int) -> Shades:
    page = _Page(_CLOCK, _BAND)
    time = f"{datetime.fromtimestamp(seconds, UTC):%H:%M:%S} UTC"
    page.line((_INSET, _INSET // 2, _CLOCK - _INSET, _BAND - _INSET // 2), time, 27)
    return page.shades()


@lru_cache(maxsize=64)
def _tile(tile: Tile, width: int, height: int) -> Shades:
    """Words of a tile; most of them are the same from one picture to the next."""
    page = _Page(width, height)
    word, right = WORD[tile.level], width - _INSET
    middle = right - ceil(_width(word, 17))
    page.line((middle, 5, right, 25), word, 17)
    page.line((_INSET, 5, middle - _INSET, 25), tile.title, 17)
    page.line((_INSET, 27, right, 69), tile.value, 34)
    page.write((_INSET, 71, right, height - 4), tile.detail, 19)
    return page.shades()


@lru_cache(maxsize=16)
def _fact(title: str, text: str, width: int, height: int) -> Shades:
    page = _Page(width, height)
    page.line((_INSET, 2, width - _INSET, 17), title, 13)
    page.write((_INSET, 18, width - _INSET, height - 3), text, 18)
    return page.shades()


class _Page:
    def __init__(self, width: int, height: int) -> None:
        self._image = Image.new("L", (width, height))
        self._pen = ImageDraw.Draw(self._image)

    def shades(self) -> Shades:
        """(rows, columns) from 0 for the ground to `_SHADES` - 1 for ink."""
        return np.asarray(self._image) // (256 // _SHADES)

    def line(self, box: Box, text: str, largest: int) -> int:
        """One line in the middle of its height, smaller where it does not fit; its width."""
        x0, y0, x1, y1 = box
        sizes = range(largest, _SMALLEST, -1)
        size = next((size for size in sizes if _width(text, size) <= x1 - x0), _SMALLEST)
        self._pen.text((x0, (y0 + y1) / 2), text, fill=255, font=_font(size), anchor="lm")
        return ceil(_width(text, size))

    def write(self, box: Box, text: str, largest: int) -> None:
        """Words in lines from the top, as large as all of them fit."""
        x0, y0, x1, y1 = box
        for size in range(largest, _SMALLEST - 1, -1):
            lines, pitch = _wrapped(text, size, x1 - x0), size * _PITCH
            if len(lines) * pitch <= y1 - y0 and all(_width(line, size) <= x1 - x0 for line in lines):
                break
        spare = (y1 - y0 - len(lines) * pitch) / 2 if y1 - y0 < _BAND else 0
        for number, line in enumerate(lines):
            self._pen.text((x0, y0 + spare + number * pitch), line, fill=255, font=_font(size), anchor="la")


def _wrapped(text: str, size: int, width: int) -> list[str]:
    """Lines of words; a word longer than a line is broken."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if _width(longer, size) <= width:
            lines[-1] = longer
            continue
        pieces, rest = [], word
        while rest:
            fits = next((count for count in range(len(rest), 1, -1) if _width(rest[:count], size) <= width), 1)
            pieces.append(rest[:fits])
            rest = rest[fits:]
        lines = [*filter(None, lines), *pieces]
    return lines


def _width(text: str, size: int) -> float:
    """Of a line of text, a little too much."""
    words = text.split(" ")
    return (sum(map(_measured, words)) + (len(words) - 1) * _measured(" ")) * size * 1.02


@lru_cache(maxsize=1024)
def _measured(word: str) -> float:
    """Width per size: measuring costs more than drawing."""
    return float(_font(64).getlength(word)) / 64


@lru_cache
def _palette() -> list[int]:
    """Red, green, blue, one after the other, of every shade of every level, and of the ground."""
    shares = np.linspace(0, 1, _SHADES)[:, None]
    colours = [np.array(FILL[level]) * (1 - shares) + np.array(INK[level]) * shares for level in Level]
    return [round(value) for value in (*np.concatenate(colours).ravel().tolist(), *GROUND)]


@lru_cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
