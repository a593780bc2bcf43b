"""Progress of a calibration, counted in the frames that it receives."""

from collections.abc import Callable, Iterator

from lowfc.adapters.progress import Counted
from lowfc.programs.calibrate.recording import Image, Loop

Say = Callable[[str], None]

_EVERY = 20
"""Frames between two reports."""


class FrameCount:
    """Frames received so far, in however many plays."""

    def __init__(self, progress: Counted) -> None:
        """Report to `progress`."""
        self._progress = progress
        self._done = 0

    def of(self, loop: Loop, doing: str, left: int) -> Loop:
        """The loop for one play, its frames counted.

        Args:
            loop: To play on.
            doing: For people.
            left: Frames until the end of the calibration, those of this play included.
        """
        total = self._done + left
        self._progress(doing, self._done, total)

        def count() -> None:
            self._done += 1
            if self._done % _EVERY == 0:
                self._progress(doing, min(self._done, total), total)

        return _Counted(loop, count)


class _Counted:
    """A loop that says when a frame has come."""

    def __init__(self, loop: Loop, count: Callable[[], None]) -> None:
        self._loop, self._count = loop, count
        self.play, self.stop, self.steps, self.mirror_watch = loop.play, loop.stop, loop.steps, loop.mirror_watch
        self.check_lease = loop.check_lease

    def frames(self, count: int | None = None) -> Iterator[Image]:
        """See `Loop.frames`."""
        return self._each(self._loop.frames(count))

    def _each(self, images: Iterator[Image]) -> Iterator[Image]:
        try:
            for image in images:
                self._count()
                yield image
        finally:
            close = getattr(images, "close", None)
            if close is not None:
                close()
