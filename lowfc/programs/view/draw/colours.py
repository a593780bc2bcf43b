"""Colours of images and lines: few, safe for colour blindness, on the viewer's dark background."""

import numpy as np
import numpy.typing as npt

Rgb = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

_LEVELS = 256
_BLACK, _DARK = (6, 6, 12), (26, 27, 32)

# Okabe and Ito's palette without black, because the background is dark.
_OKABE_ITO: tuple[Colour, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (240, 228, 66),
    (204, 121, 167),
    (213, 94, 0),
    (0, 114, 178),
)
BLUE, ORANGE, GREEN, YELLOW, PINK, RED, _ = _OKABE_ITO
GREY: Colour = (150, 152, 160)
WHITE: Colour = (235, 235, 240)


def _table(*anchors: Colour) -> Rgb:
    positions = np.linspace(0, 1, len(anchors))
    levels = np.linspace(0, 1, _LEVELS)
    return np.stack([np.interp(levels, positions, channel) for channel in zip(*anchors, strict=True)], axis=1).astype(
        np.uint8
    )


_SEQUENTIAL = _table(_BLACK, (45, 17, 92), (133, 33, 107), (213, 72, 66), (250, 151, 46), (252, 246, 190))
_DIVERGING = _table(
    (190, 232, 255), (64, 160, 236), (22, 74, 140), _DARK, (140, 62, 8), (240, 138, 30), (255, 226, 170)
)


def sequential(values: npt.NDArray[np.floating]) -> Rgb:
    """Colours (..., 3) of values from 0 (black) to 1 (nearly white); brightness increases with the value."""
    return _colours_of(_SEQUENTIAL, values)


def diverging(values: npt.NDArray[np.floating]) -> Rgb:
    """Colours (..., 3) of values from -1 (light blue) through 0 (dark) to 1 (light orange)."""
    return _colours_of(_DIVERGING, 0.5 + 0.5 * values)


def distinct(count: int) -> list[Colour]:
    """Colours for `count` lines in one plot: seven, then their lighter and darker shades, then again."""
    return [_shaded(_OKABE_ITO[number % 7], number // 7) for number in range(count)]


def _shaded(colour: Colour, cycle: int) -> Colour:
    towards, share = (0, 0.0) if cycle == 0 else (255, 0.45) if cycle % 2 else (0, 0.35)
    red, green, blue = (round((1 - share) * one + share * towards) for one in colour)
    return red, green, blue


def _colours_of(table: Rgb, values: npt.NDArray[np.floating]) -> Rgb:
    levels = np.clip(values * (_LEVELS - 1) + 0.5, 0, _LEVELS - 1).astype(np.uint8)
    return np.asarray(np.take(table, levels, axis=0))  # four times as fast as table[levels]
