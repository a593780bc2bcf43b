"""The mirrors of a running loop, for a program whose frames are valid only while the mirror follows commands."""

import time
from collections import deque

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Bus, Ring, name_in
from lowfc.client.stream import BUFFERED_MESSAGES, DEFAULT_TIMEOUT_S
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import EVENT, MIRROR_STATE, Log, wire

INTERRUPTIONS = ("COMMAND_EXPIRED ", "NO_FRAMES ")
"""First words of the events after which the mirror is no longer where a probe sequence puts it."""
_POLL_S = 0.002


class MirrorWatch:
    """States of a run's mirrors received since construction; construction waits for the first state.

    Attributes:
        applied: frame sequences of the last applied commands, each with the time of the mirror's report, ns of the
            host's clock.
        interruption: for an error message, the last event since construction that makes a probe sequence invalid: a
            mirror did not follow commands, received none because frames stopped, or restarted; empty without one.
        offset: offset of the router's clock from this host's; None on one host.
    """

    def __init__(self, bus: Bus) -> None:
        """Subscribe to the mirrors' states and events; BusError if no mirror reports."""
        self.interruption, self.offset = "", bus.offset
        self.applied: deque[tuple[int, int]] = deque(maxlen=BUFFERED_MESSAGES)
        self._events: Ring = bus.ring(EVENT, BUFFERED_MESSAGES)
        self._states: Ring = bus.ring(MIRROR_STATE, BUFFERED_MESSAGES)
        # by name of the mirror: start of its process, frame of its command, whether it follows commands
        self._mirrors: dict[str, tuple[int, int, bool]] = {}
        deadline_s = time.monotonic() + DEFAULT_TIMEOUT_S
        self.read()
        while not self._mirrors:
            if time.monotonic() >= deadline_s:
                raise BusError(f"no mirror state came within {DEFAULT_TIMEOUT_S:g} s: is the mirror's process running?")
            time.sleep(_POLL_S)
            self.read()

    @property
    def frame_sequence(self) -> int:
        """Sequence of the frame of the newest command that every known mirror has applied."""
        return min(sequence for _, sequence, _ in self._mirrors.values())

    def read(self) -> None:
        """Process the messages received since the last call, without blocking."""
        for sample in self._states.drain():
            name, start_s = name_in(MIRROR_STATE, sample.key), start_of(sample.sequence)
            try:
                state = wire.MirrorState.FromString(sample.payload)
            except DecodeError:
                continue
            known_start_s, frame_sequence, followed = self._mirrors.get(name, (start_s, 0, False))
            if known_start_s != start_s:
                self.interruption = f"the mirror {name!r} restarted"
            elif state.refused == wire.REASON_NO_MIRROR:
                self.interruption = f"the mirror {name!r} did not follow commands, because its driver failed"
            elif followed and state.status == wire.MIRROR_STATUS_EXPIRED:
                self.interruption = f"the mirror {name!r} did not follow commands, because the last one expired"
            if state.frame_sequence > frame_sequence:
                self.applied.append((state.frame_sequence, sample.publish_time_ns))
            follows = state.status == wire.MIRROR_STATUS_FOLLOWING
            self._mirrors[name] = start_s, state.frame_sequence, follows
        for sample in self._events.drain():
            try:
                event = Log.FromString(sample.payload)
            except DecodeError:
                continue
            if event.message.startswith(INTERRUPTIONS):
                without = "frames" if event.message.startswith("NO_FRAMES ") else "commands"
                self.interruption = f"{event.name} was without {without} for too long ({event.message})"
