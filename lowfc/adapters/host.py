"""What the host is and what it allows, as its kernel tells it: readings, each with its type; others judge them.

A reading raises OSError where there is nothing to read, and ValueError or LookupError where it makes no sense.
"""

import ctypes
import os
import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from lowfc.adapters.usage import used

_CPUS = "sys/devices/system/cpu"
_CPUIDLE = f"{_CPUS}/cpuidle"
_CLOCKSOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"
_NET = "proc/sys/net"
_SHARED = "dev/shm"
_STEAL = 7  # column of /proc/stat; the two after it are counted in the first two already
_STA_UNSYNC, _STA_NANO, _TIME_ERROR = 0x40, 0x2000, 5


class IdleState(NamedTuple):
    """A depth to which an idle processor sleeps.

    Attributes:
        name: as the driver calls it.
        exit_us: the longest that waking from it takes.
        enabled: the kernel may use it.
    """

    name: str
    exit_us: int
    enabled: bool


class Swap(NamedTuple):
    """Swap space.

    Attributes:
        total_bytes: of all devices and files.
        used_bytes: of it.
    """

    total_bytes: int
    used_bytes: int


class SocketBuffers(NamedTuple):
    """Bytes that a socket holds for a slow reader.

    Attributes:
        default_bytes: without being asked for more; the smaller of both directions.
        largest_bytes: that a program may ask for.
        tcp_bytes: to which TCP lets them grow by itself.
    """

    default_bytes: int
    largest_bytes: int
    tcp_bytes: int


class Disk(NamedTuple):
    """Where something is kept.

    Attributes:
        free_bytes: for a user without privileges.
        total_bytes: of the disk.
        writable: this process may write there.
    """

    free_bytes: int
    total_bytes: int
    writable: bool


class Synchronisation(NamedTuple):
    """How well CLOCK_REALTIME is kept, by the kernel's account.

    Attributes:
        synchronised: a daemon keeps it.
        offset_s: what is left to be corrected.
        error_s: largest error.
    """

    synchronised: bool
    offset_s: float
    error_s: float


