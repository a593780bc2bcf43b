"""Offset between two hosts' clocks, from the shortest of recent round trips, as in NTP.

The other clock is read between query and receipt of the answer. The estimate assumes that it is read in the middle, so
the error is at most half the round trip, and the exchange with the shortest round trip is the best.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

RECENT = 16
"""Number of compared exchanges: those of 8 s, in which two clocks drift apart by at most about 0.1 ms."""
FIRST_EXCHANGES = 8
"""Number of exchanges before the first message is sent."""
PERIOD_S = 0.5  # between two exchanges


class Exchange(NamedTuple):
    """One query with its answer: the offset to add to this host's time to get the other's, and the round trip."""

    offset_ns: int
    round_trip_ns: int


class ClockOffset:
    """Offset of the other clock; `best` is the best recent exchange, None before the first exchange."""

    def __init__(self) -> None:
        self.best: Exchange | None = None
        self._recent: deque[Exchange] = deque(maxlen=RECENT)

    @property
    def offset_ns(self) -> int:
        """Offset to add to this host's time to get the other's; 0 until it is known."""
        best = self.best
        return 0 if best is None else best.offset_ns

    def add_exchange(self, queried_ns: int, other_ns: int, received_ns: int) -> None:
        """Add one exchange: this host's times of query and receipt, and the other host's time in its answer."""
        new = Exchange(other_ns - (queried_ns + received_ns) // 2, received_ns - queried_ns)
        change_ns = abs(new.offset_ns - self.offset_ns) - 1_000_000  # 1 ms, ten times the drift, is allowed
        if self.best is not None and change_ns > (new.round_trip_ns + self.best.round_trip_ns) // 2:
            self._recent.clear()  # the other clock was set, as after a reboot of its host
        self._recent.append(new)
        self.best = min(self._recent, key=lambda exchange: exchange.round_trip_ns)


class ClockQuerier:
    """Queries another host's time: several times at the start, then periodically on its own thread."""

    def __init__(
        self, offset: ClockOffset, query: Callable[[], Sequence[tuple[int, int]]], host_ns: Callable[[], int]
    ) -> None:
        """Measure the offset, if the other host answers.

        Args:
            offset: receives the exchanges.
            query: queries the other host; returns for each answer the other host's time minus the present estimate in
                `offset`, and this host's time at receipt.
            host_ns: this host's clock.
        """
        self._offset = offset
        self._query = query
        self._host_ns = host_ns
        self._ended = threading.Event()
        for _ in range(FIRST_EXCHANGES):
            if not self._exchange():
                break
        self._thread = threading.Thread(target=self._run, name="clock-offset", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the queries."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(PERIOD_S):
            self._exchange()

    def _exchange(self) -> bool:
        queried_ns = self._host_ns()
        answers = self._query()
        for corrected_ns, received_ns in answers:
            self._offset.add_exchange(queried_ns, corrected_ns + self._offset.offset_ns, received_ns)
        return bool(answers)
