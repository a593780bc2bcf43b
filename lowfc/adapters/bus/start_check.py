"""Refusal of sequences whose start is too far in the future: after such a one, valid ones would seem out of order."""

from collections.abc import Callable
from datetime import UTC, datetime

from lowfc.adapters.process.clock import Clock
from lowfc.contract.envelope import sequence_of, start_of

_HOUR_S = 3600
_NS = 1_000_000_000


class StartCheck:
    """Compares the start in received sequences with this host's clock."""

    def __init__(self, clock: Clock, max_ahead_h: float, refused: Callable[..., None]) -> None:
        """Refuse starts more than `max_ahead_h` hours ahead of `clock`; 0 or a simulated clock disables the check.

        `refused` is called for each new refused start, at most once a second, with `start` (the refused start) and
        `here` (this host's time), both UTC.
        """
        self._clock = clock
        self._ahead_s = round(max_ahead_h * _HOUR_S)
        self._refused = refused
        self._reported_start_s = self._reported_at_s = 0
        self._enabled = max_ahead_h > 0 and not clock.lockstep
        self._first_refused = 0

    def ahead(self, sequence: int) -> bool:
        """Whether the start in this sequence is too far ahead of the clock."""
        if sequence < self._first_refused or not self._enabled:  # this bound only increases, as time does
            return False
        now_s = self._clock.host_ns() // _NS
        self._first_refused = sequence_of(now_s + self._ahead_s + 1, 0)
        if sequence < self._first_refused:
            return False
        start_s = start_of(sequence)
        if start_s != self._reported_start_s and now_s != self._reported_at_s:  # a faulty sender must not fill the log
            self._reported_start_s, self._reported_at_s = start_s, now_s
            self._refused(start=_utc(start_s), here=_utc(now_s))
        return True


def _utc(time_s: int) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
