"""Real-time set-up of a process; call it before the first zenoh session.

A session's threads inherit the scheduling class and the processors at its creation.
"""

import ctypes
import gc
import os
import resource
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from threadpoolctl import threadpool_limits

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_MADV_COLLAPSE = 25  # since Linux 6.1
_CAP_IPC_LOCK = 1 << 14
_MONITOR_NICE = 5  # of 19
_LATENCY_DEVICE = "/dev/cpu_dma_latency"
_HUGE_PAGE_BYTES = "/sys/kernel/mm/transparent_hugepage/hpage_pmd_size"
_COMPILER = "llvmlite"  # library whose pages are not locked: large, and not used after the first frame

_Measure = tuple[str, Callable[[], object], str]
"""Name of a real-time measure, the function that requests it, and the cost of its refusal."""

_open_devices: list[int] = []


@dataclass(frozen=True, slots=True)
class Granted:
    """Measures in force, and measures refused by the host, each with the cost of its refusal."""

    granted: tuple[str, ...]
    refused: tuple[tuple[str, str], ...]


NOTHING = Granted((), ())


def set_up(priority: int | None, cpus: set[int] | None, *, lock_memory: bool, disable_cpu_idle: bool) -> Granted:
    """Prepare this process for the loop.

    Args:
        priority: priority of SCHED_FIFO, 1 to 99; None: the scheduling class does not change.
        cpus: processors to run on; None: they do not change.
        lock_memory: whether to lock all pages in memory.
        disable_cpu_idle: whether to disable CPU idle states of the host while this process lives.

    Returns:
        Granted and refused measures; a refusal is not an error: the loop runs with more jitter.
    """
    threadpool_limits(limits=1)
    gc.collect()
    gc.freeze()
    gc.disable()
    measures = _processors(cpus, "the kernel moves the loop between processors; expect a longer tail of the latencies")
    if lock_memory:
        cost = "a page that was swapped out stalls the loop for milliseconds"
        measures.append(("locked memory", _lock_memory, cost))
    if disable_cpu_idle:
        cost = (
            "an idle processor takes tens of microseconds longer to wake, and wakes several times in each frame; "
            f"let this user write to {_LATENCY_DEVICE}"
        )
        measures.append(("processors awake", _disable_cpu_idle, cost))
    cost = (
        "other programs may run first, and one frame in a thousand comes milliseconds late on a busy host; "
        "allow it with LimitRTPRIO= or CAP_SYS_NICE"
    )
    return _request(["one BLAS thread", "garbage collector off"], measures + _scheduling(priority, cost))


def use_huge_pages() -> Granted:
    """Move this process's memory to huge pages, for fewer TLB misses in each frame.

    Call it once the process is ready: it stops the process for some 50 ms, and does not move later allocations.
    """
    cost = "every frame takes longer; huge pages need Linux 6.1"
    return _request([], [("huge pages", _collapse_memory, cost)])


def spread(cpus: Iterable[int], *, simulated: bool = True) -> dict[str, list[int]]:
    """Configuration keys that distribute the loop's processes over these processors; no key for a single processor.

    The controller gets its own processor if possible: other processes would evict its code and data from the caches,
    and the recorder, which receives each frame at the same time, could run before it. With two processors, a simulated
    camera needs one, and the recorder may use both: the kernel would stop it for 50 ms on a processor whose real-time
    share is used up.

    Args:
        cpus: available processors.
        simulated: whether the camera computes its frames.
    """
    cpus = sorted(cpus)
    camera, *remaining = cpus
    if not remaining:
        return {}
    controller, *remaining = remaining
    only_two = simulated and not remaining
    return {
        "realtime.camera_cpus": [camera],
        "realtime.controller_cpus": [controller],
        "realtime.mirror_cpus": [controller if only_two else (remaining or cpus)[0]],
        "realtime.recorder_cpus": [] if only_two else [cpu for cpu in cpus if cpu != controller],
    }


def set_up_below_loop(priority: int | None, cpus: set[int] | None) -> Granted:
    """Set up a process that must keep up with the loop but never delay it, such as the recorder.

    Its SCHED_FIFO priority, if granted, is below the loop's and above everything else: in the normal class on a busy
    host, a recorder loses messages of a 1 kHz loop. If none is requested, the process is in the batch class: when a
    message wakes it, it does not preempt the loop.
    """
    leave_real_time()
    measures: list[_Measure] = []
    if priority is None and os.sched_getscheduler(0) == os.SCHED_OTHER:
        enter_batch = partial(os.sched_setscheduler, 0, os.SCHED_BATCH, os.sched_param(0))
        measures.append(("batch scheduling class", enter_batch, "the recorder's wake-ups interrupt the loop"))
    measures += _processors(cpus, "the recorder may get in the loop's way")
    measures += _scheduling(priority, "on a busy host the recorder loses messages")
    return _request([], measures)


