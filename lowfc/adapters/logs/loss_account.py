"""Account of the messages of a recording: recorded and lost ones, by topic.

A start is one run of a publishing process; the sequences of its messages contain the time of the start.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.names import MAX_NAME_LENGTH, MAX_NAMES, Names
from lowfc.adapters.logs.selection import EVERYTHING, Selection
from lowfc.contract.envelope import COUNT_BITS, count_of, start_of
from lowfc.contract.messages import EVENT, HEALTH, Log, Topic, known_topic, wire
from lowfc.contract.sequence_gaps import Gaps

MAX_STARTS = 8
"""Number of a publisher's newest starts with separate counts; earlier ones are summed."""
_EARLIER = -1  # in place of a start: the sum of the earlier ones
_UNNAMED = "?"


@dataclass(slots=True)
class _Tally:
    """Counts of the messages of one topic from one start of a publisher.

    Attributes:
        gaps: gaps in the received sequences.
        published: number published, or lost by a camera, by the publisher's own count; 0 until it reports that it has
            stopped. A message sent twice counts twice.
        recorded: number recorded.
        duplicates: number of recorded messages that were duplicates.
        never_sent: frames that a camera lost and never sent, according to its Health, less `lost_before`.
        lost_before: frames that the camera had lost by its first Health, assumed to precede the first message; None
            until then.
        last_lost: `lost` at the last call of `newly_lost`.
        flushed: `recorded` and `duplicates` at the last flush.
        reported: number reported as lost by `newly_lost`.
    """

    gaps: Gaps
    published: int = 0
    recorded: int = 0
    duplicates: int = 0
    never_sent: int = 0
    lost_before: int | None = None
    last_lost: int = 0
    flushed: tuple[int, int] = (0, 0)
    reported: int = 0

    @property
    def lost(self) -> int:
        return max(0, self.sent - self.recorded - self.never_sent)

    @property
    def confirmed(self) -> int:
        """Number certainly lost.

        If a camera has lost frames itself, it is at most the `lost` of the previous call of `newly_lost`: a newer gap
        may consist of frames that the camera never sent, which only its next Health reports.
        """
        return min(self.lost, self.last_lost) if self.never_sent else self.lost

    @property
    def sent(self) -> int:
        return max(self.gaps.next + self.duplicates, self.published) - self.gaps.first

    def enter(self, count: int, *, recorded: bool, unwanted: bool) -> None:
        if count >= self.gaps.first:
            new = self.gaps.add(count)
            self.recorded += recorded
            self.duplicates += recorded and not new
            if unwanted:  # never written, so the disk cannot lose it
                self.flushed = self.flushed[0] + 1, self.flushed[1] + (not new)

    def absorb(self, other: "_Tally") -> None:
        self.published += other.sent
        self.recorded += other.recorded
        self.flushed = self.flushed[0] + other.flushed[0], 0
        self.reported += other.reported
        self.never_sent += other.never_sent


