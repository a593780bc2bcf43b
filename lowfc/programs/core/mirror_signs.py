"""Signs of life of the mirror, looked at now and then: its states wait in a ring, at no cost to the frames."""

import time
from collections.abc import Callable

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Bus, Sample
from lowfc.adapters.process.service import Service
from lowfc.contract.codecs import codec
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import MIRROR_STATE, wire
from lowfc.control.loop.inputs import MirrorShape

LOOK_NS = 100_000_000
SILENT_NS = 500_000_000
"""Without a state from a mirror, which publishes one every 0.1 s at least."""
_POLL_S = 0.01


class MirrorSigns:
    """What the mirror says of itself, and since when it has said nothing."""

    def __init__(self, bus: Bus, host_ns: Callable[[], int]) -> None:
        self._ring = bus.ring(MIRROR_STATE, 1)
        self._host_ns = host_ns
        self._last: Sample | None = None
        self._heard_ns = self._due_ns = host_ns()
        self._fault = self._wrong = ""
        self._closed = False

    @property
    def due(self) -> bool:
        """Whether it is time to look."""
        return not self._closed and self._host_ns() >= self._due_ns

    def first(self, patience_s: float, service: Service) -> MirrorShape | None:
        """The shape that the mirror reports first; None without one, or where the process is to end."""
        deadline_s = time.monotonic() + patience_s
        while service.running and self._news() is None and time.monotonic() < deadline_s:
            time.sleep(_POLL_S)
        return self.shape()

    def fault(self, *, commanded: bool) -> str:
        """What is wrong with the mirror, to be read after "the mirror"; empty where it follows.

        A state in which it does not follow may be older than the last command, so two in a row are needed.
        """
        state, now_ns = self._news(), self._host_ns()
        self._due_ns = now_ns + LOOK_NS
        if self._last is None:
            self._fault = "has not reported yet"
        elif state is not None:
            before, self._wrong = self._wrong, _wrong(state) if commanded else ""
            if self._wrong == before or not self._wrong:
                self._fault = self._wrong
        elif now_ns - self._heard_ns > SILENT_NS:
            self._fault = "does not answer"
        return self._fault

    def shape(self) -> MirrorShape | None:
        """Where it last was."""
        try:
            return None if self._last is None else codec.decode_mirror(self._last.payload)
        except BadMessageError:
            return None

    def close(self) -> None:
        """Look no more."""
        self._closed = True
        self._ring.close()

    def _news(self) -> wire.MirrorState | None:
        """The newest state that has come since the last look."""
        for sample in self._ring.drain():
            try:
                state = wire.MirrorState.FromString(sample.payload)
            except DecodeError:
                continue
            self._last, self._heard_ns = sample, self._host_ns()
            return state
        return None


def _wrong(state: wire.MirrorState) -> str:
    """Why the mirror does not follow, by its own account."""
    if state.refused:
        return f"refuses commands: {wire.Reason.Name(state.refused).removeprefix('REASON_')}"
    return "" if state.status == wire.MIRROR_STATUS_FOLLOWING else "gets no commands"
