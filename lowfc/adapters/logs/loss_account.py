"""The account of a recording: which messages there were, and which of them are missing."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.names import LONGEST_NAME, MOST_NAMES, Names
from lowfc.adapters.logs.selection import EVERYTHING, Selection
from lowfc.adapters.logs.sequence_gaps import Gaps
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.messages import EVENT, HEALTH, Log, Topic, topic_of, wire

MOST_STARTS = 8
"""Starts of one publisher that are counted apart, the newest; the earlier ones are one sum."""
_EARLIER = -1
_UNNAMED = "?"


@dataclass(slots=True)
class _Tally:
    """Messages of one topic of one start of one publisher; counts as in their envelopes.

    Attributes:
        published: by its own last count, in which one that it sent twice is two.
        twice: of those recorded, messages that had come before.
        never: lost before they could be sent, by its own account: frames of a camera; `before` the first message.
        unconfirmed: lost when news were asked last.
        safe: recorded, and twice, flushed since.
    """

    gaps: Gaps
    published: int = 0
    recorded: int = 0
    twice: int = 0
    never: int = 0
    before: int | None = None
    unconfirmed: int = 0
    safe: tuple[int, int] = (0, 0)
    reported: int = 0

    @property
    def lost(self) -> int:
        return max(0, self.sent - self.recorded - self.never)

    @property
    def confirmed(self) -> int:
        """Of a camera that loses frames: lost at the last call, too, since its own account comes later than a frame."""
        return min(self.lost, self.unconfirmed) if self.never else self.lost

    @property
    def sent(self) -> int:
        return max(self.gaps.next + self.twice, self.published) - self.gaps.first

    def enter(self, count: int, *, recorded: bool, unwanted: bool) -> None:
        if count >= self.gaps.first:
            new = self.gaps.came(count)
            self.recorded += recorded
            self.twice += recorded and not new
            if unwanted:  # the disk cannot lose it
                self.safe = self.safe[0] + 1, self.safe[1] + (not new)

    def absorb(self, other: "_Tally") -> None:
        self.published += other.sent
        self.recorded += other.recorded
        self.safe = self.safe[0] + other.safe[0], 0
        self.reported += other.reported
        self.never += other.never


class LossAccount:
    """Account of all messages, from the counts of those that arrived and from their publishers' own counts.

    Attributes:
        names: on the topics; the caller admits a message's name before it enters the message.
        starts: how many starts of publishers have been counted, of each topic apart.
    """

    def __init__(self, selection: Selection = EVERYTHING) -> None:
        """Nothing has been received; topics of a log that `selection` thins out are not accounted for."""
        self._selection = selection
        self.names = Names()
        self.starts = 0
        self._authors: set[str] = set()
        self._tallies: dict[tuple[str, str], dict[int, _Tally]] = {}

    def enter(self, topic: Topic, sample: Sample, *, recorded: bool, unwanted: bool = False) -> None:
        """Account for a message; the first one of a publisher's start is its beginning.

        One that is left out of the log on purpose counts as recorded, and is `unwanted`.
        """
        if not self._selection.records_all(topic):
            return
        count = count_of(sample.sequence)
        tally = self._tally(sample.key, self._author(topic, sample), start_of(sample.sequence), count)
        tally.enter(count, recorded=recorded or unwanted, unwanted=unwanted)

    def believe(self, sample: Sample, health: wire.Health) -> None:
        """Take over a publisher's own counts; what it sent before its first message arrived does not count as lost.

        Raises:
            BadMessageError: it names what there is no room for; what comes after that is left out.
        """
        for count in health.topics:
            topic = _published(health.process, count.topic)
            if topic is not None and self._selection.records_all(topic):
                self.names.admit(topic, count.topic)
                author = self._known(health.process) if topic is EVENT else ""
                tally = self._tally(count.topic, author, start_of(sample.sequence), count.published)
                if tally.before is None:
                    tally.before = count.missing if tally.gaps.first else 0
                tally.never = count.missing - tally.before
                if health.state == "stopped":
                    tally.published = count.published

    def settle(self) -> None:
        """Everything recorded so far has been flushed."""
        for _, tally in self._all():
            tally.safe = tally.recorded, tally.twice

    def revert(self) -> None:
        """Everything recorded since `settle` was lost before the disk."""
        for _, tally in self._all():
            tally.recorded, tally.twice = tally.safe

    def recorded(self) -> dict[str, int]:
        """Messages recorded so far, by key; keys that lost all of theirs too."""
        sums: dict[str, int] = {}
        for key, tally in self._all():
            sums[key] = sums.get(key, 0) + tally.recorded
        return sums

    def lost(self) -> dict[str, int]:
        """Messages lost so far, by key; only keys that lost some."""
        return self._sum(lambda tally: tally.lost)

    def news(self) -> dict[str, int]:
        """Messages lost since this was asked last, by key; one that comes late after all is not taken back."""
        found = self._sum(lambda tally: max(0, tally.confirmed - tally.reported))
        for _, tally in self._all():
            tally.reported = max(tally.reported, tally.confirmed)
            tally.unconfirmed = tally.lost
        return found

    def _tally(self, key: str, author: str, start_s: int, first: int) -> _Tally:
        """The count of a publisher's start; one that is new begins with the message `first`."""
        tallies = self._tallies.setdefault((key, author), {})
        tally = tallies.get(start_s)
        if tally is None:
            if len(apart := tallies.keys() - {_EARLIER}) >= MOST_STARTS:
                tallies.setdefault(_EARLIER, _Tally(Gaps(0))).absorb(tallies.pop(min(apart)))
            tally = tallies[start_s] = _Tally(Gaps(first))
            self.starts += 1
        return tally

    def _all(self) -> Iterator[tuple[str, _Tally]]:
        return ((key, tally) for (key, _), tallies in self._tallies.items() for tally in tallies.values())

    def _sum(self, number: Callable[[_Tally], int]) -> dict[str, int]:
        sums: dict[str, int] = {}
        for key, tally in self._all():
            if number(tally):
                sums[key] = sums.get(key, 0) + number(tally)
        return sums

    def _author(self, topic: Topic, sample: Sample) -> str:
        """Who published on a topic that all share, where equal starts do not tell; elsewhere nothing."""
        if topic is not EVENT:
            return ""
        try:
            return self._known(Log.FromString(sample.payload).name)
        except DecodeError:
            return _UNNAMED

    def _known(self, author: str) -> str:
        if author not in self._authors:
            if len(author) > LONGEST_NAME or len(self._authors) >= MOST_NAMES:
                return _UNNAMED
            self._authors.add(author)
        return author


def _published(process: str, key: str) -> Topic | None:
    """The topic of a process's count, where it publishes that and does not receive it."""
    try:
        topic = topic_of(key)
    except KeyError:
        return None
    publishes = key == HEALTH.at(process) if topic is HEALTH else process.partition("-")[0] in topic.publisher
    return topic if publishes else None
