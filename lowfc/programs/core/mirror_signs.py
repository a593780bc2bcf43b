"""Signs of life of the mirror: its Health, for its states would cost every frame time."""

from collections import deque

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.mailbox import Mailbox
from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.process.service import Service
from lowfc.contract.codecs import codec
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import HEALTH, MIRROR_STATE, wire
from lowfc.control.loop.inputs import MirrorShape
from lowfc.control.loop.state import State

LOOK_NS = 100_000_000
SILENT_NS = 1_600_000_000
"""Without a Health, of which there are two a second: three may be late."""


class MirrorSigns:
    """What the mirror reports of itself, and since when it has been silent.

    A mirror that never sent a Health is not missed.
    """

    def __init__(self, service: Service, name: str) -> None:
        self._service = service
        self._states = Mailbox(MIRROR_STATE.at(name))
        self._leave_states = service.bus.subscribe(MIRROR_STATE, self._states.put, name)
        self._leave_health = service.bus.subscribe(HEALTH, self._received, mirror_role(name))
        self._reports: deque[wire.Health] = deque(maxlen=1)
        self._received_ns = self._due_ns = 0
        self._reported = False
        self._fault = self._wrong = ""
        self._commanded: deque[MirrorShape] = deque(maxlen=2)

    @property
    def due(self) -> bool:
        """Whether it is time to look."""
        return self._service.clock.host_ns() >= self._due_ns

    def first(self, patience_s: float = 0.0) -> MirrorShape | None:
        """The shape that the mirror reports first; None without one."""
        sample = None if self._reported else self._states.take(patience_s)
        try:
            shape = codec.decode_mirror(sample.payload) if sample is not None else None
        except BadMessageError as fault:
            self._service.unreadable(MIRROR_STATE.key, fault)
            return None
        if shape is not None:
            self._reported = True
            self._leave_states()  # from here they would only cost time
        return shape

    def fault(self, state: State) -> str:
        """What is wrong with the mirror, to be read after "the mirror"; empty where it follows.

        By its own account it must be wrong twice: the first may be from before the last command.
        """
        now_ns = self._service.clock.host_ns()
        self._due_ns = now_ns + LOOK_NS
        if self._reports:
            self._received_ns = now_ns
            before, self._wrong = self._wrong, _wrong(self._reports.popleft()) if state.commanded else ""
            if self._wrong == before or not self._wrong:
                self._fault = self._wrong
            if not self._fault and state.drive is not None:
                shape = MirrorShape(now_ns, state.drive.actuators_nm, state.drive.history_nm[0])
                self._commanded.append(shape)
        elif self._received_ns and now_ns - self._received_ns > SILENT_NS:
            self._fault = "does not answer"
        return self._fault if self._reported else "has not reported yet"

    def last(self) -> MirrorShape | None:
        """What was commanded at the last but one sign that it follows, since when it may not have followed."""
        return self._commanded[0] if self._commanded else None

    def close(self) -> None:
        """Look no more."""
        self._leave_health()
        if not self._reported:
            self._leave_states()

    def _received(self, sample: Sample) -> None:
        try:
            self._reports.append(wire.Health.FromString(sample.payload))
        except DecodeError:
            return


def _wrong(health: wire.Health) -> str:
    if health.command_refused:
        return f"refuses commands: {wire.Reason.Name(health.command_refused).removeprefix('REASON_')}"
    return "gets no commands" if health.command_expired else ""
