"""Contents of the logs of a chaos case, read and decoded once for all rules."""

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.reader import LogReader
from lowfc.arrays import Array, Long, Single
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import COMMAND, EVENT, HEALTH, MIRROR_STATE, STEP, TRUTH, Topic, known_topic
from lowfc.contract.sequence_gaps import Gaps

FORGED_S = 1
"""Start time, Unix seconds, in the sequence of injected messages: in 1970, when no process of a run started."""
DECODED = (COMMAND, MIRROR_STATE, STEP, EVENT, TRUTH, HEALTH)
_NONE = np.zeros((0, 0), np.float32)


class Entry(NamedTuple):
    """A decoded message of the loop's processes.

    Attributes:
        sequence: sequence of the message, with the start time of its publisher.
        log_time_ns: time at which the message was recorded.
        message: decoded message.
        actuators_nm: actuators of a command or mirror state, nm of surface; otherwise empty.
    """

    sequence: int
    log_time_ns: int
    message: Any
    actuators_nm: Single = _NONE

    @property
    def start_s(self) -> int:
        """Start time of the message's publisher, Unix seconds."""
        return start_of(self.sequence)

    @property
    def frame(self) -> int:
        """Number of the frame of a step, counted from the camera's start."""
        return count_of(self.message.frame_sequence)


@dataclass(slots=True)
class Evidence:
    """Contents of the logs.

    Attributes:
        entries: messages of each topic of `DECODED`, in the order of the logs.
        received: message counts in each finished log, by number of the log, key and start of the publisher. Each log is
            by another recorder, and a recorder counts losses only while it runs.
        sent: number of messages that each publisher reported at its end as sent, by the same keys as `received`.
        lost: number of messages that the recorders report as lost, by key.
        unreadable: errors of logs and messages that cannot be read.
        log_ends: time of the last message of each log, ns, and whether the log was finished.
        messages: number of messages in all logs.
    """

    entries: dict[Topic, list[Entry]] = field(default_factory=lambda: {topic: [] for topic in DECODED})
    received: dict[tuple[int, str, int], Gaps] = field(default_factory=dict)
    sent: dict[tuple[int, str, int], int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    unreadable: list[str] = field(default_factory=list)
    log_ends: list[tuple[int, bool]] = field(default_factory=list)
    messages: int = 0

    def residuals_nm(self) -> tuple[Long, Array]:
        """True residuals: their log times, ns, and values, nm rms over the pupil."""
        truths = self.entries[TRUTH]
        times_ns = np.array([truth.log_time_ns for truth in truths], np.int64)
        return times_ns, np.array([truth.message.residual_rms_nm for truth in truths], np.float64)

    def residual_nm(self, begin_ns: int, end_ns: int) -> float:
        """True residual between two log times, root mean square, nm; NaN without data."""
        times_ns, residuals_nm = self.residuals_nm()
        within = residuals_nm[(times_ns >= begin_ns) & (times_ns < end_ns)]
        return float(np.sqrt(np.mean(within**2))) if within.size else float("nan")


def read(folder: Path) -> Evidence:
    """Read all logs of a case, in the order of their names."""
    evidence = Evidence()
    for number, path in enumerate(sorted(folder.glob("*.mcap*"))):
        reader, last_ns = LogReader(path), 0
        try:
            for message in reader:
                last_ns = message.receive_time_ns
                _add(evidence, message, number if reader.finished else None)
        except DataFileError as fault:
            evidence.unreadable.append(str(fault))
        evidence.log_ends.append((last_ns, reader.finished))
        for name, value in reader.metadata.get("recording", {}).items():
            quantity, _, key = name.partition(" ")
            if quantity == "lost":
                evidence.lost[key] += int(value)
    return evidence


def _add(evidence: Evidence, message: Sample, log_number: int | None) -> None:
    """Add a message; `log_number` is None if its log is unfinished."""
    evidence.messages += 1
    start_s, count = start_of(message.sequence), count_of(message.sequence)
    if start_s <= FORGED_S:
        return
    if log_number is not None and message.key != EVENT.key:  # all processes publish events: the publisher is ambiguous
        evidence.received.setdefault((log_number, message.key, start_s), Gaps(count)).add(count)
    topic = known_topic(message.key)
    if topic is None or topic not in DECODED:
        return
    try:
        decoded: Any = topic.message.FromString(message.payload)
    except DecodeError:
        evidence.unreadable.append(f"a message on {message.key} that the case did not send cannot be read")
        return
    shape = actuators(decoded) if topic in (COMMAND, MIRROR_STATE) else _NONE
    if shape is not None:
        evidence.entries[topic].append(Entry(message.sequence, message.receive_time_ns, decoded, shape))
    elif topic is COMMAND or decoded.actuators:  # a mirror that does not know its shape reports no actuators
        evidence.unreadable.append(f"a message on {message.key} has {len(decoded.actuators)} bytes of actuators")
    if topic is HEALTH and decoded.state == "stopped" and log_number is not None:
        evidence.sent |= {(log_number, one.topic, start_s): one.published for one in decoded.topics if one.published}