class LossAccount:
    """Account of all messages, from the sequences of those that arrived and from the publishers' own counts.

    Attributes:
        names: names (of mirrors, processes, ...) received on each topic; the caller admits a message's name before it
            calls `enter`.
        starts: number of publishers' starts counted so far, over all topics.
    """

    def __init__(self, selection: Selection = EVERYTHING) -> None:
        """Start an empty account; topics that `selection` thins or excludes are not counted."""
        self._selection = selection
        self.names = Names()
        self.starts = 0
        self._authors: set[str] = set()
        self._tallies: dict[tuple[str, str], dict[int, _Tally]] = {}

    def enter(self, topic: Topic, sample: Sample, *, recorded: bool, unwanted: bool = False) -> None:
        """Count a received message; counting begins with the first one received from a publisher's start.

        A message left out of the log on purpose is `unwanted` and counts as recorded.
        """
        if not self._selection.records_all(topic):
            return
        count = count_of(sample.sequence)
        tally = self._tally(sample.key, self._author(topic, sample), start_of(sample.sequence), count)
        tally.enter(count, recorded=recorded or unwanted, unwanted=unwanted)

    def reconcile(self, sample: Sample, health: wire.Health) -> None:
        """Use a publisher's own counts from its Health; losses before its first Health or message do not count.

        Raises:
            BadMessageError: the Health has too many names; its remaining counts are ignored.
        """
        for count in health.topics:
            topic = _published(health.process, count.topic)
            if topic is not None and self._selection.records_all(topic):
                self.names.admit(topic, count.topic)
                author = self._author_name(health.process) if topic is EVENT else ""
                tally = self._tally(count.topic, author, start_of(sample.sequence), count.published)
                if tally.lost_before is None:
                    tally.lost_before = count.missing if tally.gaps.first else 0
                tally.never_sent = count.missing - tally.lost_before
                if health.state == "stopped":
                    tally.published = min(count.published, 1 << COUNT_BITS)  # further ones belong to the next start

    def mark_flushed(self) -> None:
        """Note that everything recorded so far has been flushed."""
        for _, tally in self._all():
            tally.flushed = tally.recorded, tally.duplicates

    def revert(self) -> None:
        """Note that everything recorded since `mark_flushed` was lost."""
        for _, tally in self._all():
            tally.recorded, tally.duplicates = tally.flushed

    def recorded(self) -> dict[str, int]:
        """Number of messages recorded so far, by key, including keys whose messages were all lost."""
        return self._sum(lambda tally: tally.recorded)

    def lost(self) -> dict[str, int]:
        """Number of messages lost so far, by key, without keys that lost none."""
        return +self._sum(lambda tally: tally.lost)

    def newly_lost(self) -> dict[str, int]:
        """Messages lost since the last call, by key; one reported as lost that arrives later cancels the next loss."""
        lost = +self._sum(lambda tally: max(0, tally.confirmed - tally.reported))
        for _, tally in self._all():
            tally.reported = max(tally.reported, tally.confirmed)
            tally.last_lost = tally.lost
        return lost

    def _tally(self, key: str, author: str, start_s: int, first: int) -> _Tally:
        """Tally of a publisher's start; a new tally begins with the count `first`."""
        tallies = self._tallies.setdefault((key, author), {})
        tally = tallies.get(start_s)
        if tally is None:
            if len(separate := tallies.keys() - {_EARLIER}) >= MAX_STARTS:
                tallies.setdefault(_EARLIER, _Tally(Gaps(0))).absorb(tallies.pop(min(separate)))
            tally = tallies[start_s] = _Tally(Gaps(first))
            self.starts += 1
        return tally

    def _all(self) -> Iterator[tuple[str, _Tally]]:
        return ((key, tally) for (key, _), tallies in self._tallies.items() for tally in tallies.values())

    def _sum(self, number: Callable[[_Tally], int]) -> Counter[str]:
        sums: Counter[str] = Counter()
        for key, tally in self._all():
            sums[key] += number(tally)
        return sums

    def _author(self, topic: Topic, sample: Sample) -> str:
        """Publisher of an event, as several publish events and may start in the same second; empty for other topics."""
        if topic is not EVENT:
            return ""
        try:
            return self._author_name(Log.FromString(sample.payload).name)
        except DecodeError:
            return _UNNAMED

    def _author_name(self, author: str) -> str:
        if author not in self._authors:
            if len(author) > MAX_NAME_LENGTH or len(self._authors) >= MAX_NAMES:
                return _UNNAMED
            self._authors.add(author)
        return author


def _published(process: str, key: str) -> Topic | None:
    """Topic of a count in a process's Health if the process publishes it; None otherwise, and for an unknown topic."""
    topic = known_topic(key)
    if topic is None:
        return None
    publishes = key == HEALTH.at(process) if topic is HEALTH else process.partition("-")[0] in topic.publishers
    return topic if publishes else None
