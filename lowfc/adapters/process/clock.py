"""Time: nanoseconds since the epoch that never step, shared by all processes of a host.

The host's clock is CLOCK_MONOTONIC plus an offset that is fixed once per boot by whichever process comes first, and
kept in the per-user runtime directory in a file named after the boot. In lockstep the time of the messages is
simulated; envelopes keep the host's time, so that latencies stay measurable.
"""

import time
from pathlib import Path
from typing import Protocol

from lowfc.adapters.bus.run import runtime_base, runtime_path, write_once
from lowfc.contract.errors import DataFileError

SIMULATED_START_NS = 1_767_225_600_000_000_000
"""2026-01-01T00:00:00Z, where every lockstep run starts."""

WALL_TOLERANCE_NS = 100_000_000
"""Difference from the wall clock above which it is reported: it was wrong when the offset of this boot was fixed."""

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_NS = 1_000_000_000


class Clock(Protocol):
    """Where a process takes its time from.

    Attributes:
        lockstep: the time is simulated and moved by hand.
        start_s: unix seconds of the process's start, the upper half of its sequences.
        offset_ns: what CLOCK_MONOTONIC is short of the epoch.
    """

    lockstep: bool
    start_s: int
    offset_ns: int

    def now_ns(self) -> int:
        """Time of the run, nanoseconds since the epoch."""
        ...

    def host_ns(self) -> int:
        """Time of the host, for envelopes and durations; the same as `now_ns` unless in lockstep."""
        ...

    def ahead_ns(self) -> int:
        """By how much the host's time is ahead of its wall clock, now."""
        ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return when `now_ns` has reached the deadline."""
        ...


class HostClock:
    """The host's clock: CLOCK_MONOTONIC plus this boot's offset; see `Clock`."""

    lockstep = False

    def __init__(self, base: Path | None = None) -> None:
        """Join this boot's clock, kept in the folder `base` (by default the user's runtime directory)."""
        self.offset_ns = boot_offset_ns(runtime_base() if base is None else base)
        self.start_s = self.now_ns() // _NS

    def host_ns(self) -> int:
        """Time of the host."""
        return time.monotonic_ns() + self.offset_ns

    now_ns = host_ns

    def ahead_ns(self) -> int:
        """By how much it is ahead of the wall clock, now."""
        return self.host_ns() - time.time_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until `deadline_ns`; returns at once when it has passed."""
        while (left_ns := deadline_ns - self.now_ns()) > 0:
            time.sleep(left_ns * 1e-9)


class SimulatedClock(HostClock):
    """The clock of a lockstep run: it stands still until it is set; the host's time stays available."""

    lockstep = True

    def __init__(self, start_ns: int = SIMULATED_START_NS, base: Path | None = None) -> None:
        self._now_ns = start_ns
        super().__init__(base)

    def now_ns(self) -> int:
        """Simulated time, nanoseconds since the epoch."""
        return self._now_ns

    def set_ns(self, now_ns: int) -> None:
        """Move the clock."""
        self._now_ns = now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Move the clock to the deadline, without waiting."""
        self._now_ns = max(self._now_ns, deadline_ns)


def boot_file(base: Path | None = None) -> Path:
    """File of this boot's offset, in the user's runtime directory where no other is given; it may not be there yet."""
    return (runtime_path() if base is None else base) / f"clock-{_BOOT_ID.read_text().strip()}"


def boot_offset_ns(base: Path) -> int:
    """Offset of CLOCK_MONOTONIC from the epoch, ns; the first to ask since the host was booted fixes it.

    DataFileError where the file in `base` that keeps it is damaged.
    """
    path = boot_file(base)
    text = write_once(path, str(time.time_ns() - time.monotonic_ns()))
    try:
        return int(text)
    except ValueError:
        raise DataFileError(
            f"{path} should hold this boot's clock offset in ns, got {text[:40]!r}; stop all lowfc processes, remove "
            "it and start them again"
        ) from None
