"""A clock that stands still until a test advances it."""

from lowfc.adapters.process.clock import SIMULATED_START_NS, HostClock

_NS = 1_000_000_000


class FakeClock(HostClock):
    """Clock for tests: host time and run time are the same, and only `advance` and `sleep_until_ns` change it."""

    offset_ns = 0

    def __init__(self, start_ns: int = SIMULATED_START_NS, *, lockstep: bool = False) -> None:
        self.lockstep = lockstep
        self.time_ns = start_ns
        self.start_s = start_ns // _NS

    def host_ns(self) -> int:
        """Present time."""
        return self.time_ns

    now_ns = host_ns

    def ahead_ns(self) -> int:
        """Return 0: there is no separate wall clock."""
        return 0

    def advance(self, duration_ns: int) -> None:
        """Advance the time."""
        self.time_ns += duration_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Advance the time to the deadline."""
        self.time_ns = max(self.time_ns, deadline_ns)
