"""A camera's publisher with faults: for tests of what the others make of them."""

import json
from collections import deque
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lowfc.adapters.bus import Publisher
from lowfc.contract.envelope import Envelope, sequence_of, start_of
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import image
from sim_camera.faults import MOST_FRAMES_LATE, Fault, Frame, Kind, cut, payload, pixels, sent, starts_before

EARLIER_S = 3600
"""By how much a clock was set back."""


def read_faults(file: Path) -> tuple[Fault, ...]:
    """Faults of a JSON file: a list of objects with kind, first, frames and seed.

    Raises:
        ConfigurationError: it is none.
    """
    try:
        return tuple(Fault(**(one | {"kind": Kind(one["kind"])})) for one in json.loads(file.read_text()))
    except (OSError, ValueError, TypeError, KeyError) as fault:
        raise ConfigurationError(f"{file}: not a list of faults: {fault}") from None


class FaultyFrames:
    """Publishes frames, or what befell them."""

    def __init__(self, faults: tuple[Fault, ...], publisher: Publisher, dark: float, highest: int) -> None:
        """Take the publisher of the frames; `dark` and `highest` are the detector's least and largest values, DN."""
        self._faults = faults
        self._publisher = publisher
        self._dark, self._highest = round(dark), highest
        self._before: Frame | None = None
        self._made: deque[tuple[int, bytes, int]] = deque(maxlen=MOST_FRAMES_LATE + 1)
        self._start_s = 0

    def message(self, index: int, frame: npt.NDArray[np.uint16], time_ns: int) -> bytes:
        """Message of a frame (rows, columns)."""
        before = frame if self._before is None else self._before
        self._before = pixels(self._faults, index, frame, before, self._dark, self._highest)
        sound = image(cut(self._faults, index, self._before), time_ns, "lowfc_camera")
        message = sound.SerializeToString()
        return payload(self._faults, index, message, message.index(sound.data) + len(sound.data))

    def put(self, index: int, message: bytes, now_ns: int) -> Envelope:
        """Publish what is due at the end of an exposure; return the envelope that its frame has or should have."""
        if not self._start_s:
            envelope = self._publisher.put(message)  # of frame 0, which is always good
            self._start_s = start_of(envelope.sequence)
            self._made.append((index, message, envelope.publish_time_ns))
            return envelope
        self._made.append((index, message, now_ns))
        made = {number: (body, time_ns) for number, body, time_ns in self._made}
        for number in sent(self._faults, index):
            if number in made:
                body, time_ns = made[number]
                self._publisher.put(body, time_ns, self._sequence(number))
        return Envelope(sequence_of(self._start_s, index), now_ns)

    def _sequence(self, index: int) -> int:
        start_s = self._start_s - EARLIER_S if starts_before(self._faults, index) else self._start_s
        return sequence_of(start_s, index)
