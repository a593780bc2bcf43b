"""Real-time set-up of a process, in one place; call it before the first zenoh session.

A session's threads keep the scheduling class and the processors they are born with.
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
_CAP_IPC_LOCK = 1 << 14
_MONITOR_NICE = 5  # of 19
_LATENCY_DEVICE = "/dev/cpu_dma_latency"
_COMPILER = "llvmlite"  # its work is done before the first frame, and it is larger than all the rest

_Measure = tuple[str, Callable[[], object], str]
"""Name of a measure, what asks the host for it, and the cost of its refusal."""

_held: list[int] = []


@dataclass(frozen=True, slots=True)
class Granted:
    """Measures that are in force, and those that the host refused, each with what that costs."""

    granted: tuple[str, ...]
    refused: tuple[tuple[str, str], ...]


NOTHING = Granted((), ())


class _RefusedError(Exception):
    """The host does not allow a measure."""


def set_up(priority: int | None, cpus: set[int] | None, *, lock_memory: bool, disable_cpu_idle: bool) -> Granted:
    """Prepare this process for the loop.

    Args:
        priority: of SCHED_FIFO, 1 to 99; None leaves the normal class.
        cpus: processors to stay on; None leaves all.
        lock_memory: keep every page in memory.
        disable_cpu_idle: keep the host's idle processors awake as long as this process lives.

    Returns:
        What was granted; a refusal is no error, for the loop runs without, only less evenly.
    """
    threadpool_limits(limits=1)
    gc.collect()
    gc.freeze()
    gc.disable()
    measures = _processors(cpus, "the kernel moves the loop between processors; expect a longer tail")
    if lock_memory:
        cost = "a page that was swapped out stalls the loop for milliseconds"
        measures.append(("locked memory", _lock_memory, cost))
    if disable_cpu_idle:
        cost = (
            "a processor that sleeps between frames takes tens of microseconds longer to wake, several times a "
            f"frame; let this user write to {_LATENCY_DEVICE}"
        )
        measures.append(("processors awake", _stay_awake, cost))
    cost = (
        "other programs may run first, and one frame in a thousand comes milliseconds late on a busy host; "
        "allow it with LimitRTPRIO= or CAP_SYS_NICE"
    )
    return _ask(["one BLAS thread", "garbage collector off"], measures + _scheduling(priority, cost))


def spread(cpus: Iterable[int], *, simulated: bool = True) -> dict[str, list[int]]:
    """Configuration keys that keep the loop's processes apart on these processors; none where there is only one.

    The controller has one to itself where it can: whatever else runs there pushes its code and data out of the caches,
    and the recorder, which is sent each frame together with it, would run first. Of two processors, though, a simulated
    camera needs one, and the recorder whatever is left of either: a processor whose real-time share is used up stands
    still for 50 ms.

    Args:
        cpus: to spread them on.
        simulated: the camera computes its frames.
    """
    camera, *others = cpus = sorted(cpus)
    if not others:
        return {}
    controller, *others = others
    few = simulated and not others
    return {
        "realtime.camera_cpus": [camera],
        "realtime.controller_cpus": [controller],
        "realtime.mirror_cpus": [controller if few else (others or cpus)[0]],
        "realtime.recorder_cpus": [] if few else [cpu for cpu in cpus if cpu != controller],
    }


def step_back(priority: int | None, cpus: set[int] | None = None) -> Granted:
    """Prepare a process that must keep up but never get in the loop's way, such as the recorder.

    Its SCHED_FIFO priority, where it may have one, is below the loop's and above all else on the host: in the normal
    class, beside other work, a recorder loses messages of a 1 kHz loop.
    """
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # not the class of a parent that is in the loop
    measures = _processors(cpus, "the recorder may get in the loop's way")
    measures += _scheduling(priority, "on a busy host the recorder loses messages")
    return _ask([] if priority is not None else ["normal scheduling class"], measures)


def let_send() -> None:
    """Let the bus's thread send what was just put before this one goes on.

    Of equal SCHED_FIFO priority and on the same processor, it would wait until this one rests; so would the mirror that
    got a command, and the bus's thread of the mirror, which is woken only then. In the normal class the kernel sees to
    that, and yielding would give way to everybody.
    """
    if os.sched_getscheduler(0) == os.SCHED_FIFO:
        os.sched_yield()
        os.sched_yield()


def give_way() -> None:
    """Let the loop and its recorder run first: for a monitor, which may be late and loses nothing."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # not the class of a parent that is in the loop
    os.nice(_MONITOR_NICE)
    threadpool_limits(limits=1)


def _ask(in_force: list[str], measures: Iterable[_Measure]) -> Granted:
    refused = []
    for name, measure, cost in measures:
        try:
            measure()
        except (_RefusedError, OSError, ValueError) as fault:
            refused.append((f"{name} ({getattr(fault, 'strerror', None) or fault})", cost))
        else:
            in_force.append(name)
    return Granted(tuple(in_force), tuple(refused))


def _processors(cpus: set[int] | None, cost: str) -> list[_Measure]:
    return [] if cpus is None else [(f"processors {sorted(cpus)}", partial(os.sched_setaffinity, 0, cpus), cost)]


def _scheduling(priority: int | None, cost: str) -> list[_Measure]:
    if priority is None:
        return []
    first = partial(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(priority))
    return [(f"SCHED_FIFO priority {priority}", first, cost)]


def _stay_awake() -> None:
    """Ask the kernel for processors that wake at once; it holds as long as the device is open."""
    if not _held:
        device = os.open(_LATENCY_DEVICE, os.O_WRONLY)
        try:
            os.write(device, struct.pack("=i", 0))
        except OSError:
            os.close(device)
            raise
        _held.append(device)


def _lock_memory() -> None:
    """Lock what is there, and every other page once it is touched; of files all pages now, for reading one takes long.

    To lock all of what is only reserved would fill it: most of it are buffers and stacks of threads that BLAS does not
    use. Under a limit, later allocations would fail instead of being slow, so nothing is locked then.
    """
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[1]
    if limit != resource.RLIM_INFINITY and not _capabilities() & _CAP_IPC_LOCK:
        raise _RefusedError(f"the limit is {limit // 1024} kB; set LimitMEMLOCK=infinity")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        raise _RefusedError(os.strerror(ctypes.get_errno()))
    for line in Path("/proc/self/maps").read_text().splitlines():
        pages, rights, *_, name = line.split(maxsplit=5)
        if name.startswith("/") and rights.startswith("r") and _COMPILER not in name:
            begin, end = (int(address, 16) for address in pages.split("-"))
            libc.mlock(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin))


def _capabilities() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], 16)
    return 0
