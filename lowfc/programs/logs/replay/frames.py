"""The newest frames of a log, from which its steps are recomputed."""

import contextlib
from collections import deque

from lowfc.contract.codecs import codec
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import from_timestamp, wire
from lowfc.control.loop.inputs import Frame

FRAMES_BYTES = 64 << 20  # limit of the memory for frames
_STEPS_KEPT = 10_000  # number of steps whose frame is remembered


class Frames:
    """The newest frames of a log, by sequence, within a limit of memory."""

    def __init__(self) -> None:
        self._payloads: dict[int, list[bytes]] = {}
        self._order: deque[int] = deque()
        self._bytes = 0
        self._steps: deque[tuple[int, int]] = deque(maxlen=_STEPS_KEPT)

    def add(self, sequence: int, payload: bytes) -> None:
        """Add a frame; drop the oldest frames beyond the limit of memory."""
        self._payloads.setdefault(sequence, []).append(payload)
        self._order.append(sequence)
        self._bytes += len(payload)
        while self._bytes > FRAMES_BYTES and len(self._order) > 1:
            oldest = self._order.popleft()
            payloads = self._payloads[oldest]
            self._bytes -= len(payloads.pop(0))
            if not payloads:
                del self._payloads[oldest]

    def note_step(self, step: wire.ControlStep) -> None:
        """Remember the frame of a logged step."""
        self._steps.append((step.frame_sequence, from_timestamp(step.timestamp)))

    def frame(self, sequence: int, time_ns: int, age_ns: int, *, any_time: bool = False) -> Frame | None:
        """The frame of this sequence and time; else, if `any_time`, the newest of this sequence that has no step."""
        found = []
        for payload in self._payloads.get(sequence, ()):
            with contextlib.suppress(BadMessageError):  # the controller skipped it, too
                found.append(codec.decode_frame(payload, sequence, age_ns))
        exact = next((frame for frame in found if frame.time_ns == time_ns), None)
        unused = (frame for frame in reversed(found) if (sequence, frame.time_ns) not in self._steps)
        return next(unused, None) if exact is None and any_time else exact
