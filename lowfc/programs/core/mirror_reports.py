"""The mirror's first shape, and its faults; these are read from Health, as receiving all states takes time."""

import contextlib
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
from lowfc.control.loop.safety import reason_name
from lowfc.control.loop.state import State

CHECK_PERIOD_NS = 100_000_000
SILENT_NS = 1_600_000_000
"""Longest time without a Health: the mirror sends two per second, so that two in a row may be missing."""


class MirrorReports:
    """Faults that the mirror reports, and its silence.

    A mirror that never sent a Health is not reported as silent.
    """

    def __init__(self, service: Service, name: str) -> None:
        self._service = service
        self._states = Mailbox(MIRROR_STATE.at(name))
        self._unsubscribe_states = service.bus.subscribe(MIRROR_STATE, self._states.put, name)
        self._unsubscribe_health = service.bus.subscribe(HEALTH, self._received, mirror_role(name))
        self._reports: deque[wire.Health] = deque(maxlen=1)
        self._received_ns = self._due_ns = 0
        self._reported = False
        self._fault = self._health_fault = ""
        self._commanded: deque[MirrorShape] = deque(maxlen=2)

    @property
    def due(self) -> bool:
        """Whether a check is due."""
        return self._service.clock.host_ns() >= self._due_ns

    def first(self, timeout_s: float = 0.0) -> MirrorShape | None:
        """The first shape that the mirror reports; None if none has arrived, and once the first has been returned."""
        sample = None if self._reported else self._states.take(timeout_s)
        try:
            shape = codec.decode_mirror(sample.payload) if sample is not None else None
        except BadMessageError as fault:
            self._service.unreadable(MIRROR_STATE.key, fault)
            return None
        if shape is not None:
            self._reported = True
            self._unsubscribe_states()  # further states would only cost time
        return shape

    def fault(self, state: State) -> str:
        """Fault of the mirror, as a predicate after "the mirror"; empty if there is none.

        A fault counts after two Healths in a row with faults, even different ones: the first Health may predate the
        last command. Another fault replaces it only after two Healths in a row with that fault, because a mirror that
        has just recovered reports for a moment that it has no command.
        """
        now_ns = self._service.clock.host_ns()
        self._due_ns = now_ns + CHECK_PERIOD_NS
        if self._reports:
            self._received_ns = now_ns
            before, report = self._health_fault, self._reports.popleft()
            self._health_fault = _fault_in(report) if state.commanded else ""
            if not self._health_fault or (before and (not self._fault or before == self._health_fault)):
                self._fault = self._health_fault
            if not self._fault and state.loop is not None:
                shape = MirrorShape(now_ns, state.loop.actuators_nm, state.loop.history_nm[0])
                self._commanded.append(shape)
        elif self._received_ns and now_ns - self._received_ns > SILENT_NS:
            self._fault = "does not answer"
        return self._fault if self._reported else "has not reported yet"

    def last(self) -> MirrorShape | None:
        """The shape commanded two Healths before a fault was certain, the newest that the mirror has surely applied."""
        return self._commanded[0] if self._commanded else None

    def close(self) -> None:
        """Unsubscribe."""
        self._unsubscribe_health()
        if not self._reported:
            self._unsubscribe_states()

    def _received(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError):
            self._reports.append(wire.Health.FromString(sample.payload))


def _fault_in(health: wire.Health) -> str:
    if number := int(health.command_refused):  # a mirror of another version may have other reasons
        return f"refuses commands: {reason_name(number)}"
    return "gets no commands" if health.command_expired else ""
