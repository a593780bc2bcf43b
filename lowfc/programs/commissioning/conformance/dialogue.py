"""Commands to a mirror under test, and the states that answer the commands."""

from collections.abc import Callable

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.files.factory import mirror_limits
from lowfc.adapters.files.mirror_maps import active_actuators
from lowfc.arrays import Mask, Single
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import COMMAND, MIRROR_STATE, timestamp, wire
from lowfc.programs.commissioning.conformance.connection import NS_PER_S, CollectedMessages, Connection, Received

ANSWER_S = 0.5
"""Timeout for an answer; a slower mirror cannot be used in a loop."""
ATTEMPTS = 3
"""Attempts before a check fails: a mirror skips commands that are late because the host stalled."""
VALID_NS = NS_PER_S
"""Validity of an ordinary test command."""
MODAL_NM = (0.5, -0.25)
"""Modal command in every test command, nm rms of wavefront."""
CHANNEL = "lowfc"
"""Channel of the controller, so that the first command of a later controller replaces the test's shape."""
POLL_S = 0.002

Show = Callable[[str], None]

_PATTERN_SEED = 5
_ORDINARY = 0.05  # size of ordinary commands relative to the smallest of stroke, slew and half the neighbour limit
_MAX_MOVES = 400  # largest number of moves on the way to a distant shape


class Expected:
    """The mirror as configured; dead, stuck and inactive actuators are not checked.

    Attributes:
        name: name of the mirror, as in its topics.
        grid: rows and columns of actuators.
        limits: the mirror's limits, nm of surface.
        step_nm: smallest step of the driver, nm of surface.
        moving: whether each actuator is active, and neither dead nor stuck (rows, columns).
        period_ns: time between two commands of the loop.
    """

    def __init__(self, config: Configuration) -> None:
        """Read the mirror's section; ConfigurationError if its map of active actuators cannot be used."""
        section = config.mirror
        self.name, self.grid = section.name, (section.rows, section.columns)
        self.limits, self.period_ns = mirror_limits(config), config.period_ns
        self.step_nm: float = section.stroke_nm / 2**section.driver_bits
        active = active_actuators(config)
        self.moving: Mask = np.ones(self.grid, bool) if active is None else active
        self.moving.flat[[*section.dead, *map(int, section.stuck_nm)]] = False

    @property
    def tolerance_nm(self) -> float:
        """Largest error of an actuator: one step of the driver, nm of surface."""
        return self.step_nm + 1e-3

    @property
    def move_nm(self) -> float:
        """Largest single move on the way to a distant shape: half the slew limit, nm of surface."""
        return self.limits.slew_nm / 2

    @property
    def pattern_nm(self) -> Single:
        """A shape (rows, columns) without symmetry, nm of surface, far below every limit."""
        largest = _ORDINARY * min(self.limits.stroke_nm, self.limits.slew_nm, self.limits.neighbour_nm / 2)
        drawn = np.random.default_rng(_PATTERN_SEED).uniform(-largest, largest, self.grid)
        return np.where(self.moving, drawn, 0).astype(np.float32)


