"""A seeded camera fault: the data published in place of each frame, as a function of the frame index."""

from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Frame = npt.NDArray[np.uint16]

MAX_FRAMES_LATE = 50  # largest delay of a late frame, in frames
LOST_SHARE = 0.1  # probability that a frame is lost
HOT_SHARE = 0.1  # probability that a pixel is hot, drawn anew for each frame
COSMIC_SHARE = 0.2  # probability of a cosmic-ray track in a frame
TRACK_PIXELS = 6
"""Length of a cosmic-ray track, pixels: at most `max_saturated_pixels` by default, so that the frame is used."""


class Kind(StrEnum):
    """Faults of frames."""

    LOST = "lost"
    DUPLICATED = "duplicated"
    REORDERED = "reordered"
    LATE = "late"
    WRONG_SIZE = "wrong-size"
    TRUNCATED = "truncated"
    RANDOM = "random"
    OLD_SEQUENCE = "old-sequence"
    SATURATED = "saturated"
    DARK = "dark"
    HOT_PIXELS = "hot-pixels"
    COSMIC_RAYS = "cosmic-rays"
    STUCK = "stuck"


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of this kind in `frames` frames from index `first` on; the first frame of a camera is always good."""

    kind: Kind
    first: int
    frames: int
    seed: int = 0

    def __post_init__(self) -> None:
        if self.first < 1 or self.frames < 1:
            raise ValueError(
                f"a fault needs a first frame and a number of frames of 1 or more, got {self.first} and {self.frames}"
            )
        if not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f"a fault's seed is a whole number of 0 or more, got {self.seed!r}")

    def kind_at(self, index: int) -> Kind | None:
        """Kind of the fault in the frame with this index; None if it is good."""
        return self.kind if self.first <= index < self.first + self.frames else None

    def random(self, index: int) -> np.random.Generator:
        """Random generator of this frame."""
        return np.random.default_rng([self.seed, index])

    def frames_due(self, index: int) -> tuple[int, ...]:
        """Indices of the frames that are published at the end of exposure `index`, the newest first."""
        return tuple(
            frame
            for frame in range(index, max(index - MAX_FRAMES_LATE, 0) - 1, -1)
            for exposure in _exposures(self, frame)
            if exposure == index
        )

    def pixels(self, index: int, frame: Frame, before: Frame, dark: int, highest: int) -> Frame:
        """Detector output (rows, columns) in place of a frame.

        Args:
            index: index of the frame.
            frame: the frame without a fault.
            before: the detector's output, with its fault, for the frame before.
            dark: value without light, DN.
            highest: value of a pixel at full well, DN.
        """
        rng = self.random(index)
        match self.kind_at(index):
            case Kind.SATURATED:
                return np.full_like(frame, highest)
            case Kind.DARK:
                return rng.integers(max(dark - 2, 0), dark + 3, frame.shape).astype(np.uint16)
            case Kind.HOT_PIXELS:
                return np.where(rng.random(frame.shape) < HOT_SHARE, np.uint16(highest), frame)
            case Kind.COSMIC_RAYS if rng.random() < COSMIC_SHARE:
                return _with_track(frame, rng, highest)
            case Kind.STUCK:
                return before
            case Kind.WRONG_SIZE:  # as from a camera with another readout region
                return np.ascontiguousarray(frame[1:, :-1])
        return frame

    def payload(self, index: int, message: bytes, image_end: int) -> bytes:
        """The bytes published in place of a frame's message, whose image ends at byte `image_end`."""
        rng = self.random(index)
        match self.kind_at(index):
            case Kind.TRUNCATED:
                return message[: int(rng.integers(0, image_end))]
            case Kind.RANDOM:
                return rng.bytes(int(rng.integers(1, 2 * len(message))))
        return message


@lru_cache(maxsize=2 * MAX_FRAMES_LATE)  # called at each exposure for all frames that may still be due
def _exposures(fault: Fault, frame: int) -> tuple[int, ...]:
    """Indices of the exposures at whose end a frame is published."""
    match fault.kind_at(frame):
        case Kind.LOST if fault.random(frame).random() < LOST_SHARE:
            return ()
        case Kind.DUPLICATED:
            return frame, frame
        case Kind.REORDERED:  # in pairs, the second one first
            return (frame + 1 - (frame - fault.first) % 2,)
        case Kind.LATE:
            return (frame + int(fault.random(frame).integers(1, MAX_FRAMES_LATE + 1)),)
    return (frame,)


def _with_track(frame: Frame, rng: np.random.Generator, highest: int) -> Frame:
    """The frame with a straight track of pixels at full well."""
    start, angle = rng.uniform(0, frame.shape), rng.uniform(0, 2 * np.pi)
    along = start + np.arange(TRACK_PIXELS)[:, None] * (np.cos(angle), np.sin(angle))
    rows, columns = along.astype(int).T
    inside = (rows >= 0) & (rows < frame.shape[0]) & (columns >= 0) & (columns < frame.shape[1])
    with_track = frame.copy()
    with_track[rows[inside], columns[inside]] = highest
    return with_track
