"""Messages received from one publisher, in any order: a late one closes its gap."""

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.envelope import count_of, start_of

REMEMBERED = 4096
"""Counts behind the newest in which a late message is still known from one that came before."""


class Gaps:
    """Counts of the messages of one start of a publisher, from the first that came on.

    Attributes:
        first: of the first message.
        next: after the highest one.
        missing: between the two, those that have not come.
    """

    def __init__(self, first: int, missing: int = 0) -> None:
        """Begin with a message that is about to come; so many of former starts are `missing`."""
        self.first = self.next = first
        self.missing = missing
        self._open: set[int] = set()

    def came(self, count: int) -> bool:
        """Account for a message; whether it is there for the first time, as far as that is known."""
        if count == self.next:
            self.next = count + 1
            return True
        if count in self._open:
            self._open.remove(count)
            self.missing -= 1
            return True
        if count < self.next:
            return False
        self.missing += count - self.next
        self._open.update(range(max(self.next, count - REMEMBERED), count))
        self.next = count + 1
        if len(self._open) > 2 * REMEMBERED:
            self._open = {gap for gap in self._open if gap >= count - REMEMBERED}
        return True


class Arrivals:
    """Counts messages of one publisher as they arrive.

    Attributes:
        key: what they are.
        received: how many arrived.
        last_sequence: of the newest message.
    """

    def __init__(self, key: str = "") -> None:
        self.key = key
        self.received = self.last_sequence = 0
        self._gaps = Gaps(0)

    @property
    def missing(self) -> int:
        """Messages that never arrived, by gaps in the sequence of one start of the publisher."""
        return self._gaps.missing

    @property
    def skipped(self) -> int:
        """Messages that arrived and that nobody looked at."""
        return 0

    def count(self, sample: Sample) -> None:
        """Account for a message that has arrived."""
        sequence = sample.sequence
        if sequence == self.last_sequence + 1 and self.received:  # as nearly all are, in the loop
            self.last_sequence = sequence
            self._gaps.next += 1
            self.received += 1
            return
        count, start_s, newest_s = count_of(sequence), start_of(sequence), start_of(self.last_sequence)
        if start_s > newest_s or not self.received:
            self._gaps, newest_s = Gaps(count, self._gaps.missing), start_s
        if start_s == newest_s:
            self._gaps.came(count)
        self.last_sequence = max(sequence, self.last_sequence)
        self.received += 1