class Dialogue(CollectedMessages):
    """Sends commands to a mirror and collects its states.

    Attributes:
        states: every state that could be decoded, with its message.
        unreadable: number of states that could not be decoded.
        failed: number of attempts that failed and were repeated, since this number was last set to 0.
    """

    def __init__(self, connection: Connection, expected: Expected) -> None:
        super().__init__(connection, MIRROR_STATE.at(expected.name), mirror_role(expected.name))
        self.expected = expected
        self.states: list[tuple[Received, wire.MirrorState]] = []
        self.unreadable = self.failed = 0
        self._next = 1
        self._commanded_nm: Single = np.zeros(expected.grid, np.float32)

    def store(self, message: Received) -> None:
        """Store a message, and decode it if it is a state."""
        super().store(message)
        if message.key == self.key:
            try:
                self.states.append((message, wire.MirrorState.FromString(message.payload)))
            except DecodeError:
                self.unreadable += 1

    @property
    def last(self) -> wire.MirrorState | None:
        """The newest state; None if there is none."""
        return self.states[-1][1] if self.states else None

    @property
    def reported_nm(self) -> Single:
        """Reported surface (rows, columns), nm; the last commanded one if no usable surface was reported."""
        found = self.surface_nm(self.last)
        return self._commanded_nm if found is None else found

    def surface_nm(self, state: wire.MirrorState | None) -> Single | None:
        """Actuators (rows, columns) of a state, nm; None without a state.

        None also if the grid has another size than configured, or a value is not finite or beyond the full stroke.
        """
        found, max_nm = None if state is None else actuators(state), 2 * self.expected.limits.stroke_nm
        good = found is not None and found.shape == self.expected.grid and bool((np.abs(found) <= max_nm).all())
        return found if good else None

    def begin(self, shape_nm: Single, last_sequence: int) -> None:
        """Start at the mirror's present shape, with the sequence after that of the last applied command.

        A running camera's sequences are higher, so that the mirror will not refuse a later controller's commands.
        """
        self._commanded_nm, self._next = shape_nm, last_sequence + 1

    def listen(self, seconds: float) -> list[wire.MirrorState]:
        """States received in the next `seconds`."""
        before, end_ns = len(self.states), self.connection.now_ns() + round(seconds * NS_PER_S)
        while (remaining_ns := end_ns - self.connection.now_ns()) > 0:
            self.collect(min(POLL_S, remaining_ns / NS_PER_S))
        return [state for _, state in self.states[before:]]

    def since(self, time_ns: int) -> list[tuple[Received, wire.MirrorState]]:
        """States received at or after this time, with their messages."""
        return [(message, state) for message, state in self.states if message.receive_time_ns >= time_ns]

    def put(
        self,
        surface_nm: Single,
        *,
        valid_ns: int = VALID_NS,
        sequence: int | None = None,
        cut: int = 0,
        clear_id: int = 0,
    ) -> tuple[int, int]:
        """Send a command; return its sequence and its time.

        Args:
            surface_nm: Shape (rows, columns), nm of surface.
            valid_ns: Time for which the command is valid.
            sequence: Frame sequence; the next one if None.
            cut: Number of bytes removed from the end of the shape.
            clear_id: Identity of an operator's clear; 0 for none.
        """
        if sequence is None:
            sequence, self._next = self._next, self._next + 1
        data, time_ns = surface_nm.astype("<f4").tobytes(), self.connection.now_ns()
        command = wire.MirrorCommand(
            timestamp=timestamp(time_ns),
            frame_sequence=sequence,
            channel=CHANNEL,
            valid_for_ns=valid_ns,
            rows=surface_nm.shape[0],
            columns=surface_nm.shape[1],
            actuators=data[: len(data) - cut],
            command_nm=MODAL_NM,
            clear_id=clear_id,
        )
        self.connection.put(COMMAND, self.expected.name, command.SerializeToString())
        return sequence, time_ns

    def ask(
        self, surface_nm: Single, valid_ns: int = VALID_NS, sequence: int | None = None, clear_id: int = 0
    ) -> tuple[wire.MirrorState | None, int, int]:
        """Send a command, and wait for the state that answers it; repeat the command if it is not answered.

        Returns:
            The state, None without an answer; the time of the answered or last command, ns; the time from this command
            to the answer, ns, 0 without an answer.
        """
        self._commanded_nm, before, times_ns, sent_ns = surface_nm, len(self.states), dict[int, int](), 0
        for attempt in range(ATTEMPTS):
            self.failed += attempt > 0
            sent, sent_ns = self.put(surface_nm, valid_ns=valid_ns, sequence=sequence, clear_id=clear_id)
            times_ns[sent] = sent_ns
            while self.connection.now_ns() < sent_ns + ANSWER_S * NS_PER_S:
                self.collect(POLL_S)
                for message, state in self.states[before:]:
                    if (command_ns := times_ns.get(state.frame_sequence)) is not None:
                        return state, command_ns, message.receive_time_ns - command_ns
        return None, sent_ns, 0

    def go(self, surface_nm: Single) -> wire.MirrorState | None:
        """Move to a shape in moves of at most half the slew limit; return the last answer, None if one was missing."""
        start_nm, state = self.reported_nm, None
        count = max(1, int(np.ceil(float(np.abs(surface_nm - start_nm).max()) / self.expected.move_nm)))
        for index in range(1, count + 1):
            state, _, _ = self.ask((start_nm + (surface_nm - start_nm) * np.float32(index / count)).astype(np.float32))
            if state is None:
                break
        return state

    def reachable(self, height_nm: float) -> bool:
        """Whether all actuators can be moved by this height in a reasonable number of moves."""
        return height_nm / self.expected.move_nm < _MAX_MOVES

    def moved(self, before_nm: Single, state: wire.MirrorState) -> bool:
        """Whether a state differs from a former surface by more than a driver step, or has no usable surface."""
        found = self.surface_nm(state)
        if found is None:
            return True
        return not bool(np.all(np.abs(found - before_nm)[self.expected.moving] <= self.expected.tolerance_nm))
