"""Frames and steps of a running loop, one after the other; lost ones are counted."""

import time
from collections import deque
from collections.abc import Callable
from math import inf
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Ring, Sample
from lowfc.contract.codecs import codec
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import BadMessageError, BusError
from lowfc.contract.messages import from_timestamp, wire
from lowfc.contract.sequence_gaps import Gaps
from lowfc.control.loop.inputs import Step
from lowfc.control.loop.safety import LoopMode, reason_of

T = TypeVar("T")

BUFFERED_MESSAGES = 1024
"""Messages that a stream buffers: one second of a 1 kHz loop."""
DEFAULT_TIMEOUT_S = 5.0
"""Default timeout for the next message."""
_POLL_S = 0.002


class Frame(NamedTuple):
    """A sensor image: `pixels` (rows, columns) uint16, DN; its time is the end of the exposure."""

    sequence: int
    time_ns: int
    pixels: npt.NDArray[np.uint16]

    @property
    def number(self) -> int:
        """Number of the frame since its camera started, as in `lowfc ctl` and the views."""
        return count_of(self.sequence)


class Stream(Generic[T]):
    """Messages of one topic as they arrive; construction returns once the first one has arrived."""

    def __init__(
        self, ring: Ring, decode: Callable[[Sample], T | None], what: str, count: int | None, patience_s: float
    ) -> None:
        """Wait for the first message in `ring`; BusError if none arrives. The stream ends after `count` messages.

        `decode` returns None for an invalid message; `what` names the messages in errors; `patience_s` is the timeout.
        """
        self._ring = ring
        self._decode = decode
        self._what = what
        self._remaining = inf if count is None else count
        self._patience_s = patience_s
        self._gaps: dict[int, Gaps] = {}
        self._damaged = 0
        self._waiting: deque[Sample] = deque()
        self._fill(time.monotonic() + patience_s)

    @property
    def lost(self) -> int:
        """Number of damaged or lost messages since the first one; a reader that is too slow loses messages."""
        return self._damaged + sum(gaps.missing for gaps in self._gaps.values())

    def __iter__(self) -> "Stream[T]":
        return self

    def __next__(self) -> T:
        """The next message; BusError if no valid one arrives in time."""
        deadline_s = time.monotonic() + self._patience_s
        while self._remaining > 0:
            self._fill(deadline_s)
            sample = self._waiting.popleft()
            count = count_of(sample.sequence)
            self._gaps.setdefault(start_of(sample.sequence), Gaps(count)).add(count)
            message = self._decode(sample)
            if message is not None:
                self._remaining -= 1
                return message
            self._damaged += 1
            self._expire(deadline_s)
        self.close()
        raise StopIteration

    def close(self) -> None:
        """Stop receiving."""
        self._remaining = 0
        self._ring.close()
        self._waiting.clear()

    def _fill(self, deadline_s: float) -> None:
        while not self._waiting:
            self._waiting.extend(self._ring.drain())
            if not self._waiting:
                self._expire(deadline_s)
                time.sleep(_POLL_S)

    def _expire(self, deadline_s: float) -> None:
        if time.monotonic() >= deadline_s:
            self.close()
            unread = f" ({self._damaged} could not be read)" if self._damaged else ""
            why = f"no {self._what} came within {self._patience_s:g} s{unread}"
            raise BusError(f"{why}: `lowfc ctl status` shows why")


def frame_of(sample: Sample) -> Frame | None:
    """Decode a frame; None if it is not valid, or holds no complete image."""
    try:
        frame = codec.decode_frame(sample.payload, sample.sequence, 0)
    except BadMessageError:
        return None
    return None if frame.pixels is None else Frame(frame.sequence, frame.time_ns, frame.pixels)


def step_of(sample: Sample) -> Step | None:
    """Decode a step; None if it is not valid."""
    try:
        message = wire.ControlStep.FromString(sample.payload)
        return Step(
            message.frame_sequence,
            from_timestamp(message.timestamp),
            LoopMode(message.mode),
            np.array(message.command_nm, np.float32),
            tuple(reason_of(reason) for reason in message.reasons),
            np.array(message.error_nm, np.float32) if message.error_nm else None,
            np.array(message.pol_nm, np.float32) if message.pol_nm else None,
            message.flux_dn,
            message.saturated_pixels,
        )
    except (DecodeError, ValueError):
        return None
