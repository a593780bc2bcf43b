"""What this host grants a process of the loop, and how late it wakes it: tried in a process of its own.

That process ends, so nothing of what it was granted stays with the caller.
"""

import os
import time
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

from lowfc.adapters.process.realtime import set_up
from lowfc.contract.configuration import Realtime

RATE_HZ = 1000

_CPUS = 8192  # as many as a kernel can have


class Trial(NamedTuple):
    """What the host granted.

    Attributes:
        refused: of `priority`, `lock_memory` and `disable_cpu_idle` what the host refused, each with what that costs.
        cpus: processors that the process could choose from.
        normal_ns: how late each wake-up was in the normal class, ns.
        first_ns: the same under SCHED_FIFO; empty where that is not asked for, or refused.
    """

    refused: dict[str, tuple[str, str]]
    cpus: set[int]
    normal_ns: list[int]
    first_ns: list[int]


def try_out(asked: Realtime, cpus: set[int], seconds: float) -> Trial:
    """Ask for what a process of the loop asks for, and sleep 1000 times a second in each scheduling class.

    It sleeps on these processors, all when empty. OSError where the process that tries cannot be started, or fails.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(_try, asked, cpus, seconds).result()
        except BrokenExecutor as fault:
            raise OSError(f"the process that tries it ended: {fault}") from fault


def lateness_ns(wake_ups: int, period_ns: int = 1_000_000_000 // RATE_HZ) -> list[int]:
    """Sleep until instants a period apart; how late each wake-up was, ns.

    The instants are fixed beforehand: one that passes while this process sleeps too long counts as late, too.
    """
    late_ns = [0] * wake_ups
    due_ns = time.monotonic_ns()
    for number in range(wake_ups):
        due_ns += period_ns
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns * 1e-9)
        late_ns[number] = time.monotonic_ns() - due_ns
    return late_ns


def _try(asked: Realtime, cpus: set[int], seconds: float) -> Trial:
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # not the class of a parent that has another
    wake_ups = max(1, round(seconds * RATE_HZ))
    inherited = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(_CPUS))
    reachable = os.sched_getaffinity(0)
    os.sched_setaffinity(0, (cpus & reachable) or inherited)
    refused: dict[str, tuple[str, str]] = {}

    def ask(name: str, priority: int | None = None, **measure: bool) -> None:
        wanted = {"lock_memory": False, "disable_cpu_idle": False} | measure
        if found := set_up(priority, None, **wanted).refused:
            refused[name] = found[0]

    ask("lock_memory", lock_memory=asked.lock_memory)
    ask("disable_cpu_idle", disable_cpu_idle=asked.disable_cpu_idle)
    normal_ns = lateness_ns(wake_ups)
    ask("priority", asked.priority or None)
    first_ns = lateness_ns(wake_ups) if asked.priority and "priority" not in refused else []
    return Trial(refused, reachable, normal_ns, first_ns)