def yield_to_sender() -> None:
    """Yield so that the bus's thread sends the last put before this thread continues.

    With equal SCHED_FIFO priority on the same processor, the bus's thread would wait until this one sleeps. A mirror's
    process on this processor (with only two processors) would wait in the same way: the second yield lets it apply the
    command. In the normal class the kernel schedules these threads, and yielding would let any process run.
    """
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        os.sched_yield()
        os.sched_yield()


def lower_priority() -> None:
    """Lower this process's priority below the loop and its recorder; for a monitor, which may be late."""
    leave_real_time()
    os.nice(_MONITOR_NICE)
    threadpool_limits(limits=1)


def leave_real_time() -> None:
    """Leave the real-time class inherited from the loop; a class below the normal one, chosen by a person, stays."""
    if os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _request(in_force: list[str], measures: Iterable[_Measure]) -> Granted:
    """Request the measures; `in_force` are those granted already."""
    refused = []
    for name, measure, cost in measures:
        try:
            measure()
        except (OSError, ValueError) as fault:
            refused.append((f"{name} ({getattr(fault, 'strerror', None) or fault})", cost))
        else:
            in_force.append(name)
    return Granted(tuple(in_force), tuple(refused))


def _processors(cpus: set[int] | None, cost: str) -> list[_Measure]:
    return [] if cpus is None else [(f"processors {sorted(cpus)}", partial(os.sched_setaffinity, 0, cpus), cost)]


def _scheduling(priority: int | None, cost: str) -> list[_Measure]:
    if priority is None:
        return []
    measure = partial(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(priority))
    return [(f"SCHED_FIFO priority {priority}", measure, cost)]


def _disable_cpu_idle() -> None:
    """Disable CPU idle states; in force while the device is open."""
    if not _open_devices:
        device = os.open(_LATENCY_DEVICE, os.O_WRONLY)
        try:
            os.write(device, struct.pack("=i", 0))
        except OSError:
            os.close(device)
            raise
        _open_devices.append(device)


def _lock_memory() -> None:
    """Lock resident pages, all pages of mapped files (reading them later is slow), and other pages once touched.

    Locking all reserved memory would allocate it: most of it is reserved by BLAS for threads that do not run here.
    Under a memory-lock limit nothing is locked, as later allocations would fail.
    """
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    if limit != resource.RLIM_INFINITY and not _capabilities() & _CAP_IPC_LOCK:
        raise OSError(f"the limit is {limit // 1024} kB; set LimitMEMLOCK=infinity")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        raise OSError(os.strerror(ctypes.get_errno()))
    for line in Path("/proc/self/maps").read_text().splitlines():
        pages, rights, *_, name = line.split(maxsplit=5)
        if name.startswith("/") and rights.startswith("r") and _COMPILER not in name:
            begin, end = (int(address, 16) for address in pages.split("-"))
            libc.mlock(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin))


def _collapse_memory() -> None:
    """Move to a huge page each part of the heap and of anonymous mappings that fills one, unless the part is empty."""
    try:
        size = int(Path(_HUGE_PAGE_BYTES).read_text())
    except FileNotFoundError as fault:
        raise OSError("not in this kernel") from fault
    libc, collapsed, why = ctypes.CDLL(None, use_errno=True), False, "no memory fills one"
    for line in Path("/proc/self/maps").read_text().splitlines():
        pages, rights, _, _, inode, *name = line.split(maxsplit=5)
        if rights == "rw-p" and inode == "0" and name in ([], ["[heap]"]):
            begin, end = (int(address, 16) for address in pages.split("-"))
            for page in range(-(-begin // size) * size, end - size + 1, size):
                if libc.madvise(ctypes.c_void_p(page), ctypes.c_size_t(size), _MADV_COLLAPSE) == 0:
                    collapsed = True
                else:
                    why = os.strerror(ctypes.get_errno())
    if not collapsed:
        raise OSError(why)


def _capabilities() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], 16)
    return 0
