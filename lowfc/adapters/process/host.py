"""What the host is and what it allows, as its kernel reports it; others judge it.

A reading raises OSError where there is nothing to read, and ValueError or LookupError where it makes no sense.
"""

import contextlib
import ctypes
import os
import resource
import sys
import time
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import psutil

CPUS = "sys/devices/system/cpu"
_STA_UNSYNC, _STA_NANO, _TIME_ERROR = 0x40, 0x2000, 5
_MOST = 1 << 14  # bytes; of /proc/stat, the lines of 200 processors


class Synchronisation(NamedTuple):
    """How well CLOCK_REALTIME is kept, by the kernel's account: by a daemon, what is left to correct, largest error."""

    synchronised: bool
    offset_s: float
    error_s: float


class Host:
    """The kernel's account of this host; `root` is the folder with `proc` and `sys`."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    def text(self, path: str) -> str:
        """A file below `proc` or `sys`."""
        return (self.root / path).read_text(errors="replace").strip()

    def text_or_nothing(self, path: str) -> str:
        """The same; empty where there is no such file."""
        try:
            return self.text(path)
        except OSError:
            return ""

    def cpus(self, which: str) -> set[int]:
        """Processors of a list of the kernel: `online`, `isolated` (isolcpus), `nohz_full`."""
        read = self.text_or_nothing if which == "nohz_full" else self.text  # not every kernel has that one
        found: set[int] = set()
        for part in filter(None, read(f"{CPUS}/{which}").replace("(null)", "").split(",")):
            first, _, last = part.partition("-")
            found |= set(range(int(first), int(last or first) + 1))
        return found

    def usable_cpus(self) -> set[int]:
        """Processors that this process may run on."""
        return os.sched_getaffinity(0)

    def quota_cpus(self) -> float | None:
        """Processors' worth of time that this process's control group and those above may use; None for all."""
        lines = self.text("proc/self/cgroup").splitlines()
        (path,) = [line.removeprefix("0::/") for line in lines if line.startswith("0::")]
        groups = [Path(path), *Path(path).parents]
        limits = [self.text_or_nothing(f"sys/fs/cgroup/{group}/cpu.max").split() for group in groups]
        return min((int(limit[0]) / int(limit[1]) for limit in limits if limit and limit[0] != "max"), default=None)

    def clock_source(self) -> str:
        """Hardware that the kernel reads the time from."""
        return self.text("sys/devices/system/clocksource/clocksource0/current_clocksource")

    def open_files(self) -> int | None:
        """How many files and sockets this process may have open; None for no limit."""
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        return None if limit == resource.RLIM_INFINITY else limit

    def swap(self) -> tuple[int, int]:
        """Bytes of swap space, and how many of them are in use."""
        found = psutil.swap_memory()
        return found.total, found.used

    def stolen_share(self) -> float:
        """Part of all processor time since boot that a hypervisor gave to others."""
        times = psutil.cpu_times()
        return float(times.steal / (sum(times) - times.guest - times.guest_nice))  # which are in user and nice already

    def load(self) -> float:
        """Processes that ran or waited to run, mean of a minute."""
        return os.getloadavg()[0]

    def busy(self) -> list[tuple[str, float]]:
        """Other processes, the busiest first: name with number, and share of one processor since the last call."""
        found = [process.info for process in psutil.process_iter(["pid", "name", "cpu_percent"])]
        shares = [
            (f"{one['name']} ({one['pid']})", (one["cpu_percent"] or 0.0) / 100)
            for one in found
            if one["pid"] != os.getpid()
        ]
        return sorted(shares, key=lambda one: -one[1])

    def disk(self, folder: Path) -> tuple[int, bool]:
        """Free bytes of the disk that a folder is on, or will be once it is made, and whether it can be written."""
        there = self.root / folder.absolute().relative_to("/")
        while not there.exists():
            there = there.parent
        return psutil.disk_usage(str(there)).free, os.access(there, os.W_OK)

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


class Counts(NamedTuple):
    """What the kernel counts that holds a process up, since boot or since its start.

    Attributes:
        stolen_ns: time that the hypervisor gave to others, of the processor or of all; in steps of 10 ms.
        throttled: periods in which the quota of the control group was used up.
        waited_ns: time in which the thread could run and had no processor.
        preempted: times that the thread had to leave its processor.
        minor_faults: pages of the process that were in memory and not mapped yet.
        major_faults: pages of the process that were read from a disk.
    """

    stolen_ns: int
    throttled: int
    waited_ns: int
    preempted: int
    minor_faults: int
    major_faults: int


class Counters:
    """The `Counts` of one thread of a process; the files stay open, so that a reading takes some 20 us."""

    def __init__(self, process: int, thread: int, cpus: Collection[int]) -> None:
        """Open the files of a thread that runs on these processors, on all when empty; OSError where there is none."""
        folder = f"/proc/{process}/task/{thread}"
        self._cpu = f"cpu{next(iter(cpus))} " if len(cpus) == 1 else "cpu "
        names = "/proc/stat", f"{folder}/schedstat", f"{folder}/status", f"/proc/{process}/stat"
        self._stat, self._waits, self._switches, self._faults = (os.open(name, os.O_RDONLY) for name in names)
        group = _quota_file()
        self._group = os.open(group, os.O_RDONLY) if group is not None else None
        self._tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")

    def read(self) -> Counts:
        """The counts now; OSError where the process has ended."""
        stat = _content(self._stat)
        stolen = stat[stat.index(self._cpu) :].split(maxsplit=9)[8]
        waited_ns = _content(self._waits).split()[1]
        preempted = _content(self._switches).rpartition("nonvoluntary_ctxt_switches:")[2]
        faults = _content(self._faults).rpartition(")")[2].split(maxsplit=12)
        throttled = 0 if self._group is None else int(_content(self._group).partition("nr_throttled ")[2].split()[0])
        numbers = waited_ns, preempted, faults[7], faults[9]
        return Counts(int(stolen) * self._tick_ns, throttled, *map(int, numbers))


def busiest_thread(process: int, seconds: float) -> int:
    """The thread of a process that runs most in the next seconds; OSError where there is no such process."""
    before = _run_ns(process)
    time.sleep(seconds)
    return max((ran_ns - before.get(thread, 0), thread) for thread, ran_ns in _run_ns(process).items())[1]


def _run_ns(process: int) -> dict[int, int]:
    found = {}
    for folder in Path(f"/proc/{process}/task").iterdir():
        with contextlib.suppress(OSError):  # it has ended
            found[int(folder.name)] = int((folder / "schedstat").read_text().split()[0])
    return found


def _quota_file() -> Path | None:
    """Where this process's control group counts the periods in which its quota was used up; None where it has none."""
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers or "cpu" in controllers.split(","):
            file = Path(f"/sys/fs/cgroup/{'cpu' if controllers else ''}{path}/cpu.stat")
            if file.exists() and "nr_throttled" in file.read_text():
                return file
    return None


def _content(file: int) -> str:
    return os.pread(file, _MOST, 0).decode()


def resident_bytes(process: int | None = None) -> int:
    """Resident memory of a process, of this one when None; psutil.NoSuchProcess where there is none."""
    return int(psutil.Process(process).memory_info().rss)


class Timex(ctypes.Structure):
    """The kernel's struct timex, up to what is read here."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 32),
    )


def program_name() -> str:
    """The program of this process as people know it: `lowfc ctl`, or the name of a script."""
    program = Path(sys.argv[0])
    name = program.parent.name if program.stem == "__main__" else program.name
    return " ".join([name, *sys.argv[1:2]]) if name == "lowfc" else name or "python"


def by_this_process(what: str) -> str:
    """What is done, with the user and process that do it: `lowfc ctl by ann (process 12)`."""
    return f"{what} by {psutil.Process().username()} (process {os.getpid()})"
