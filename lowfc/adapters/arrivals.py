"""What came of one publisher's messages: how many arrived, and how many never did."""

from lowfc.adapters.bus import Sample
from lowfc.contract.envelope import start_of


class Arrivals:
    """Counts messages of one publisher as they arrive.

    Attributes:
        key: what they are.
        received: how many arrived.
        missing: messages that never arrived, by gaps in the sequence of one start of the publisher.
        restarts: how often the publisher began anew.
        last_sequence: of the newest message.
    """

    def __init__(self, key: str = "") -> None:
        self.key = key
        self.received = 0
        self.missing = 0
        self.restarts = 0
        self.last_sequence = 0

    @property
    def skipped(self) -> int:
        """Messages that arrived and that nobody looked at."""
        return 0

    def count(self, sample: Sample) -> None:
        """Account for a message that has arrived."""
        sequence, last = sample.sequence, self.last_sequence
        if not self.received:
            self.last_sequence = sequence
        elif sequence > last:
            if start_of(sequence) == start_of(last):
                self.missing += sequence - last - 1
            else:
                self.restarts += 1
            self.last_sequence = sequence
        self.received += 1
