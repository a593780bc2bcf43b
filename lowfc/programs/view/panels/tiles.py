"""Annunciator panel: the verdict as a picture, with a headline above large coloured tiles."""

import io
import re
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import rerun as rr
from PIL import Image, ImageDraw, ImageFont

from lowfc.programs.view.draw.colours import Colour
from lowfc.programs.view.draw.plots import at
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.log_verdict import LogVerdict
from lowfc.programs.view.verdicts.tile import FILL, INK, WORD, Level, Tile, Verdict, clock
from lowfc.programs.view.verdicts.verdict import judge
from lowfc.programs.view.verdicts.watcher import Watcher

TILES = "status/tiles"
WIDTH, HEIGHT = 1760, 256  # px
GROUND: Colour = (13, 16, 17)
"""Rerun's background, so that only the tiles are visible."""
MIN_PERIOD_NS = 250_000_000
"""Shortest time between two pictures that differ in a word or colour. If only numbers differ, there is one picture per
second: more cannot be read, and each stays in the viewer's memory."""

_GAP, _INSET, _BAND, _CLOCK = 6, 9, 46, 190  # gap of boxes, inset of text, height of headline, width of clock, px
_TILES_END = 196  # lower edge of the tiles, px
_FACTS = (3, 4, 4, 4)  # relative widths of the facts below the tiles
_MIN_FONT = 8  # px
_SHADES = 16  # number of shades of each level
_PITCH = 1.16  # distance from line to line, in font sizes

Box = tuple[int, int, int, int]
"""Left, top, right and bottom, px; left and top are inside the box, right and bottom just outside."""
Text = tuple[Box, str, int]
"""Box, text, and largest font size in px."""
Shades = npt.NDArray[np.uint8]


