"""Reads the newest image of a stream; tolerates restarts, crashes and rewrites by its writer."""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.adapters.image_stream.stream import Stream, StreamAbsentError, StreamError, alive

_CHECK_S = 0.1  # period of checks whether the stream was recreated
_ABSENT_CHECK_S = 0.005  # the same while there is no stream
_ATTEMPTS = 3


class StreamImage(NamedTuple):
    """Copy of an image (rows, columns), its number in the stream, and the `generation` of that stream, both from 1.

    `acquired_ns` is the acquisition time that its writer stated, ns since the epoch.
    """

    pixels: npt.NDArray[np.generic]
    number: int
    acquired_ns: int
    generation: int


class StreamReader:
    """Waits for images on its own semaphore, and reopens a recreated stream.

    `stream` is the mapped stream, None while there is none; `generation` counts the streams mapped so far.
    """

    def __init__(self, path: Path) -> None:
        """Open the stream at `path`, which may be created later; its present image does not count as new.

        StreamError if its layout is not supported, or no semaphore is free.
        """
        self.stream: Stream | None = None
        self.generation = 0
        self._path, self._fault = path, ""
        self._last_number = self._semaphore = 0
        self._open()

    def next(self, timeout_s: float) -> StreamImage | None:
        """Newest image, waited for if none is new; None after the timeout. StreamError as for the constructor."""
        end_s = time.monotonic() + timeout_s
        mapped = self._open()
        while True:
            if mapped and (image := self._image()) is not None:
                return image
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return None
            if self.stream is None:
                time.sleep(min(left_s, _ABSENT_CHECK_S))
            elif self.stream.semaphores.wait(self._semaphore, min(left_s, _CHECK_S)):
                continue  # just posted by its writer: the stream still exists
            mapped = self._open()

    def silence_cause(self) -> str:
        """Reason why no image comes, as far as the stream shows it."""
        stream = self.stream
        if stream is None or not stream.current():
            return f"there is no stream {self._path.name.removesuffix('.im.shm')!r}"
        writer = int(stream.writers[self._semaphore])
        ended = writer > 0 and not alive(writer)
        cause = f"its writer (process {writer}) has ended" if ended else "its writer is silent"
        return f"{cause}, in the middle of an image" if stream.writing else cause

    def close(self) -> None:
        """Release the semaphore."""
        if self.stream is not None and self.stream.current():
            self.stream.release_semaphore(self._semaphore)
        self.stream = None

    def _open(self) -> bool:
        """Map the stream at the path unless the mapped one is current; return whether one is mapped."""
        if self.stream is not None and self.stream.current():
            return True
        self.stream = None
        try:
            stream = Stream(self._path)
        except StreamAbsentError:
            return False
        except StreamError as fault:  # a library may write the version field before the rest: try once more
            if not self.generation or str(fault) == self._fault:
                raise
            self._fault = str(fault)
            return False
        self._fault = ""
        self._semaphore = stream.take_semaphore()
        self._last_number = 0 if self.generation else stream.count
        self.generation += 1
        self.stream = stream
        return True

    def _image(self) -> StreamImage | None:
        """Newest image; None unless it is complete and new. Its writer posts the semaphore once it is complete."""
        stream = self.stream
        assert stream is not None  # noqa: S101
        for _ in range(_ATTEMPTS):
            newest = stream.newest
            if newest.number == self._last_number or newest.writing:
                return None
            pixels = stream.data[newest.plane % stream.layout.shape[0]].copy()
            if stream.newest == newest:
                self._last_number = newest.number
                return StreamImage(pixels, newest.number, newest.acquired_ns, self.generation)
        return None
