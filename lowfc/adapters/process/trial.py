"""Trial, in a separate process, of the real-time settings that this host grants, and of its wake-up latency.

The process ends afterwards, so that no setting stays in force for the caller.
"""

import os
import time
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

from lowfc.adapters.process.child import interrupt_blocked
from lowfc.adapters.process.realtime import leave_real_time, set_up, use_huge_pages
from lowfc.contract.configuration import Realtime

RATE_HZ = 1000

_CPUS = 8192  # the kernel's maximum


class Trial(NamedTuple):
    """Result of a trial.

    Attributes:
        refused: for each refused setting (`priority`, `lock_memory`, `huge_pages`, `disable_cpu_idle`) its description
            and the cost of its refusal.
        cpus: processors that the process may use, including those outside the caller's affinity.
        normal_ns: lateness of each wake-up in the normal scheduling class, ns.
        fifo_ns: lateness of each wake-up under SCHED_FIFO, ns; empty if not requested or refused.
    """

    refused: dict[str, tuple[str, str]]
    cpus: set[int]
    normal_ns: list[int]
    fifo_ns: list[int]


def try_out(requested: Realtime, cpus: set[int], seconds: float) -> Trial:
    """Request the real-time settings of a loop process, and time 1000 wake-ups per second in each scheduling class.

    The trial runs on `cpus`, or on the caller's processors if none of `cpus` can be used. OSError if the trial's
    process cannot start, or fails.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            with interrupt_blocked():  # Ctrl-C in the trial's process would leave the pool waiting for ever
                running = pool.submit(_try, requested, cpus, seconds)
            return running.result()
        except BrokenExecutor as fault:
            raise OSError(f"the trial's process ended: {fault}") from fault


def lateness_ns(wake_ups: int) -> list[int]:
    """Sleep until times a period of `RATE_HZ` apart; return the lateness of each wake-up, ns.

    The times are fixed beforehand: a time that passes while an earlier wake-up is late also counts as late.
    """
    late_ns = [0] * wake_ups
    due_ns = time.monotonic_ns()
    for number in range(wake_ups):
        due_ns += 1_000_000_000 // RATE_HZ
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns * 1e-9)
        late_ns[number] = time.monotonic_ns() - due_ns
    return late_ns


def _try(requested: Realtime, cpus: set[int], seconds: float) -> Trial:
    leave_real_time()
    wake_ups = max(1, round(seconds * RATE_HZ))
    inherited = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(_CPUS))
    reachable = os.sched_getaffinity(0)
    os.sched_setaffinity(0, (cpus & reachable) or inherited)
    refused: dict[str, tuple[str, str]] = {}

    def request(name: str, priority: int | None = None, **measure: bool) -> None:
        measures = {"lock_memory": False, "disable_cpu_idle": False} | measure
        if refusals := set_up(priority, None, **measures).refused:
            refused[name] = refusals[0]

    request("lock_memory", lock_memory=requested.lock_memory)
    if requested.lock_memory and (refusals := use_huge_pages().refused):
        refused["huge_pages"] = refusals[0]
    request("disable_cpu_idle", disable_cpu_idle=requested.disable_cpu_idle)
    normal_ns = lateness_ns(wake_ups)
    request("priority", requested.priority or None)
    fifo_ns = lateness_ns(wake_ups) if requested.priority and "priority" not in refused else []
    return Trial(refused, reachable, normal_ns, fifo_ns)