@dataclass(frozen=True, slots=True)
class Host:
    """The kernel's files.

    Attributes:
        root: folder with `proc` and `sys`.
    """

    root: Path = Path("/")

    def usable_cpus(self) -> set[int]:
        """Processors that this process may run on."""
        return _cpu_list(self._status("Cpus_allowed_list"))

    def online_cpus(self) -> set[int]:
        """Processors that are switched on."""
        return _cpu_list(self._text(f"{_CPUS}/online"))

    def isolated_cpus(self) -> set[int]:
        """Processors on which the kernel puts nobody who does not ask for them (isolcpus)."""
        return _cpu_list(self._text(f"{_CPUS}/isolated"))

    def tickless_cpus(self) -> set[int]:
        """Processors without a timer tick while one process runs (nohz_full); none where the kernel knows no such."""
        return _cpu_list(self._text_or_nothing(f"{_CPUS}/nohz_full").replace("(null)", ""))

    def quota_cpus(self) -> float | None:
        """Processors' worth of time that this process's control groups may use; None for all."""
        found: list[float] = []
        for line in self._text("proc/self/cgroup").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers and "cpu" not in controllers.split(","):
                continue
            mount = self.root / "sys/fs/cgroup" / ("cpu" if controllers else "")
            below = mount / path.lstrip("/")
            for group in [below, *below.parents]:
                found += self._quota(group)
                if group == mount:
                    break
        return min(found, default=None)

    def governors(self) -> dict[int, str]:
        """Frequency governor of each usable processor that has one; empty where the host does not show any."""
        found = {cpu: self._text_or_nothing(f"{_CPUS}/cpu{cpu}/cpufreq/scaling_governor") for cpu in self.usable_cpus()}
        return {cpu: governor for cpu, governor in found.items() if governor}

    def turbo(self) -> bool | None:
        """Whether the clock may exceed its nominal frequency; None where the host does not say."""
        if inverted := self._text_or_nothing(f"{_CPUS}/intel_pstate/no_turbo"):
            return inverted == "0"
        boost = self._text_or_nothing(f"{_CPUS}/cpufreq/boost")
        return boost == "1" if boost else None

    def idle_driver(self) -> str:
        """What puts idle processors to sleep."""
        return self._text(f"{_CPUIDLE}/current_driver")

    def idle_states(self) -> list[IdleState]:
        """Sleeps of the first usable processor, in the kernel's order."""
        folder = f"{_CPUS}/cpu{min(self.usable_cpus())}/cpuidle"
        names = sorted((path.name for path in (self.root / folder).glob("state*")), key=lambda name: int(name[5:]))
        return [
            IdleState(
                self._text(f"{folder}/{name}/name"),
                int(self._text(f"{folder}/{name}/latency")),
                self._text(f"{folder}/{name}/disable") == "0",
            )
            for name in names
        ]

    def clock_source(self) -> str:
        """Hardware that the kernel reads the time from."""
        return self._text(_CLOCKSOURCE)

    def realtime_share(self) -> tuple[int, int]:
        """Of how many us (second) real-time processes may use how many (first) of a processor; -1 for all."""
        runtime, period = (self._text(f"proc/sys/kernel/sched_rt_{name}_us") for name in ("runtime", "period"))
        return int(runtime), int(period)

    def limit(self, name: str) -> int | None:
        """This process's soft limit by its name in /proc/self/limits; None for no limit."""
        found = re.search(rf"^{re.escape(name)}\s+(\S+)", self._text("proc/self/limits"), re.MULTILINE)
        if found is None:
            raise ValueError(f"/proc/self/limits has no line {name!r}")
        return None if found[1] == "unlimited" else int(found[1])

    def swap(self) -> Swap:
        """Swap space."""
        rows = [line.split() for line in self._text("proc/swaps").splitlines()[1:]]
        return Swap(sum(int(row[2]) for row in rows) * 1024, sum(int(row[3]) for row in rows) * 1024)

    def huge_pages(self) -> str:
        """When the kernel takes huge pages by itself: always, madvise or never."""
        text = self._text("sys/kernel/mm/transparent_hugepage/enabled")
        return text[text.index("[") + 1 : text.index("]")]

    def hypervisor(self) -> str:
        """Name of the hypervisor, or of the machine that it plays; empty where there is none."""
        dmi = [self._text_or_nothing(f"sys/class/dmi/id/{name}") for name in ("sys_vendor", "product_name")]
        if kind := self._text_or_nothing("sys/hypervisor/type"):
            return " ".join([kind, *dmi]).strip()
        flags = re.search(r"^flags\s*:(.*)$", self._text("proc/cpuinfo"), re.MULTILINE)
        if flags is None:
            raise ValueError("this processor's /proc/cpuinfo does not say whether there is a hypervisor")
        if "hypervisor" not in flags[1].split():
            return ""
        return " ".join(dmi).strip() or "it does not say which"

    def stolen_share(self) -> float:
        """Part of all processor time since boot that a hypervisor gave to others."""
        ticks = [int(word) for word in self._text("proc/stat").splitlines()[0].split()[1 : _STEAL + 2]]
        return ticks[_STEAL] / sum(ticks)

    def kernel(self) -> str:
        """Release of the kernel, and how it was built: words such as PREEMPT_RT."""
        return self._text("proc/version")

    def preemption(self) -> str:
        """Which model a PREEMPT_DYNAMIC kernel runs with; empty where it is neither readable nor given at boot."""
        model = re.search(r"\((\w+)\)", self._text_or_nothing("sys/kernel/debug/sched/preempt"))
        if model is None:
            model = re.search(r"(?:^| )preempt=(\w+)", self._text("proc/cmdline"))
        return model[1] if model else ""

    def socket_buffers(self) -> SocketBuffers:
        """Bytes that sockets hold."""
        default, largest = (
            min(int(self._text(f"{_NET}/core/{way}mem_{which}")) for way in "rw") for which in ("default", "max")
        )
        tcp = min(int(self._text(f"{_NET}/ipv4/tcp_{way}mem").split()[2]) for way in "rw")
        return SocketBuffers(default, largest, tcp)

    def load(self) -> float:
        """Processes that ran or waited to run, mean of a minute."""
        return float(self._text("proc/loadavg").split()[0])

    def used_s(self) -> dict[tuple[int, int], tuple[str, float]]:
        """Name and processor time, seconds, of every process, by its number and when it was started."""
        found = {}
        for folder in (self.root / "proc").glob("[0-9]*"):
            text = self._text_or_nothing(f"proc/{folder.name}/stat")
            if text:  # it may have ended
                process = used(text)
                found[int(folder.name), process.started] = process.name, process.processor_s
        return found

    def disk(self, folder: Path) -> Disk:
        """The disk that a folder is on, or will be once it is made."""
        there = self.root / folder.absolute().relative_to("/")
        while not there.exists():
            there = there.parent
        usage = shutil.disk_usage(there)
        return Disk(usage.free, usage.total, os.access(there, os.W_OK))

    def shared_memory(self) -> Disk:
        """The memory that processes share by name."""
        if not (self.root / _SHARED).is_dir():
            raise FileNotFoundError(f"there is no /{_SHARED}")
        return self.disk(Path("/") / _SHARED)

    def synchronisation(self) -> Synchronisation:
        """How CLOCK_REALTIME is kept; of the kernel that runs, whatever `root` is."""
        return _adjtimex()

    def _text(self, path: str) -> str:
        return (self.root / path).read_text(errors="replace").strip()

    def _text_or_nothing(self, path: str) -> str:
        try:
            return self._text(path)
        except OSError:
            return ""

    def _status(self, name: str) -> str:
        for line in self._text("proc/self/status").splitlines():
            key, _, value = line.partition(":")
            if key == name:
                return value.strip()
        raise ValueError(f"/proc/self/status has no line {name!r}")

    def _quota(self, group: Path) -> Iterable[float]:
        """The quota of one control group, of the newer kind or the older."""
        inside = group.relative_to(self.root)
        words = self._text_or_nothing(f"{inside}/cpu.max").split() or [
            self._text_or_nothing(f"{inside}/cpu.cfs_{name}_us") for name in ("quota", "period")
        ]
        return [int(words[0]) / int(words[1])] if words[0] not in ("", "max", "-1") else []


def _cpu_list(text: str) -> set[int]:
    """Processors of a list such as 0-3,8."""
    found: set[int] = set()
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return found


class _Timex(ctypes.Structure):
    """The kernel's struct timex, up to what is read here."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 32),
    )


def _adjtimex() -> Synchronisation:
    libc = ctypes.CDLL(None, use_errno=True)
    timex = _Timex(modes=0)  # change nothing
    state = libc.adjtimex(ctypes.byref(timex))
    if state < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), "adjtimex")
    unit_s = 1e-9 if timex.status & _STA_NANO else 1e-6
    kept = state != _TIME_ERROR and not timex.status & _STA_UNSYNC
    return Synchronisation(kept, timex.offset * unit_s, timex.maxerror * 1e-6)
