"""Time: nanoseconds since the epoch, without steps, the same for all processes of a user on a host.

The host's clock is CLOCK_MONOTONIC plus an offset that the first process after a boot stores in the user's runtime
directory, in a file named after the boot. In lockstep the time of messages is simulated; envelopes keep the
host's time, so that latencies can be measured.
"""

import time
from pathlib import Path

from lowfc.adapters.bus.run import runtime_base, runtime_path, write_once
from lowfc.contract.errors import DataFileError, raised_as

SIMULATED_START_NS = 1_767_225_600_000_000_000
"""2026-01-01T00:00:00Z, the start of every lockstep run."""

WALL_TOLERANCE_NS = 100_000_000
"""Largest difference from the wall clock without an event; beyond it the wall clock was set after the offset."""

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_NS = 1_000_000_000


class HostClock:
    """The host's clock: CLOCK_MONOTONIC plus this boot's offset.

    Attributes:
        lockstep: whether the time is simulated and set explicitly.
        start_s: Unix time (simulated in lockstep) of the process's start, s; the upper 32 bits of its sequences.
        offset_ns: offset to add to CLOCK_MONOTONIC to get the time since the epoch.
    """

    lockstep = False

    def __init__(self, base: Path | None = None) -> None:
        """Use this boot's clock offset, stored in the folder `base` (by default the user's runtime directory)."""
        self.offset_ns = boot_offset_ns(runtime_base() if base is None else base)
        self.start_s = self.now_ns() // _NS

    def host_ns(self) -> int:
        """Time of the host, for envelopes and durations; `now_ns`, the run's time, differs only in lockstep."""
        return time.monotonic_ns() + self.offset_ns

    now_ns = host_ns

    def ahead_ns(self) -> int:
        """Present lead over the wall clock, ns."""
        return self.host_ns() - time.time_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until `deadline_ns`; return at once if it has passed."""
        while (left_ns := deadline_ns - self.now_ns()) > 0:
            time.sleep(left_ns * 1e-9)


Clock = HostClock
"""The clock of any process; in lockstep a `SimulatedClock`."""


class SimulatedClock(HostClock):
    """Clock of a lockstep run, constant until it is set; the host's time stays available."""

    lockstep = True

    def __init__(self, start_ns: int = SIMULATED_START_NS, base: Path | None = None) -> None:
        self._now_ns = start_ns
        super().__init__(base)

    def now_ns(self) -> int:
        """Simulated time, nanoseconds since the epoch."""
        return self._now_ns

    def set_ns(self, now_ns: int) -> None:
        """Set the clock."""
        self._now_ns = now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Advance the clock to the deadline, without waiting."""
        self._now_ns = max(self._now_ns, deadline_ns)


def boot_file(base: Path | None = None) -> Path:
    """File of this boot's offset, by default in the user's runtime directory; it may not exist yet."""
    return (runtime_path() if base is None else base) / f"clock-{_BOOT_ID.read_text().strip()}"


def boot_offset_ns(base: Path) -> int:
    """Offset to add to CLOCK_MONOTONIC to get the time since the epoch, ns; the first call since the boot stores it.

    DataFileError if the offset's file in `base` is damaged, or cannot be read or made.
    """
    path = boot_file(base)
    with raised_as(DataFileError, OSError, f"{path} cannot be read or made"):
        text = write_once(path, str(time.time_ns() - time.monotonic_ns()))
    try:
        return int(text)
    except ValueError:
        raise DataFileError(
            f"{path} should hold this boot's clock offset in ns, got {text[:40]!r}; stop all lowfc processes, remove "
            "this file and start them again"
        ) from None
