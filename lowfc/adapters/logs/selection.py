"""What a recording leaves out on purpose: all but every Nth frame and mirror state, and topics that were not asked for.

Steps, commands, requests, events, health, calibrations and states are always whole.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

from google.protobuf.message import DecodeError

from lowfc.contract.envelope import count_of
from lowfc.contract.errors import ConfigurationError, nearest
from lowfc.contract.messages import FRAME, MIRROR_STATE, TOPICS, Topic, wire

SELECTION = "selection"
"""Name of the metadata with what was left out; a log without it has everything."""

_FEWER = {FRAME: "frames", MIRROR_STATE: "mirror states"}
"""Topics of which every Nth message is recorded."""


@dataclass(frozen=True, slots=True)
class Selection:
    """What is recorded.

    Attributes:
        every: of frames and mirror states, those whose frame number is a multiple of this.
        left_out: topics of which nothing is recorded; only such as are `optional`.
    """

    every: int = 1
    left_out: frozenset[Topic] = frozenset()

    @classmethod
    def of(cls, metadata: Mapping[str, Mapping[str, str]]) -> "Selection":
        """Selection of a log, by the metadata at its start; everything where that cannot be read."""
        entries = metadata.get(SELECTION, {})
        every, keys = entries.get("every", ""), entries.get("left_out", "").split()
        return cls(
            max(1, int(every)) if re.fullmatch("[0-9]{1,9}", every) else 1,
            frozenset(topic for topic in TOPICS if topic.key in keys),
        )

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """For the start of a log; nothing where everything is recorded."""
        if self == EVERYTHING:
            return {}
        return {SELECTION: {"every": str(self.every), "left_out": " ".join(self._keys)}}

    @property
    def sentence(self) -> str:
        """Description of the selection for people; empty for everything."""
        few = [name for topic, name in _FEWER.items() if topic not in self.left_out]
        parts = [f"1 in {self.every} {' and '.join(few)}"] if self.every > 1 and few else []
        parts += [f"without {', '.join(self._keys)}"] if self.left_out else []
        return ", ".join(parts)

    @property
    def has_every_frame(self) -> bool:
        """Whether no frame is left out."""
        return self.every == 1 and FRAME not in self.left_out

    def records_all(self, topic: Topic) -> bool:
        """Whether every message of a topic is recorded, so that a gap in its counts is a loss."""
        return topic not in self.left_out and not (self.every > 1 and topic in _FEWER)

    def keeps(self, topic: Topic, sequence: int, payload: bytes) -> bool:
        """Whether a message is recorded.

        The camera's frame number decides for the frame and for the mirror state that followed it, so that they join.
        """
        if topic in self.left_out:
            return False
        if self.every == 1 or topic not in _FEWER:
            return True
        if topic is MIRROR_STATE:
            try:
                sequence = wire.MirrorState.FromString(payload).frame_sequence
            except DecodeError:
                return True  # it is in the log as it came
        return count_of(sequence) % self.every == 0

    def within(self, other: "Selection") -> "Selection":
        """What is left of a log of this selection when another is made of it."""
        return Selection(math.lcm(self.every, other.every), self.left_out | other.left_out)

    @property
    def _keys(self) -> list[str]:
        return sorted(topic.key for topic in self.left_out)


EVERYTHING = Selection()


def selection(every: int = 1, patterns: Iterable[str] = ()) -> Selection:
    """Selection of what is asked for.

    Args:
        every: record each Nth frame and mirror state.
        patterns: keys or shell patterns of the optional topics to record; all of them where there are none.

    Raises:
        ConfigurationError: a pattern fits no topic.
    """
    wanted: set[Topic] = set()
    for pattern in (given.removeprefix("/") for given in patterns):
        fitting = {topic for topic in TOPICS if topic.matches(pattern) or fnmatchcase(topic.key, pattern)}
        if not fitting:
            keys = [topic.key for topic in TOPICS]
            raise ConfigurationError(
                f"no topic fits {pattern!r}{nearest(pattern, keys)}; give a key or a shell pattern, such as "
                "'lowfc/camera/*'"
            )
        wanted |= fitting
    return Selection(every, frozenset(topic for topic in TOPICS if topic.optional and wanted and topic not in wanted))
