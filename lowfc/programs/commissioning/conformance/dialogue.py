"""Commands to a mirror under test, small ones first, and what it answers."""

from collections.abc import Callable

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.files.factory import mirror_limits
from lowfc.arrays import Mask, Single
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import COMMAND, MIRROR_STATE, timestamp, wire
from lowfc.programs.commissioning.conformance.line import NS, Collected, Line, Received

ANSWER_S = 0.5
"""A mirror that takes longer cannot be in a loop."""
VALID_NS = NS
MODAL_NM = (0.5, -0.25)
"""Sent as the modal command."""
CHANNEL = "lowfc"
"""The controller's, so that its next command takes the place of ours."""
TURN_S = 0.002

Show = Callable[[str], None]

_PATTERN_SEED = 5
_GENTLE = 0.05
_MOST_MOVES = 400


class Expected:
    """What a configuration says of its mirror; dead and stuck actuators do not move.

    Attributes:
        name: in its topics.
        grid: rows and columns of actuators.
        limits: that it keeps, nm of surface.
        step_nm: least step of its driver.
        moving: (rows, columns) which actuators move.
        period_ns: between two commands of the loop.
    """

    def __init__(self, config: Configuration) -> None:
        """Read the mirror's section."""
        section = config.mirror
        self.name, self.grid = section.name, (section.rows, section.columns)
        self.limits, self.period_ns = mirror_limits(config), config.period_ns
        self.step_nm: float = section.stroke_nm / 2**section.driver_bits
        self.moving: Mask = np.ones(self.grid, bool)
        self.moving.flat[[*section.dead, *map(int, section.stuck_nm)]] = False

    @property
    def tolerance_nm(self) -> float:
        """Largest error of an actuator: one step of the driver, nm of surface."""
        return self.step_nm + 1e-3

    @property
    def move_nm(self) -> float:
        """Largest move on a long way: half the slew limit, nm of surface."""
        return self.limits.slew_nm / 2

    @property
    def pattern_nm(self) -> Single:
        """A shape without symmetry, far below every limit."""
        largest = _GENTLE * min(self.limits.stroke_nm, self.limits.slew_nm, self.limits.neighbour_nm / 2)
        drawn = np.random.default_rng(_PATTERN_SEED).uniform(-largest, largest, self.grid)
        return np.where(self.moving, drawn, 0).astype(np.float32)


class Dialogue(Collected):
    """Sends commands to a mirror and collects its states.

    Attributes:
        states: every state that could be read, with the message that it came in.
        unreadable: states that could not be read.
    """

    def __init__(self, line: Line, expected: Expected) -> None:
        super().__init__(line, MIRROR_STATE.at(expected.name), mirror_role(expected.name))
        self.expected = expected
        self.states: list[tuple[Received, wire.MirrorState]] = []
        self.unreadable = 0
        self._next = 1
        self._commanded_nm: Single = np.zeros(expected.grid, np.float32)

    def take(self, message: Received) -> None:
        """Keep a message."""
        super().take(message)
        if message.key == self.key:
            try:
                self.states.append((message, wire.MirrorState.FromString(message.payload)))
            except DecodeError:
                self.unreadable += 1

    @property
    def last(self) -> wire.MirrorState | None:
        """Newest state."""
        return self.states[-1][1] if self.states else None

    @property
    def where_nm(self) -> Single:
        """Where the mirror reports to be; where it was commanded to be, if that cannot be read."""
        found = self.surface_nm(self.last)
        return self._commanded_nm if found is None else found

    def surface_nm(self, state: wire.MirrorState | None) -> Single | None:
        """Actuators (rows, columns) of a state; None where there is none, or no finite grid of the configured size."""
        found = None if state is None else actuators(state)
        good = found is not None and found.shape == self.expected.grid and bool(np.isfinite(found).all())
        return found if good else None

    def begin(self, shape_nm: Single, last_sequence: int) -> None:
        """Go on from where the mirror is, with sequences above the last that it followed, and no higher than needed.

        Those of a camera that runs are above; a controller that takes over is not refused.
        """
        self._commanded_nm, self._next = shape_nm, last_sequence + 1

    def listen(self, seconds: float) -> list[wire.MirrorState]:
        """States that come in so long a time."""
        before, end_ns = len(self.states), self.line.now_ns() + round(seconds * NS)
        while (left_ns := end_ns - self.line.now_ns()) > 0:
            self.collect(min(TURN_S, left_ns / NS))
        return [state for _, state in self.states[before:]]

    def since(self, time_ns: int) -> list[tuple[Received, wire.MirrorState]]:
        """States that came later."""
        return [(message, state) for message, state in self.states if message.receive_time_ns >= time_ns]

    def put(
        self,
        wanted_nm: Single,
        *,
        valid_ns: int = VALID_NS,
        sequence: int | None = None,
        cut: int = 0,
        clear_id: int = 0,
    ) -> tuple[int, int]:
        """Send a command; return its sequence and its time.

        Args:
            wanted_nm: (rows, columns) nm of surface.
            valid_ns: how long it may be held.
            sequence: of its frame; the next one if None.
            cut: bytes that are missing at the end.
            clear_id: identity of an operator's clear; 0 for none.
        """
        if sequence is None:
            sequence, self._next = self._next, self._next + 1
        data, time_ns = wanted_nm.astype("<f4").tobytes(), self.line.now_ns()
        command = wire.MirrorCommand(
            timestamp=timestamp(time_ns),
            frame_sequence=sequence,
            channel=CHANNEL,
            valid_for_ns=valid_ns,
            rows=wanted_nm.shape[0],
            columns=wanted_nm.shape[1],
            actuators=data[: len(data) - cut],
            command_nm=MODAL_NM,
            clear_id=clear_id,
        )
        self.line.put(COMMAND, self.expected.name, command.SerializeToString())
        return sequence, time_ns

    def ask(self, wanted_nm: Single, valid_ns: int = VALID_NS) -> tuple[wire.MirrorState | None, int, int]:
        """Send a command and wait for the state that answers it, None in vain.

        Returns:
            The state, the command's time, and how long it took, ns.
        """
        self._commanded_nm, before = wanted_nm, len(self.states)
        sequence, sent_ns = self.put(wanted_nm, valid_ns=valid_ns)
        end_ns = self.line.now_ns() + round(ANSWER_S * NS)
        while self.line.now_ns() < end_ns:
            for message, state in self.states[before:]:
                if state.frame_sequence == sequence:
                    return state, sent_ns, message.receive_time_ns - sent_ns
            self.collect(TURN_S)
        return None, sent_ns, 0

    def go(self, wanted_nm: Single) -> wire.MirrorState | None:
        """Go there in moves of half the slew limit; return the answer to the last, None where one was not answered."""
        start_nm, state = self.where_nm, None
        count = max(1, int(np.ceil(float(np.abs(wanted_nm - start_nm).max()) / self.expected.move_nm)))
        for index in range(1, count + 1):
            state, _, _ = self.ask((start_nm + (wanted_nm - start_nm) * np.float32(index / count)).astype(np.float32))
            if state is None:
                break
        return state

    def reachable(self, height_nm: float) -> bool:
        """Whether all actuators can be moved by so much in a reasonable number of moves."""
        return height_nm / self.expected.move_nm < _MOST_MOVES

    def moved(self, before_nm: Single, state: wire.MirrorState) -> bool:
        """Whether a state differs from where the mirror was by more than a step, or is no finite grid."""
        found = self.surface_nm(state)
        if found is None:
            return True
        return not bool(np.all(np.abs(found - before_nm)[self.expected.moving] <= self.expected.tolerance_nm))
