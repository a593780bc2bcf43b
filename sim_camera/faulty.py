"""A publisher of frames that injects a fault, to test the reaction of other processes."""

import json
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lowfc.adapters.bus.bus import Publisher
from lowfc.contract.envelope import Envelope, sequence_of, start_of
from lowfc.contract.errors import ConfigurationError, raised_as
from lowfc.contract.messages import RawImage, from_timestamp, image
from sim_camera.faults import MAX_FRAMES_LATE, Fault, Frame, Kind

EARLIER_S = 3600
"""Time by which the fault "old-sequence" moves the camera's start, encoded in each sequence, into the past."""


def read_fault(file: Path) -> Fault:
    """Read a fault from a JSON file: an object with kind, first, frames and seed.

    Raises:
        ConfigurationError: the file does not contain a fault.
    """
    with raised_as(ConfigurationError, (OSError, ValueError, TypeError, KeyError), f"{file}: not a fault"):
        values = json.loads(file.read_text())
        return Fault(**(values | {"kind": Kind(values["kind"])}))


class FaultyFrames:
    """A publisher of frames that injects a fault; see `Publisher`."""

    def __init__(
        self, fault: Fault, publisher: Publisher, dark: float, highest: int, now_ns: Callable[[], int]
    ) -> None:
        """Wrap the publisher of frames; `dark` and `highest`: DN without light and at full well."""
        self._fault = fault
        self._publisher = publisher
        self._dark, self._highest = round(dark), highest
        self._now_ns = now_ns
        self._before: Frame | None = None
        self._messages: deque[tuple[int, bytes, int]] = deque(maxlen=MAX_FRAMES_LATE + 1)
        self._index = self._start_s = 0

    def put(self, payload: bytes) -> Envelope:
        """Publish the messages due at the end of an exposure; return its frame's envelope, even if that is not sent."""
        index, now_ns = self._index, self._now_ns()
        self._index += 1
        message = self._message(index, RawImage.FromString(payload))
        if not self._start_s:
            envelope = self._publisher.put(message)  # frame 0, which is always good
            self._start_s = start_of(envelope.sequence)
            self._messages.append((index, message, envelope.publish_time_ns))
            return envelope
        self._messages.append((index, message, now_ns))
        messages = {number: (body, time_ns) for number, body, time_ns in self._messages}
        for number in self._fault.frames_due(index):
            if number in messages:
                shift_s = EARLIER_S if self._fault.kind_at(number) is Kind.OLD_SEQUENCE else 0
                self._publisher.put(*messages[number], sequence_of(self._start_s - shift_s, number))
        return Envelope(sequence_of(self._start_s, index), now_ns)

    def _message(self, index: int, good: RawImage) -> bytes:
        """The bytes published in place of a frame without a fault."""
        frame = np.frombuffer(good.data, "<u2").reshape(good.height, good.width)
        before = frame if self._before is None else self._before
        self._before = self._fault.pixels(index, frame, before, self._dark, self._highest)
        faulty = image(self._before, from_timestamp(good.timestamp), good.frame_id)
        message = faulty.SerializeToString()
        return self._fault.payload(index, message, message.index(faulty.data) + len(faulty.data))
