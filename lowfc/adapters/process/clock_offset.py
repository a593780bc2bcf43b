"""Offset between two hosts' clocks, measured as NTP does: by the shortest of recent round trips.

The other clock was read between query and receipt. Half-way is the best estimate, and half the round trip the largest
error, whatever the network does; so the shortest round trip is the best.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

RECENT = 16
"""Exchanges that are compared, 8 s of them: two clocks drift apart by some 0.1 ms in that time at the most."""
AT_ONCE = 8
"""Exchanges before the first message is sent."""
PERIOD_S = 0.5


class Exchange(NamedTuple):
    """One query and its answer: what to add to this host's clock to have the other's, wrong by half the round trip."""

    offset_ns: int
    round_trip_ns: int


class ClockOffset:
    """The other clock's offset, by the best of recent exchanges, None before the first."""

    def __init__(self) -> None:
        self.best: Exchange | None = None
        self._recent: deque[Exchange] = deque(maxlen=RECENT)

    @property
    def offset_ns(self) -> int:
        """To be added to this host's clock to have the other's; 0 until it is known."""
        best = self.best
        return 0 if best is None else best.offset_ns

    def exchanged(self, asked_ns: int, theirs_ns: int, answered_ns: int) -> None:
        """Add one exchange: this host's clock at question and answer, and the other's when it answered."""
        self._recent.append(Exchange(theirs_ns - (asked_ns + answered_ns) // 2, answered_ns - asked_ns))
        self.best = min(self._recent, key=lambda exchange: exchange.round_trip_ns)


class ClockAsker:
    """Queries another host's time, several times at once and then periodically, on a thread of its own."""

    def __init__(
        self, offset: ClockOffset, ask: Callable[[], Sequence[tuple[int, int]]], host_ns: Callable[[], int]
    ) -> None:
        """Measure the offset, if the other host answers.

        Args:
            offset: gets the exchanges.
            ask: queries the other; returns its time at the answer, less the offset known, and this host's at receipt.
            host_ns: this host's clock.
        """
        self._offset = offset
        self._ask = ask
        self._host_ns = host_ns
        self._ended = threading.Event()
        for _ in range(AT_ONCE):
            if not self._exchange():
                break
        self._thread = threading.Thread(target=self._go_on, name="clock-offset", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the queries."""
        self._ended.set()
        self._thread.join()

    def _go_on(self) -> None:
        while not self._ended.wait(PERIOD_S):
            self._exchange()

    def _exchange(self) -> bool:
        asked_ns = self._host_ns()
        answers = self._ask()
        for theirs_ns, answered_ns in answers:
            self._offset.exchanged(asked_ns, theirs_ns + self._offset.offset_ns, answered_ns)
        return bool(answers)
