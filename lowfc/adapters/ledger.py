"""The account of a recording: which messages there were, and which of them are missing."""

from collections.abc import Callable
from dataclasses import dataclass

from google.protobuf.message import DecodeError

from lowfc.adapters.bus import Sample
from lowfc.adapters.envelope import count_of, start_of
from lowfc.adapters.gaps import Gaps
from lowfc.contract.messages import EVENT, HEALTH, Log, Topic, topic_of, wire


@dataclass(slots=True)
class _Tally:
    """Messages of one topic of one start of one publisher; counts as in their envelopes.

    Attributes:
        published: by its own last word, in which one that it sent twice is two.
        twice: of those recorded, messages that had come before.
        safe: recorded, and twice, flushed since.
    """

    gaps: Gaps
    published: int = 0
    recorded: int = 0
    twice: int = 0
    safe: tuple[int, int] = (0, 0)
    reported: int = 0

    @property
    def lost(self) -> int:
        return max(self.gaps.next + self.twice, self.published) - self.gaps.first - self.recorded

    def enter(self, count: int, *, recorded: bool) -> None:
        if count >= self.gaps.first:
            new = self.gaps.came(count)
            self.recorded += recorded
            self.twice += recorded and not new


class Ledger:
    """Which messages there were: by the counts of those that arrived, and by what their publishers say they sent."""

    def __init__(self) -> None:
        self._tallies: dict[tuple[str, str, int], _Tally] = {}

    def enter(self, topic: Topic, sample: Sample, *, recorded: bool) -> None:
        """Account for a message; the first one of a publisher's start is its beginning."""
        count = count_of(sample.sequence)
        line = (sample.key, _author(topic, sample), start_of(sample.sequence))
        tally = self._tallies.get(line)
        if tally is None:
            tally = self._tallies[line] = _Tally(Gaps(count))
        tally.enter(count, recorded=recorded)

    def believe(self, sample: Sample, health: wire.Health) -> None:
        """Take over what a publisher says it sent; what it sent before it was first heard does not count as lost."""
        for count in health.topics:
            if _publishes(health.process, count.topic):
                author = health.process if count.topic == EVENT.key else ""
                line = (count.topic, author, start_of(sample.sequence))
                tally = self._tallies.setdefault(line, _Tally(Gaps(count.published)))
                if health.state == "stopped":
                    tally.published = count.published

    def settle(self) -> None:
        """What was recorded so far has been flushed."""
        for tally in self._tallies.values():
            tally.safe = tally.recorded, tally.twice

    def revert(self) -> None:
        """What was recorded since `settle` did not reach the disk."""
        for tally in self._tallies.values():
            tally.recorded, tally.twice = tally.safe

    def recorded(self) -> dict[str, int]:
        """Messages recorded so far, by key; keys that lost all of theirs too."""
        sums: dict[str, int] = {}
        for (key, _, _), tally in self._tallies.items():
            sums[key] = sums.get(key, 0) + tally.recorded
        return sums

    def lost(self) -> dict[str, int]:
        """Messages lost so far, by key; only keys that lost some."""
        return self._sum(lambda tally: tally.lost)

    def news(self) -> dict[str, int]:
        """Messages lost since this was asked last, by key; one that comes late after all is not taken back."""
        found = self._sum(lambda tally: max(0, tally.lost - tally.reported))
        for tally in self._tallies.values():
            tally.reported = max(tally.reported, tally.lost)
        return found

    def _sum(self, number: Callable[[_Tally], int]) -> dict[str, int]:
        sums: dict[str, int] = {}
        for (key, _, _), tally in self._tallies.items():
            if number(tally):
                sums[key] = sums.get(key, 0) + number(tally)
        return sums


def _publishes(process: str, key: str) -> bool:
    """Whether a process's count is of a topic that it publishes, and not of one that it receives."""
    try:
        topic = topic_of(key)
        return key == HEALTH.at(process) if topic is HEALTH else process.partition("-")[0] in topic.publisher
    except KeyError:
        return False


def _author(topic: Topic, sample: Sample) -> str:
    """Who published on a topic that all share, where equal starts do not tell; elsewhere nothing."""
    if topic is not EVENT:
        return ""
    try:
        return Log.FromString(sample.payload).name
    except DecodeError:
        return "?"
