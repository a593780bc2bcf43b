"""Which messages of one publisher came, whatever their order: a gap is closed when a late one comes."""

REMEMBERED = 4096
"""Counts behind the newest in which a late message is still known from one that came before."""


class Gaps:
    """Counts of the messages of one start of a publisher, from the first that came on.

    Attributes:
        first: of the first message.
        next: after the highest one.
        missing: between the two, those that have not come.
    """

    def __init__(self, first: int) -> None:
        """Begin with a message that is about to come."""
        self.first = self.next = first
        self.missing = 0
        self._open: set[int] = set()

    def came(self, count: int) -> bool:
        """Account for a message; whether it is there for the first time, as far as that is known."""
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
