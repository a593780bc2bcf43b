"""What the logs of a chaos case hold, read once for all rules."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from lowfc.adapters.log_reader import Logged, LogReader
from lowfc.contract.codec import actuators
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import COMMAND, EVENT, FRAME, HEALTH, MIRROR_STATE, STEP, TRUTH, Log, wire

Single = npt.NDArray[np.float32]

FORGED_S = 1
"""Start that our forged and damaged messages have, in 1970: no process of a run has it."""


class Shape(NamedTuple):
    """A command or a state of the mirror: who sent it, when, and the actuators, (rows, columns) nm."""

    sequence: int
    log_time_ns: int
    taken: int
    frame_sequence: int
    actuators_nm: Single


class Stepped(NamedTuple):
    """A step of the control law; `used` where an error was measured."""

    sequence: int
    log_time_ns: int
    taken: int
    frame_sequence: int
    mode: int
    reasons: tuple[int, ...]
    used: bool


class Happened(NamedTuple):
    """An event: who said what, and how bad it is."""

    log_time_ns: int
    process: str
    level: int
    text: str

    @property
    def name(self) -> str:
        """Name of the event."""
        return self.text.partition(" ")[0]


class Truths(NamedTuple):
    """True residuals: when, and nm rms over the pupil."""

    log_time_ns: npt.NDArray[np.int64]
    residual_nm: npt.NDArray[np.float64]


@dataclass(slots=True)
class Evidence:
    """What the logs hold.

    Attributes:
        commands: of the controllers, in their order.
        states: of the mirror.
        forged: commands that the case sent.
        steps, events: as named.
        truths: of the camera.
        counts: of what is in each finished log, by the log's number, key and start of the publisher; each is of another
            recorder, which answers for what came while it was there.
        lost: what the recorders say that they lost, by key.
        unreadable: what is wrong with a log.
        last_ns: when the last message of each log was recorded, and whether that log was finished.
        stopped: what each publisher said at its end that it had sent, by the log's number, key and start.
    """

    commands: list[Shape] = field(default_factory=list)
    states: list[Shape] = field(default_factory=list)
    forged: list[Shape] = field(default_factory=list)
    steps: list[Stepped] = field(default_factory=list)
    events: list[Happened] = field(default_factory=list)
    truths: Truths = field(default_factory=lambda: Truths(np.zeros(0, np.int64), np.zeros(0)))
    counts: dict[tuple[int, str, int], set[int]] = field(default_factory=lambda: defaultdict(set))
    lost: dict[str, int] = field(default_factory=dict)
    unreadable: list[str] = field(default_factory=list)
    last_ns: list[tuple[int, bool]] = field(default_factory=list)
    stopped: dict[tuple[int, str, int], int] = field(default_factory=dict)
    messages: int = 0


def read(folder: Path) -> Evidence:
    """Read all logs of a case, in their order."""
    found = Evidence()
    truths: list[tuple[int, float]] = []
    for number, path in enumerate(sorted(folder.glob("*.mcap*"))):
        reader = LogReader(path)
        last_ns = 0
        try:
            for message in reader:
                last_ns = message.log_time_ns
                found.messages += 1
                _enter(found, message, number if reader.finished else None, truths)
        except DataFileError as fault:
            found.unreadable.append(str(fault))
        found.last_ns.append((last_ns, reader.finished))
        for name, value in reader.metadata.get("recording", {}).items():
            word, _, key = name.partition(" ")
            if word == "lost":
                found.lost[key] = found.lost.get(key, 0) + int(value)
    if truths:
        times, residuals = zip(*truths, strict=True)
        found.truths = Truths(np.array(times, np.int64), np.array(residuals))
    return found


def _enter(found: Evidence, message: Logged, number: int | None, truths: list[tuple[int, float]]) -> None:
    start_s = start_of(message.sequence)
    if number is not None and message.key != EVENT.key:  # all publish there, and their counts do not tell them apart
        found.counts[number, message.key, start_s].add(count_of(message.sequence))
    try:
        _decode(found, message, start_s, number, truths)
    except DecodeError:
        if start_s > FORGED_S and message.key != FRAME.key:
            found.unreadable.append(f"a message on {message.key} that the case did not send cannot be read")


def _decode(
    found: Evidence, message: Logged, start_s: int, number: int | None, truths: list[tuple[int, float]]
) -> None:
    key, when_ns = message.key, message.log_time_ns
    if COMMAND.matches(key):
        command = wire.MirrorCommand.FromString(message.payload)
        shape = actuators(command)
        if shape is not None:
            sent = Shape(message.sequence, when_ns, command.taken, command.frame_sequence, shape)
            (found.forged if start_s <= FORGED_S else found.commands).append(sent)
    elif start_s <= FORGED_S:
        return
    elif MIRROR_STATE.matches(key):
        state = wire.MirrorState.FromString(message.payload)
        shape = actuators(state)
        if shape is not None:
            found.states.append(Shape(message.sequence, when_ns, 0, state.frame_sequence, shape))
    elif key == STEP.key:
        step = wire.ControlStep.FromString(message.payload)
        used, reasons = bool(step.error_nm), tuple(step.reasons)
        found.steps.append(
            Stepped(message.sequence, when_ns, step.taken, step.frame_sequence, step.mode, reasons, used)
        )
    elif key == EVENT.key:
        log = Log.FromString(message.payload)
        found.events.append(Happened(when_ns, log.name, log.level, log.message))
    elif key == TRUTH.key:
        truths.append((when_ns, wire.Truth.FromString(message.payload).residual_rms_nm))
    elif HEALTH.matches(key):
        health = wire.Health.FromString(message.payload)
        for count in health.topics:
            if count.published and health.state == "stopped" and number is not None:
                found.stopped[number, count.topic, start_s] = count.published


def residual_nm(truths: Truths, begin_ns: int, end_ns: int) -> float:
    """Root mean square of the true residual between two times; NaN where there is none."""
    within = truths.residual_nm[(truths.log_time_ns >= begin_ns) & (truths.log_time_ns < end_ns)]
    return float(np.sqrt(np.mean(within**2))) if within.size else float("nan")


def gaps(counts: dict[tuple[int, str, int], set[int]]) -> Iterator[tuple[str, int]]:
    """How many messages between those of a log are not there, by key: a line for each start of a publisher."""
    for (_, key, start_s), there in counts.items():
        if start_s > FORGED_S:
            missing = max(there) - min(there) + 1 - len(there)
            if missing:
                yield key, missing
