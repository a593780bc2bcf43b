"""Detection of gaps in a publisher's sequence; a late message closes its gap."""

from lowfc.contract.envelope import count_of, start_of

REMEMBERED = 4096
"""Range of counts below the newest in which late messages are distinguished from duplicates."""


class Gaps:
    """Finds gaps in the counts of the messages from one start of a publisher, from the first received message on.

    Attributes:
        first: count of the first message.
        next: highest count plus 1.
        missing: number of missing messages between `first` and `next`, plus that of former starts.
    """

    def __init__(self, first: int, missing: int = 0) -> None:
        """Begin with the count of the first message; `missing` is the number of messages missing from former starts."""
        self.first = self.next = first
        self.missing = missing
        self._open: set[int] = set()

    def add(self, count: int) -> bool:
        """Count a message; return whether it is new, as far as known."""
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
    """Counts the received messages of a key.

    Attributes:
        key: key of the messages.
        received: number of received messages.
        last_sequence: sequence of the newest message.
    """

    def __init__(self, key: str = "") -> None:
        self.key = key
        self.received = self.last_sequence = 0
        self._gaps = Gaps(0)

    @property
    def missing(self) -> int:
        """Number of messages that never arrived, from gaps in the sequences of each start of the publisher."""
        return self._gaps.missing

    @property
    def skipped(self) -> int:
        """Number of received messages that were not processed; 0 unless a subclass skips messages."""
        return 0

    def count(self, sequence: int) -> None:
        """Count a received message by its sequence."""
        if sequence == self.last_sequence + 1 and self.received and count_of(sequence):  # the usual case in the loop
            self.last_sequence = sequence
            self._gaps.next += 1
            self.received += 1
            return
        count, start_s, newest_s = count_of(sequence), start_of(sequence), start_of(self.last_sequence)
        if start_s > newest_s or not self.received:
            self._gaps, newest_s = Gaps(count, self._gaps.missing), start_s
        if start_s == newest_s:
            self._gaps.add(count)
        self.last_sequence = max(sequence, self.last_sequence)
        self.received += 1
