"""The channels of one mirror, as CACAO names them: dm00disp00 to dm00disp11, and dm00disp, which is their sum."""

import re
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lowfc.adapters.image_stream.stream import Stream, StreamAbsentError, StreamError, stream_path
from lowfc.arrays import Single

CHANNELS = 12
_LOOK_S = 1.0
"""Between two looks for channels that came, went or were made anew."""
_ATTEMPTS = 3


def sum_name(channel: str) -> str:
    """Name of the sum that a channel is part of; empty where its name does not say."""
    found = re.fullmatch(r"(dm\d\ddisp)\d\d", channel)
    return found[1] if found else ""


def channel_names(channel: str) -> tuple[str, ...]:
    """Names of the other channels of the same mirror."""
    total = sum_name(channel)
    return tuple(one for one in (f"{total}{index:02d}" for index in range(CHANNELS)) if total and one != channel)


class OtherChannels:
    """What others have on the mirror beside one channel: the sum of theirs, in their unit.

    A channel that cannot be used is left out: another grid, another layout, a value that is not finite.
    """

    def __init__(self, names: Iterable[str], grid: tuple[int, int]) -> None:
        """Read these channels, those that there are and those that come, of (rows, columns) actuators."""
        self._paths = [stream_path(name) for name in names]
        self._grid = grid
        self._streams: dict[Path, Stream] = {}
        self._looked_s = -_LOOK_S
        self._counts: dict[Path, tuple[tuple[int, int, int], int]] = {}
        self._sum: Single = np.zeros(grid, np.float32)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels that there are."""
        return tuple(stream.name for stream in self._streams.values())

    def sum(self) -> Single:
        """Their sum (rows, columns); the very same array until one of them is written."""
        now_s = time.monotonic()
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            self._streams = {path: stream for path, stream in self._streams.items() if stream.current()}
            for path in self._paths:
                if path not in self._streams and (stream := opened(path, self._grid)) is not None:
                    self._streams[path] = stream
        counts = {path: (stream.identity, stream.count) for path, stream in self._streams.items()}
        if counts != self._counts:
            shapes = [shape for stream in self._streams.values() if (shape := whole(stream)) is not None]
            self._counts, self._sum = counts, np.sum([np.zeros(self._grid, np.float32), *shapes], axis=0)
        return self._sum


def opened(path: Path, grid: tuple[int, int]) -> Stream | None:
    """A stream of a mirror's shapes; None where there is none that can be used."""
    try:
        stream = Stream(path)
    except StreamError:
        return None
    return stream if fits(stream, grid) else None


def fits(stream: Stream, grid: tuple[int, int]) -> bool:
    """Whether it holds shapes (rows, columns) of a mirror in float32."""
    return stream.layout.dtype == np.float32 and stream.layout.shape == (1, *grid)


def whole(stream: Stream) -> Single | None:
    """The shape in a stream, a copy; None while it is written, or where it is not finite."""
    for _ in range(_ATTEMPTS):
        count, shape = stream.count, stream.data[0].astype(np.float32)
        if stream.count == count and not stream.writing:
            return shape if np.isfinite(shape).all() else None
    return None


def channel_of(name: str, grid: tuple[int, int]) -> Stream:
    """A channel to be written: the one that there is, or a new one, at zero.

    StreamError where it is not of this grid, or another process writes it.
    """
    path = stream_path(name)
    try:
        stream = Stream(path)
    except StreamAbsentError:
        stream = Stream.create(path, grid, np.float32)
    if not fits(stream, grid):
        planes, rows, columns = stream.layout.shape
        depth = f" x {planes}" if planes > 1 else ""
        raise StreamError(
            f"stream {name!r} has {columns} x {rows}{depth} pixels of {stream.layout.dtype}, expected {grid[1]} x "
            f"{grid[0]} of float32, for [mirror] has {grid[0]} rows and {grid[1]} columns"
        )
    if pid := stream.other_writer():
        raise StreamError(f"process {pid} writes stream {name!r}: stop it first, or choose a channel of your own")
    return stream
