"""Commands to a mirror under test, small ones first, and what it answers."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.adapters.instrument import mirror_limits
from lowfc.contract.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import COMMAND, MIRROR_STATE, timestamp, wire
from lowfc.control.safety import Limits
from lowfc.programs.conformance.checks import NS, Heard
from lowfc.programs.conformance.line import Line

Single = npt.NDArray[np.float32]

ANSWER_S = 0.5
"""A mirror that takes longer cannot be in a loop."""
VALID_NS = NS
CHANNEL = "lowfc"
"""The controller's, so that its next command takes the place of ours."""
TURN_S = 0.002

Tell = Callable[[str], None]

_PATTERN_SEED = 5
_GENTLE = 0.05
_MOST_MOVES = 400


@dataclass(frozen=True, slots=True)
class Expected:
    """What the configuration says of the mirror.

    Attributes:
        name: in its topics.
        grid: rows and columns of actuators.
        limits: that it keeps, nm of surface.
        step_nm: least step of its driver.
        moving: (rows, columns) which actuators move.
        period_ns: between two commands of the loop.
    """

    name: str
    grid: tuple[int, int]
    limits: Limits
    step_nm: float
    moving: npt.NDArray[np.bool_]
    period_ns: int

    @property
    def tolerance_nm(self) -> float:
        """Of an actuator: one step of the driver."""
        return self.step_nm + 1e-3

    @property
    def pattern_nm(self) -> Single:
        """A shape without symmetry, far below every limit."""
        largest = _GENTLE * min(self.limits.stroke_nm, self.limits.slew_nm, self.limits.neighbour_nm / 2)
        drawn = np.random.default_rng(_PATTERN_SEED).uniform(-largest, largest, self.grid)
        return np.where(self.moving, drawn, 0).astype(np.float32)


def expected_of(config: Configuration) -> Expected:
    """What a configuration says of its mirror; dead and stuck actuators do not move."""
    section = config.mirror
    moving = np.ones((section.rows, section.columns), bool)
    moving.flat[[*section.dead, *map(int, section.stuck_nm)]] = False
    step_nm = section.stroke_nm / 2**section.driver_bits
    grid = (section.rows, section.columns)
    return Expected(section.name, grid, mirror_limits(config), step_nm, moving, config.period_ns)


class Dialogue:
    """Puts commands and collects states.

    Attributes:
        states: every state that could be read, with the message that it came in.
        messages: everything heard.
        unreadable: states that could not be read.
    """

    def __init__(self, line: Line, expected: Expected) -> None:
        self.line = line
        self.expected = expected
        self.states: list[tuple[Heard, wire.MirrorState]] = []
        self.messages: list[Heard] = []
        self.unreadable = 0
        self._next = 1
        self._told_nm: Single = np.zeros(expected.grid, np.float32)

    @property
    def last(self) -> wire.MirrorState | None:
        """Newest state."""
        return self.states[-1][1] if self.states else None

    @property
    def where_nm(self) -> Single:
        """Where the mirror says that it is; where it was told to be, if that cannot be read."""
        found = surface_nm(self.last)
        good = found is not None and found.shape == self.expected.grid and bool(np.isfinite(found).all())
        return found if found is not None and good else self._told_nm

    def begin(self, shape_nm: Single, last_sequence: int) -> None:
        """Go on from where the mirror is, with sequences above the last that it followed, and no higher than needed.

        Those of a camera that runs are above; a controller that takes over is not refused.
        """
        self._told_nm, self._next = shape_nm, last_sequence + 1

    def listen(self, seconds: float) -> list[wire.MirrorState]:
        """States that come in so long a time."""
        before, end_ns = len(self.states), self.line.now_ns() + round(seconds * NS)
        while (left_ns := end_ns - self.line.now_ns()) > 0:
            self.line.wait(min(TURN_S, left_ns / NS))
            self._collect()
        return [state for _, state in self.states[before:]]

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
            command_nm=[0.5, -0.25],
            clear_id=clear_id,
        )
        self.line.put(COMMAND, self.expected.name, command.SerializeToString())
        return sequence, time_ns

    def ask(self, wanted_nm: Single, valid_ns: int = VALID_NS) -> tuple[wire.MirrorState | None, int, int]:
        """Send a command and wait for the state that answers it, None in vain.

        Returns:
            The state, the command's time, and how long it took, ns.
        """
        self._told_nm, before = wanted_nm, len(self.states)
        sequence, sent_ns = self.put(wanted_nm, valid_ns=valid_ns)
        end_ns = self.line.now_ns() + round(ANSWER_S * NS)
        while self.line.now_ns() < end_ns:
            for heard, state in self.states[before:]:
                if state.frame_sequence == sequence:
                    return state, sent_ns, heard.receive_time_ns - sent_ns
            self.line.wait(TURN_S)
            self._collect()
        return None, sent_ns, 0

    def go(self, wanted_nm: Single) -> wire.MirrorState | None:
        """Go there in moves of half the slew limit; return the answer to the last, None where one was not answered."""
        state = None
        for target_nm in self._moves(wanted_nm):
            state, _, _ = self.ask(target_nm)
            if state is None:
                return None
        return state

    def moves_to(self, wanted_nm: Single) -> int:
        """How many moves that is."""
        return max(1, int(np.ceil(float(np.abs(wanted_nm - self.where_nm).max()) / (self.expected.limits.slew_nm / 2))))

    def reachable(self, height_nm: float) -> bool:
        """Whether all actuators can be moved by so much in a reasonable number of moves."""
        return height_nm / (self.expected.limits.slew_nm / 2) < _MOST_MOVES

    def _moves(self, wanted_nm: Single) -> Iterator[Single]:
        start_nm, count = self.where_nm, self.moves_to(wanted_nm)
        for index in range(1, count + 1):
            yield (start_nm + (wanted_nm - start_nm) * np.float32(index / count)).astype(np.float32)

    def _collect(self) -> None:
        for heard in self.line.heard():
            self.messages.append(heard)
            if heard.key == MIRROR_STATE.at(self.expected.name):
                try:
                    self.states.append((heard, wire.MirrorState.FromString(heard.payload)))
                except DecodeError:
                    self.unreadable += 1


def surface_nm(state: wire.MirrorState | None) -> Single | None:
    """Actuators (rows, columns) of a state; None where there is none, or its bytes make no grid."""
    return None if state is None else actuators(state)


def moved(expected: Expected, before_nm: Single, state: wire.MirrorState) -> bool:
    """Whether a state differs from where the mirror was by more than a step, or is not finite."""
    found = surface_nm(state)
    if found is None or found.shape != before_nm.shape:
        return True
    return not bool(np.all(np.abs(found - before_nm)[expected.moving] <= expected.tolerance_nm))
