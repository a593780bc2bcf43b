"""Properties and limits of the host as reported by its kernel.

A reading raises OSError if it is not available, and ValueError or LookupError if it cannot be interpreted.
"""

import contextlib
import ctypes
import functools
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
_STAT = Path("/proc/stat")
_MAX_READ_BYTES = 1 << 14  # read from a file; from /proc/stat, counted from the beginning of the processor's line


class Synchronisation(NamedTuple):
    """State of CLOCK_REALTIME: whether a daemon synchronises it, the remaining correction, and the largest error."""

    synchronised: bool
    offset_s: float
    error_s: float


class Host:
    """Readings of this host's kernel; `root` is the folder with `proc` and `sys`."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    def text(self, path: str) -> str:
        """Content of a file, whose `path` begins with "proc/" or "sys/"."""
        return (self.root / path).read_text(errors="replace").strip()

    def text_or_nothing(self, path: str) -> str:
        """Content of a file as in `text`; empty if the file cannot be read."""
        try:
            return self.text(path)
        except OSError:
            return ""

    def cpus(self, list_name: str) -> set[int]:
        """Processors in a list of the kernel: `online`, `isolated` (isolcpus), `nohz_full`."""
        read = self.text_or_nothing if list_name == "nohz_full" else self.text  # not every kernel has nohz_full
        numbers: set[int] = set()
        for part in filter(None, read(f"{CPUS}/{list_name}").replace("(null)", "").split(",")):
            first, _, last = part.partition("-")
            numbers |= set(range(int(first), int(last or first) + 1))
        return numbers

    def usable_cpus(self) -> set[int]:
        """Processors that this process may run on."""
        return os.sched_getaffinity(0)

    def quota_cpus(self) -> float | None:
        """Smallest CPU quota of this process's control group and its parents, in processors; None without a quota."""
        lines = self.text("proc/self/cgroup").splitlines()
        (path,) = [line.removeprefix("0::/") for line in lines if line.startswith("0::")]
        groups = [Path(path), *Path(path).parents]
        limits = [self.text_or_nothing(f"sys/fs/cgroup/{group}/cpu.max").split() for group in groups]
        return min((int(limit[0]) / int(limit[1]) for limit in limits if limit and limit[0] != "max"), default=None)

    def clock_source(self) -> str:
        """The kernel's clock source."""
        return self.text("sys/devices/system/clocksource/clocksource0/current_clocksource")

    def max_open_files(self) -> int | None:
        """Limit on open files and sockets of this process; None without a limit."""
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        return None if limit == resource.RLIM_INFINITY else limit

    def swap(self) -> tuple[int, int]:
        """Swap space in bytes: total and used."""
        memory = psutil.swap_memory()
        return memory.total, memory.used

    def stolen_share(self) -> float:
        """Fraction of all processor time since boot that the hypervisor gave to other guests."""
        times = psutil.cpu_times()
        total_s = sum(times) - times.guest - times.guest_nice  # guest time is included in user and nice
        return float(times.steal / total_s)

    def load(self) -> float:
        """Load average of one minute."""
        return os.getloadavg()[0]

    def busy(self) -> list[tuple[str, float]]:
        """Other processes, busiest first: "name (pid)", and load in processors since the last call (0 at the first)."""
        processes = [process.info for process in psutil.process_iter(["pid", "name", "cpu_percent"])]
        loads = [
            (f"{info['name']} ({info['pid']})", (info["cpu_percent"] or 0.0) / 100)
            for info in processes
            if info["pid"] != os.getpid()
        ]
        return sorted(loads, key=lambda load: -load[1])

    def disk(self, folder: Path) -> tuple[int, bool]:
        """Free bytes on the disk of a folder, and whether the folder, or its nearest existing parent, is writable."""
        existing = self.root / folder.absolute().relative_to("/")
        while not existing.exists():
            existing = existing.parent
        return psutil.disk_usage(str(existing)).free, os.access(existing, os.W_OK)

    def synchronisation(self) -> Synchronisation:
        """State of CLOCK_REALTIME of the running kernel, independent of `root`."""
        libc = ctypes.CDLL(None, use_errno=True)
        timex = Timex(modes=0)  # change nothing
        state = libc.adjtimex(ctypes.byref(timex))
        if state < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), "adjtimex")
        unit_s = 1e-9 if timex.status & _STA_NANO else 1e-6
        synchronised = state != _TIME_ERROR and not timex.status & _STA_UNSYNC
        return Synchronisation(synchronised, timex.offset * unit_s, timex.maxerror * 1e-6)


