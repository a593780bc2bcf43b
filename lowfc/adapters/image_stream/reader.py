"""The images of a stream one after the other, whatever its writer does to it."""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.adapters.image_stream.stream import Stream, StreamAbsentError, alive

_TURN_S = 0.1
_ABSENT_TURN_S = 0.005
_ATTEMPTS = 3


class StreamImage(NamedTuple):
    """A copy of an image (rows, columns) as it was read; its number in its stream, and its stream's, from one on.

    Its writer says that it was acquired at `acquired_ns`, nanoseconds since the epoch.
    """

    pixels: npt.NDArray[np.generic]
    number: int
    acquired_ns: int
    generation: int


class StreamReader:
    """Waits for images by a semaphore of its own, and follows a stream that is made anew.

    `stream` is the one that is mapped, None while there is none; `generation` counts them, from one.
    """

    def __init__(self, path: Path) -> None:
        """Read the stream at `path`, now or once it is there; what it holds already is nobody's new image.

        StreamError where it has another layout, or no free semaphore.
        """
        self.stream: Stream | None = None
        self.generation = 0
        self._path = path
        self._seen = self._semaphore = 0
        self._open()

    def next(self, timeout_s: float) -> StreamImage | None:
        """The newest image that was not yet returned; None where none came in time, StreamError as at the start."""
        end_s = time.monotonic() + timeout_s
        there = self._open()
        while True:
            if there and (image := self._image()) is not None:
                return image
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return None
            if self.stream is None:
                time.sleep(min(left_s, _ABSENT_TURN_S))
            elif self.stream.semaphores.wait(self._semaphore, min(left_s, _TURN_S)):
                continue  # its writer has just posted: it is there still
            there = self._open()

    def silence(self) -> str:
        """Why no image comes, as far as the stream shows it."""
        stream = self.stream
        if stream is None or not stream.current():
            return f"there is no stream {self._path.name.removesuffix('.im.shm')!r}"
        writer = int(stream.writers[self._semaphore])
        died = (
            f"its writer (process {writer}) has ended" if writer > 0 and not alive(writer) else "its writer is silent"
        )
        return f"{died}, in the middle of an image" if stream.writing else died

    def close(self) -> None:
        """Give the semaphore back."""
        if self.stream is not None and self.stream.current():
            self.stream.give_back(self._semaphore)
        self.stream = None

    def _open(self) -> bool:
        """Whether the stream of that name is mapped: the one that there is now."""
        if self.stream is not None and self.stream.current():
            return True
        self.stream = None
        try:
            stream = Stream(self._path)
        except StreamAbsentError:
            return False
        self._semaphore = stream.take_semaphore()
        self._seen = 0 if self.generation else stream.count
        self.generation += 1
        self.stream = stream
        return True

    def _image(self) -> StreamImage | None:
        """The newest image, if it is whole and new; one that is being written posts the semaphore when it is."""
        stream = self.stream
        assert stream is not None  # noqa: S101
        for _ in range(_ATTEMPTS):
            newest = stream.newest
            if newest.number == self._seen or newest.writing:
                return None
            pixels = stream.data[newest.plane % stream.layout.shape[0]].copy()
            if stream.newest == newest:
                self._seen = newest.number
                return StreamImage(pixels, newest.number, newest.acquired_ns, self.generation)
        return None
