"""Selection of what is recorded: every Nth frame and mirror state, and the requested optional topics.

Steps, commands, requests, events, health, calibrations, and the states of camera and controller are always complete.
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
"""Name of the metadata with the selection; in a log without this metadata, everything is selected."""

_DECIMATED = {FRAME: "frames", MIRROR_STATE: "mirror states"}
"""Topics of which every Nth message is recorded."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Selection of recorded messages.

    Attributes:
        interval_frames: frames and mirror states are recorded if their frame number is a multiple of this.
        excluded: topics that are not recorded; only `optional` ones.
    """

    interval_frames: int = 1
    excluded: frozenset[Topic] = frozenset()

    @classmethod
    def of(cls, metadata: Mapping[str, Mapping[str, str]]) -> "Selection":
        """Selection of a log, from the metadata at its start; everything if these have no readable selection."""
        entries = metadata.get(SELECTION, {})
        interval, keys = entries.get("every", ""), entries.get("left_out", "").split()
        return cls(
            max(1, int(interval)) if re.fullmatch("[0-9]{1,9}", interval) else 1,
            frozenset(topic for topic in TOPICS if topic.key in keys),
        )

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata record of the selection, for the start of a log; empty if everything is recorded."""
        if self == EVERYTHING:
            return {}
        return {SELECTION: {"every": str(self.interval_frames), "left_out": " ".join(self._keys)}}

    @property
    def description(self) -> str:
        """Description of the selection, in words; empty if everything is recorded."""
        names = [name for topic, name in _DECIMATED.items() if topic not in self.excluded]
        parts = [f"1 in {self.interval_frames} {' and '.join(names)}"] if self.interval_frames > 1 and names else []
        parts += [f"without {', '.join(self._keys)}"] if self.excluded else []
        return ", ".join(parts)

    @property
    def has_every_frame(self) -> bool:
        """Whether every frame is recorded."""
        return self.interval_frames == 1 and FRAME not in self.excluded

    def records_all(self, topic: Topic) -> bool:
        """Whether every message of a topic is recorded, so that a gap in its counts is a loss."""
        return topic not in self.excluded and not (self.interval_frames > 1 and topic in _DECIMATED)

    def keeps(self, topic: Topic, sequence: int, payload: bytes) -> bool:
        """Whether a message is recorded.

        Frames and mirror states are selected by the same frame number, so that they stay paired.
        """
        if topic in self.excluded:
            return False
        if self.interval_frames == 1 or topic not in _DECIMATED:
            return True
        if topic is MIRROR_STATE:
            try:
                sequence = wire.MirrorState.FromString(payload).frame_sequence
            except DecodeError:
                return True  # record an unreadable message unchanged
        return count_of(sequence) % self.interval_frames == 0

    def within(self, other: "Selection") -> "Selection":
        """This selection, applied to a log that was recorded with `other`."""
        return Selection(math.lcm(self.interval_frames, other.interval_frames), self.excluded | other.excluded)

    @property
    def _keys(self) -> list[str]:
        return sorted(topic.key for topic in self.excluded)


EVERYTHING = Selection()


def selection(interval_frames: int = 1, patterns: Iterable[str] = ()) -> Selection:
    """Make a selection from options.

    Args:
        interval_frames: N, if every Nth frame and mirror state is recorded.
        patterns: keys or shell patterns of the optional topics to record; empty: all.

    Raises:
        ConfigurationError: a pattern matches no topic.
    """
    chosen: set[Topic] = set()
    for pattern in (text.removeprefix("/") for text in patterns):
        name = (pattern.split("/")[2:3] or [""])[0]  # a mirror's name is third, as in lowfc/mirror/dm/*
        matching = {topic for topic in TOPICS if topic.matches(pattern) or fnmatchcase(topic.at(name), pattern)}
        if not matching:
            keys = [topic.key for topic in TOPICS]
            raise ConfigurationError(
                f"no topic matches {pattern!r}{nearest(pattern, keys)}; give a key or a shell pattern, such as "
                "'lowfc/camera/*'"
            )
        chosen |= matching
    excluded = frozenset(topic for topic in TOPICS if topic.optional and chosen and topic not in chosen)
    return Selection(interval_frames, excluded)
