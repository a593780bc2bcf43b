"""What the host is and what it allows, as its kernel reports it: readings, each with its type; others judge them.

A reading raises OSError where there is nothing to read, and ValueError or LookupError where it makes no sense.
"""

import ctypes
import os
import re
import resource
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import psutil

_CPUS = "sys/devices/system/cpu"
_CLOCKSOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"
_NET = "proc/sys/net"
_STA_UNSYNC, _STA_NANO, _TIME_ERROR = 0x40, 0x2000, 5


class IdleState(NamedTuple):
    """A depth to which an idle processor sleeps; waking from it takes `exit_us` at most."""

    name: str
    exit_us: int
    enabled: bool


class SocketBuffers(NamedTuple):
    """Bytes that a socket holds for a slow reader, the smaller of both directions.

    Attributes:
        default_bytes: without being asked for more.
        largest_bytes: that a program may ask for.
        tcp_bytes: to which TCP lets them grow by itself.
    """

    default_bytes: int
    largest_bytes: int
    tcp_bytes: int


class Disk(NamedTuple):
    """Where something is kept; `writable` by this process."""

    free_bytes: int
    total_bytes: int
    writable: bool


class Synchronisation(NamedTuple):
    """How well CLOCK_REALTIME is kept, by the kernel's account: by a daemon, what is left to correct, largest error."""

    synchronised: bool
    offset_s: float
    error_s: float


class Host:
    """The kernel's account of this host; `root` is the folder with `proc` and `sys`."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    def usable_cpus(self) -> set[int]:
        """Processors that this process may run on."""
        return os.sched_getaffinity(0)

    def online_cpus(self) -> set[int]:
        """Processors that are switched on."""
        return _cpu_list(self._text(f"{_CPUS}/online"))

    def isolated_cpus(self) -> set[int]:
        """Processors that the kernel gives only to programs that ask for them (isolcpus)."""
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
        return self._text(f"{_CPUS}/cpuidle/current_driver")

    def idle_states(self) -> list[IdleState]:
        """Sleeps of the first usable processor, in the kernel's order."""
        folder = f"{_CPUS}/cpu{min(self.usable_cpus())}/cpuidle"
        names = sorted((path.name for path in (self.root / folder).glob("state*")), key=lambda name: int(name[5:]))
        texts = [[self._text(f"{folder}/{name}/{key}") for key in ("name", "latency", "disable")] for name in names]
        return [IdleState(name, int(exit_us), disabled == "0") for name, exit_us, disabled in texts]

    def clock_source(self) -> str:
        """Hardware that the kernel reads the time from."""
        return self._text(_CLOCKSOURCE)

    def realtime_share(self) -> tuple[int, int]:
        """Of how many us (second) real-time processes may use how many (first) of a processor; -1 for all."""
        runtime, period = (self._text(f"proc/sys/kernel/sched_rt_{name}_us") for name in ("runtime", "period"))
        return int(runtime), int(period)

    def open_files(self) -> int | None:
        """How many files and sockets this process may have open; None for no limit."""
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        return None if limit == resource.RLIM_INFINITY else limit

    def swap(self) -> tuple[int, int]:
        """Bytes of swap space, and how many of them are in use."""
        found = psutil.swap_memory()
        return found.total, found.used

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
        times = psutil.cpu_times()
        return float(times.steal / (sum(times) - times.guest - times.guest_nice))  # which are in user and nice already

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
        return os.getloadavg()[0]

    def used_s(self) -> dict[tuple[int, float], tuple[str, float]]:
        """Name and processor time, seconds, of every process, by its number and when it was started."""
        found = [process.info for process in psutil.process_iter(["pid", "create_time", "name", "cpu_times"])]
        return {
            (one["pid"], one["create_time"]): (one["name"], one["cpu_times"].user + one["cpu_times"].system)
            for one in found
            if one["cpu_times"]  # it may have ended
        }

    def disk(self, folder: Path) -> Disk:
        """The disk that a folder is on, or will be once it is made."""
        there = self.root / folder.absolute().relative_to("/")
        while not there.exists():
            there = there.parent
        usage = psutil.disk_usage(str(there))
        return Disk(usage.free, usage.total, os.access(there, os.W_OK))

    def shared_memory(self) -> Disk | None:
        """The memory that processes share by name; None where there is none."""
        return self.disk(Path("/dev/shm")) if (self.root / "dev/shm").is_dir() else None  # noqa: S108  # looked at

    def synchronisation(self) -> Synchronisation:
        """How CLOCK_REALTIME is kept; of the kernel that runs, whatever `root` is."""
        libc = ctypes.CDLL(None, use_errno=True)
        timex = Timex(modes=0)  # change nothing
        state = libc.adjtimex(ctypes.byref(timex))
        if state < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), "adjtimex")
        unit_s = 1e-9 if timex.status & _STA_NANO else 1e-6
        kept = state != _TIME_ERROR and not timex.status & _STA_UNSYNC
        return Synchronisation(kept, timex.offset * unit_s, timex.maxerror * 1e-6)

    def _text(self, path: str) -> str:
        return (self.root / path).read_text(errors="replace").strip()

    def _text_or_nothing(self, path: str) -> str:
        try:
            return self._text(path)
        except OSError:
            return ""

    def _quota(self, group: Path) -> Iterable[float]:
        """The quota of one control group, of the newer kind or the older."""
        inside = group.relative_to(self.root)
        words = self._text_or_nothing(f"{inside}/cpu.max").split() or [
            self._text_or_nothing(f"{inside}/cpu.cfs_{name}_us") for name in ("quota", "period")
        ]
        return [int(words[0]) / int(words[1])] if words[0] not in ("", "max", "-1") else []


def resident_bytes(process: int | None = None) -> int:
    """Resident memory of a process, of this one when None; psutil.NoSuchProcess where there is none."""
    return int(psutil.Process(process).memory_info().rss)


def _cpu_list(text: str) -> set[int]:
    """Processors of a list such as 0-3,8."""
    found: set[int] = set()
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return found


class Timex(ctypes.Structure):
    """The kernel's struct timex, up to what is read here."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 32),
    )