class Tiles(Panel):
    """Draws the verdict on the run once a second, and when its words change; at a log's end, the verdict on the log."""

    def __init__(self, nm_per_mas: float) -> None:
        """`nm_per_mas`: wavefront rms of a tilt of 1 mas."""
        self._nm_per_mas = nm_per_mas
        self._watcher = Watcher()
        self._log_verdict = LogVerdict()
        self._drawn: object = None
        self._judged_ns = 0

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Judge the run, and show the verdict if it or the clock has changed."""
        self._watcher.feed(snapshot)
        self._log_verdict.feed(snapshot)
        if snapshot.ended is not None:
            self._show(stream, snapshot.time_ns, self._log_verdict.verdict(self._watcher.state(), snapshot.ended))
        elif not 0 <= snapshot.host_ns - self._judged_ns < MIN_PERIOD_NS:
            self._judged_ns = snapshot.host_ns
            verdict = judge(self._watcher.state(), self._nm_per_mas)
            words = [(tile.title, tile.level, re.sub(r"[^a-zA-Z]", "", tile.value)) for tile in verdict.tiles]
            shown = words, snapshot.time_ns // 10**9
            if shown != self._drawn:
                self._drawn = shown
                self._show(stream, snapshot.time_ns, verdict)

    def _show(self, stream: rr.RecordingStream, time_ns: int, verdict: Verdict) -> None:
        at(stream, time_ns)
        stream.log(TILES, rr.EncodedImage(contents=png(picture(verdict, time_ns)), media_type="image/png"))


def picture(verdict: Verdict, time_ns: int) -> Image.Image:
    """The verdict and its time as a picture with a palette: for each level, shades from its fill to its ink."""
    colours = np.full((HEIGHT, WIDTH), _SHADES * len(Level), np.uint8)
    for (x0, y0, x1, y1), level, texts in _parts(verdict, time_ns):
        colours[y0:y1, x0:x1] = level * _SHADES + _shades(x1 - x0, y1 - y0, texts)
    image = Image.fromarray(colours).convert("P")
    image.putpalette(_palette())
    return image


def tile_boxes(tiles: int) -> list[Box]:
    """Boxes of the headline and of this number of tiles."""
    edges = [(WIDTH + _GAP) * number // tiles for number in range(tiles + 1)]
    return [(0, 0, WIDTH, _BAND), *((x0, _BAND + _GAP, x1 - _GAP, _TILES_END) for x0, x1 in pairwise(edges))]


def png(image: Image.Image) -> bytes:
    """Encode as PNG, at less than a tenth of the raw size: the viewer keeps every picture of a night."""
    content = io.BytesIO()
    image.save(content, "PNG", compress_level=1)
    return content.getvalue()


def _parts(verdict: Verdict, time_ns: int) -> Iterator[tuple[Box, Level, tuple[Text, ...]]]:
    """Coloured boxes with their levels and texts; the box of a text is relative to the corner of its coloured box."""
    headline, *boxes = tile_boxes(len(verdict.tiles))
    word, top, bottom = WORD[verdict.level].upper(), _INSET // 2, _BAND - _INSET // 2
    left = _INSET + round(_width(word, 30)) + (_INSET if word else 0)
    summary = ((left, top, WIDTH - _CLOCK - _INSET, bottom), verdict.headline, 27)
    yield headline, verdict.level, (((_INSET, top, left, bottom), word, 30), summary)
    clock_box = (WIDTH - _CLOCK, 0, WIDTH, _BAND)
    yield clock_box, verdict.level, (((_INSET, top, _CLOCK - _INSET, bottom), f"{clock(time_ns)} UTC", 27),)
    for box, tile in zip(boxes, verdict.tiles, strict=True):
        yield box, tile.level, _tile(tile, box[2] - box[0] - _INSET, box[3] - box[1])
    edges = [(WIDTH + _GAP) * sum(_FACTS[:number]) // sum(_FACTS) for number in range(len(_FACTS) + 1)]
    for (x0, x1), (title, text) in zip(pairwise(edges), verdict.facts.items(), strict=False):
        right = x1 - _GAP - x0 - _INSET
        texts = ((_INSET, 2, right, 17), title, 13), ((_INSET, 18, right, HEIGHT - _TILES_END - _GAP - 3), text, 18)
        yield (x0, _TILES_END + _GAP, x1 - _GAP, HEIGHT), Level.NEUTRAL, texts


def _tile(tile: Tile, right: int, height: int) -> tuple[Text, ...]:
    word = WORD[tile.level]
    middle = right - round(_width(word, 17))
    return (
        ((middle, 5, right, 25), word, 17),
        ((_INSET, 5, middle - _INSET, 25), tile.title, 17),
        ((_INSET, 27, right, 69), tile.value, 34),
        ((_INSET, 71, right, height - 4), tile.detail, 19),
    )


@lru_cache(maxsize=96)
def _shades(width: int, height: int, texts: tuple[Text, ...]) -> Shades:
    """Shades (rows, columns) from 0 for the fill to `_SHADES` - 1 for ink; cached, because few boxes change."""
    image = Image.new("L", (width, height))
    pen = ImageDraw.Draw(image)
    for box, text, largest in texts:
        _write(pen, box, text, largest)
    return np.asarray(image) // (256 // _SHADES)


def _write(pen: ImageDraw.ImageDraw, box: Box, text: str, largest: int) -> None:
    """Draw wrapped text in the largest size that fits: centred in a low box, from the top of a high one."""
    x0, y0, x1, y1 = box
    for size in range(largest, _MIN_FONT - 1, -1):
        lines, pitch = _wrapped(text, size, x1 - x0), size * _PITCH
        if len(lines) * pitch <= y1 - y0 and all(_width(line, size) <= x1 - x0 for line in lines):
            break
    spare = (y1 - y0 - len(lines) * pitch) / 2 if y1 - y0 < _BAND else 0
    for number, line in enumerate(lines):
        pen.text((x0, y0 + spare + number * pitch), line, fill=255, font=_font(size), anchor="la")


def _wrapped(text: str, size: int, width: int) -> list[str]:
    """Lines of text; very long words may be broken."""
    lines = [""]
    for word in re.findall(r"\S{1,24}\s*", text):
        if lines[-1] and _width(lines[-1] + word.rstrip(), size) > width:
            lines.append("")
        lines[-1] += word
    return [line.rstrip() for line in lines]


def _width(text: str, size: int) -> float:
    """Width of a line of text, px, slightly overestimated."""
    return sum(map(_advance, text)) * size * 1.02


@lru_cache(maxsize=1024)
def _advance(letter: str) -> float:
    """Width of a letter divided by the font size; cached, because measuring is slower than drawing."""
    return float(_font(64).getlength(letter)) / 64


@lru_cache
def _palette() -> list[int]:
    """Red, green and blue of every shade of every level and of the background, in one list."""
    shares = np.linspace(0, 1, _SHADES)[:, None]
    colours = [np.array(FILL[level]) * (1 - shares) + np.array(INK[level]) * shares for level in Level]
    return [round(value) for value in (*np.concatenate(colours).ravel().tolist(), *GROUND)]


@lru_cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
