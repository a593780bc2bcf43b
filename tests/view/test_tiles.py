"""The verdict as a picture."""

import io

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from lowfc.control.loop.safety import LoopMode
from lowfc.programs.view.panels.tiles import FILL, GROUND, HEIGHT, TILES, WIDTH, Tiles, picture, places, png
from lowfc.programs.view.verdicts.tile import Level, Tile, Verdict
from tests.support.stage import MAS, Stage
from tests.support.tape import Tape

NOON_NS = 43_200 * 10**9
LONG = "neighbouring/actuators/in/a/very/long/path/without/any/blank " + "and more words than a tile has room for " * 3


def pixels(verdict: Verdict, time_ns: int = NOON_NS) -> npt.NDArray[np.uint8]:
    with Image.open(io.BytesIO(png(picture(verdict, time_ns)))) as shown:
        return np.asarray(shown.convert("RGB"))


def seven(tile: Tile, level: Level = Level.GOOD) -> Verdict:
    return Verdict(LONG, level, (tile,) * 7)


@pytest.mark.parametrize("tiles", [7, 8])
@pytest.mark.parametrize("level", Level)
def test_all_words_are_within_their_tile_and_nothing_is_on_its_border(level: Level, tiles: int) -> None:
    verdict = Verdict(LONG, level, tuple(Tile("RECORDER", "NOTHING HEARD OF IT", LONG, level) for _ in range(tiles)))
    shown = pixels(verdict)
    assert shown.shape == (HEIGHT, WIDTH, 3)
    rest = np.ones((HEIGHT, WIDTH), bool)
    for x0, y0, x1, y1 in places(tiles):
        inside = shown[y0:y1, x0:x1]
        border = np.ones(inside.shape[:2], bool)
        border[2:-2, 2:-2] = False
        assert (inside[border] == FILL[level]).all()
        assert (inside != FILL[level]).any(axis=2).mean() > 0.03  # there are words
        rest[y0:y1, x0:x1] = False
    assert (shown[rest] == GROUND).all()


def test_longer_words_are_smaller_words_not_fewer() -> None:
    """A letter more changes the picture, at the end of a text too."""
    shorter, longer = (pixels(seven(Tile("A", "B", LONG + end, Level.BAD))) for end in ("a", "ab"))
    assert (shorter != longer).any()


def test_the_time_of_day_is_at_the_right_end_of_the_headline_and_nowhere_else() -> None:
    verdict = seven(Tile("A", "B", LONG, Level.GOOD))
    noon, next_second, next_day = (pixels(verdict, NOON_NS + 10**9 * later) for later in (0, 1, 86_400))
    differs = np.argwhere((noon != next_second).any(axis=2))
    (top, left), (bottom, right) = differs.min(axis=0), differs.max(axis=0)
    assert 0 < top < bottom < places(7)[0][3]
    assert WIDTH - 190 < left < right < WIDTH
    assert (noon == next_day).all()


def test_levels_differ_in_lightness_too() -> None:
    light = sorted(float(np.dot(FILL[level], (0.2126, 0.7152, 0.0722))) for level in Level)
    assert min(np.diff(light)) > 8
    assert len({picture(Verdict("", level, ()), NOON_NS).tobytes() for level in Level}) == len(Level)


def test_the_clock_is_drawn_each_second_and_more_only_when_something_changes() -> None:
    tape, panel, stage = Tape(), Tiles(MAS), Stage()
    stage.each = lambda snapshot: panel.draw(tape, snapshot)
    stage.begin()
    stage.run(3)
    assert 1 <= len(tape.logged[TILES]) <= 4 * 3
    tape.logged.clear()
    stage.run(3)
    assert len(tape.logged[TILES]) == 3
    stage.mode = LoopMode.SAFE
    stage.run(0.5)
    assert len(tape.logged[TILES]) > 3
