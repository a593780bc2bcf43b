"""Channels of a mirror with CACAO's names: dm00disp00 to dm00disp11, and their sum dm00disp."""

import re
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lowfc.adapters.image_stream.stream import Stream, StreamAbsentError, StreamError, stream_path
from lowfc.arrays import Single

CHANNELS = 12
_SEARCH_S = 1.0
"""Period of the search for channels that appeared."""
_ATTEMPTS = 3
_CREATION_S = 0.02
"""Time for which an unfinished stream is waited for: another program may be creating it."""
_POLL_S = 0.001


def sum_name(channel: str) -> str:
    """Name of the sum that contains a channel; empty if the channel's name is not CACAO's."""
    match = re.fullmatch(r"(dm\d\ddisp)\d\d", channel)
    return match[1] if match else ""


def other_channel_names(channel: str) -> tuple[str, ...]:
    """Names of the other channels of the same mirror; empty if the channel's name is not CACAO's."""
    total = sum_name(channel)
    return tuple(name for name in (f"{total}{index:02d}" for index in range(CHANNELS)) if total and name != channel)


class OtherChannels:
    """Sum of a mirror's channels except one, in the unit of the streams.

    Unusable channels are left out: those with another grid or layout, or a value that is not finite. While a channel is
    being written, or if its writer died meanwhile, its last complete shape counts; if there was none yet, the
    incomplete one.
    """

    def __init__(self, names: Iterable[str], grid: tuple[int, int]) -> None:
        """Read the channels `names`, each with `grid` (rows, columns) actuators, also those that appear later."""
        self._paths = [stream_path(name) for name in names]
        self._grid = grid
        self._streams: dict[Path, Stream] = {}
        self._searched_s = -_SEARCH_S
        self._counts: dict[Stream, tuple[int, bool]] = {}
        self._shapes: dict[Stream, Single | None] = {}
        self._sum: Single = np.zeros(grid, np.float32)
        self._misfits: list[str] = []

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the existing channels."""
        return tuple(stream.name for stream in self._streams.values())

    @property
    def unusable(self) -> list[str]:
        """A text for each existing channel that is left out, with the reason."""
        not_finite = [stream.name for stream, shape in self._shapes.items() if shape is None]
        return self._misfits + [f"stream {name!r} has values that are not finite" for name in not_finite]

    def sum(self) -> Single:
        """Sum of the channels (rows, columns); the same array object until a channel is written, appears or ends."""
        now_s = time.monotonic()
        current = {path: stream for path, stream in self._streams.items() if stream.current()}
        if len(current) < len(self._streams) or now_s - self._searched_s >= _SEARCH_S:
            self._searched_s, self._misfits = now_s, []
            for path in self._paths:
                try:
                    if path not in current:
                        current[path] = opened(path, self._grid)
                except StreamAbsentError:
                    continue
                except StreamError as fault:
                    self._misfits.append(str(fault))
        self._streams = current
        counts = {stream: (stream.count, stream.writing) for stream in self._streams.values()}
        if counts != self._counts:
            self._shapes = {
                stream: complete_shape(stream, self._shapes.get(stream, stream.data[0].astype(np.float32)))
                for stream in self._streams.values()
            }
            shapes = [shape for shape in self._shapes.values() if shape is not None]
            self._counts, self._sum = counts, np.sum([np.zeros(self._grid, np.float32), *shapes], axis=0)
        return self._sum


def opened(path: Path, grid: tuple[int, int]) -> Stream:
    """Open a stream of shapes of this grid (rows, columns); StreamError if there is none, or it has another layout."""
    stream = Stream(path)
    if not fits(stream, grid):
        planes, rows, columns = stream.layout.shape
        depth = f" x {planes}" if planes > 1 else ""
        raise StreamError(
            f"stream {stream.name!r} has {columns} x {rows}{depth} pixels of {stream.layout.dtype}, expected {grid[1]} "
            f"x {grid[0]} of float32, as [mirror] has {grid[0]} rows and {grid[1]} columns"
        )
    return stream


def fits(stream: Stream, grid: tuple[int, int]) -> bool:
    """Whether a stream holds float32 shapes of this grid (rows, columns)."""
    return stream.layout.dtype == np.float32 and stream.layout.shape == (1, *grid)


def complete_shape(stream: Stream, otherwise: Single | None = None) -> Single | None:
    """Copy the shape in a stream; None if it is not finite.

    While the stream is being written, or if its writer died meanwhile, `otherwise` is the result (None if not finite).
    """
    for _ in range(_ATTEMPTS):
        count, shape = stream.count, stream.data[0].astype(np.float32)
        if stream.count == count and not stream.writing:
            break
    else:
        shape = otherwise
    return shape if shape is not None and np.isfinite(shape).all() else None


def open_channel(name: str, grid: tuple[int, int]) -> Stream:
    """Open a channel for writing; create it with zeros if it does not exist.

    StreamError if it has another grid, another process writes it, or another program does not finish creating it.
    """
    stream = _opened_or_created(stream_path(name), grid)
    if pid := stream.other_writer():
        raise StreamError(f"process {pid} writes stream {name!r}: stop it first, or choose a channel of your own")
    return stream


def _opened_or_created(path: Path, grid: tuple[int, int]) -> Stream:
    end_s = time.monotonic() + _CREATION_S
    while path.exists():
        try:
            return opened(path, grid)
        except StreamAbsentError as fault:
            if time.monotonic() > end_s:
                raise StreamError(f"{fault}; if no program is creating it, delete {path}") from None
        time.sleep(_POLL_S)
    return Stream.create(path, grid, np.float32)
