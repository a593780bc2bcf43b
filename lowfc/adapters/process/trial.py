"""What this host grants a process of the loop, and how late it wakes it: tried in a process of its own.

That process ends, so nothing of what it was granted stays with the caller.
"""

import os
import subprocess
import sys
import time

from pydantic import BaseModel

from lowfc.adapters.process.realtime import set_up
from lowfc.contract.configuration import Realtime

RATE_HZ = 1000

_STARTING_S = 60.0
_CPUS = 8192  # as many as a kernel can have


class Trial(BaseModel):
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

    Args:
        asked: of the host.
        cpus: processors to sleep on; empty for all.
        seconds: how long, in each class.

    Raises:
        OSError: the process that tries cannot be started, or fails.
    """
    words = [asked.model_dump_json(), ",".join(map(str, cpus)), str(seconds)]
    try:
        done = subprocess.run(  # noqa: S603  # this module
            [sys.executable, "-P", "-m", "lowfc.adapters.process.trial", *words],
            capture_output=True,
            text=True,
            timeout=2 * seconds + _STARTING_S,
            check=False,
        )
    except subprocess.TimeoutExpired as fault:
        raise OSError(f"the process that tries it did not end within {fault.timeout:g} s") from fault
    if done.returncode:
        why = done.stderr.strip().splitlines()[-1:] or ["it said nothing"]
        raise OSError(f"the process that tries it ended with exit status {done.returncode}: {why[0]}")
    return Trial.model_validate_json(done.stdout)


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

    def ask(
        name: str, priority: int | None = None, *, lock_memory: bool = False, disable_cpu_idle: bool = False
    ) -> None:
        found = set_up(priority, None, lock_memory=lock_memory, disable_cpu_idle=disable_cpu_idle).refused
        refused.update({name: found[0]} if found else {})

    ask("lock_memory", lock_memory=asked.lock_memory)
    ask("disable_cpu_idle", disable_cpu_idle=asked.disable_cpu_idle)
    normal_ns = lateness_ns(wake_ups)
    ask("priority", asked.priority or None)
    first_ns = lateness_ns(wake_ups) if asked.priority and "priority" not in refused else []
    return Trial(refused=refused, cpus=reachable, normal_ns=normal_ns, first_ns=first_ns)


if __name__ == "__main__":
    _asked, _cpus, _seconds = sys.argv[1:]
    _named = {int(cpu) for cpu in _cpus.split(",") if cpu}
    sys.stdout.write(_try(Realtime.model_validate_json(_asked), _named, float(_seconds)).model_dump_json())