class Counts(NamedTuple):
    """The kernel's counters of delays of a process, since boot or since the process's start.

    Attributes:
        stolen_ns: time of one or of all processors that the hypervisor gave to other guests, in steps of 10 ms.
        throttled: number of periods in which the control group's quota was used up.
        waited_ns: time for which the thread was runnable without a processor.
        preempted: number of involuntary context switches of the thread.
        minor_faults: number of the process's page faults without disk access.
        major_faults: number of the process's page faults with disk access.
    """

    stolen_ns: int
    throttled: int
    waited_ns: int
    preempted: int
    minor_faults: int
    major_faults: int


class Counters:
    """Reads the `Counts` of a thread; the files stay open, so that a reading takes about 20 us."""

    def __init__(self, process: int, thread: int, cpus: Collection[int]) -> None:
        """Open the files of a thread; OSError if there is no such thread.

        Stolen time is that of the processor in `cpus`, or of all processors if `cpus` does not have exactly one.
        """
        folder = f"/proc/{process}/task/{thread}"
        self._cpu = f"cpu{next(iter(cpus))} " if len(cpus) == 1 else "cpu "
        self._stat_bytes = _STAT.read_text().index(self._cpu) + _MAX_READ_BYTES
        names = _STAT, f"{folder}/schedstat", f"{folder}/status", f"/proc/{process}/stat"
        self._stat, self._waits, self._switches, self._faults = (os.open(name, os.O_RDONLY) for name in names)
        group = _quota_file()
        self._group = os.open(group, os.O_RDONLY) if group is not None else None
        self._tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")

    def read(self) -> Counts:
        """Return the present counts; OSError if the process has ended."""
        stat = _content(self._stat, self._stat_bytes)
        stolen = stat[stat.index(self._cpu) :].split(maxsplit=9)[8]
        waited_ns = _content(self._waits).split()[1]
        preempted = _content(self._switches).rpartition("nonvoluntary_ctxt_switches:")[2]
        faults = _content(self._faults).rpartition(")")[2].split(maxsplit=12)
        throttled = 0 if self._group is None else int(_content(self._group).partition("nr_throttled ")[2].split()[0])
        numbers = waited_ns, preempted, faults[7], faults[9]
        return Counts(int(stolen) * self._tick_ns, throttled, *map(int, numbers))


def busiest_thread(process: int, seconds: float) -> int:
    """Return the thread of a process with the most processor time in the next `seconds`; OSError without a process."""
    before = _run_ns(process)
    time.sleep(seconds)
    return max((ran_ns - before.get(thread, 0), thread) for thread, ran_ns in _run_ns(process).items())[1]


def _run_ns(process: int) -> dict[int, int]:
    """Processor time of each thread of a process so far, ns, by thread id."""
    run_ns = {}
    for folder in Path(f"/proc/{process}/task").iterdir():
        with contextlib.suppress(OSError):  # the thread has ended
            run_ns[int(folder.name)] = int((folder / "schedstat").read_text().split()[0])
    return run_ns


def _quota_file() -> Path | None:
    """File with the throttling counter of this process's control group; None if there is none."""
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers or "cpu" in controllers.split(","):
            file = Path(f"/sys/fs/cgroup/{'cpu' if controllers else ''}{path}/cpu.stat")
            if file.exists() and "nr_throttled" in file.read_text():
                return file
    return None


def _content(file: int, size: int = _MAX_READ_BYTES) -> str:
    return os.pread(file, size, 0).decode()


def resident_bytes(process: int | None = None) -> int:
    """Resident memory of a process (None: this one); psutil.NoSuchProcess if it does not exist."""
    if process is not None:
        return int(psutil.Process(process).memory_info().rss)
    pages = _content(_own_memory(os.getpid())).split()[1]  # read for every Health: several times as fast as psutil
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


@functools.lru_cache(1)
def _own_memory(process: int) -> int:
    """Descriptor of the open file with this process's memory use, cached for its id `process`, which a fork changes."""
    return os.open(f"/proc/{process}/statm", os.O_RDONLY)


class Timex(ctypes.Structure):
    """The kernel's struct timex, first part."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 32),
    )


def program_name() -> str:
    """Name of this process's program for users: `lowfc ctl`, or the name of a script."""
    program = Path(sys.argv[0])
    name = program.parent.name if program.stem == "__main__" else program.name
    return " ".join([name, *sys.argv[1:2]]) if name == "lowfc" else name or "python"


def by_this_process(what: str) -> str:
    """The text `what`, followed by this process's user and id: `moving the mask by ann (process 12)`."""
    return f"{what} by {psutil.Process().username()} (process {os.getpid()})"
