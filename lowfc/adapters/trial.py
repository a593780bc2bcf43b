"""What this host grants a process of the loop, and how late it wakes it: tried in a process of its own.

That process ends, so nothing of what it was granted stays with the one that asks.
"""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass

from lowfc.adapters.realtime import Granted, set_up
from lowfc.contract.configuration import Realtime

RATE_HZ = 1000

_STARTING_S = 60.0
_CPUS = 8192  # as many as a kernel can have


@dataclass(frozen=True, slots=True)
class Trial:
    """What came of it.

    Attributes:
        refused: of `priority`, `lock_memory` and `stay_awake` what the host refused, each with what that costs.
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
    wishes = (asked.priority, int(asked.lock_memory), int(asked.stay_awake), ",".join(map(str, sorted(cpus))), seconds)
    words = [str(wish) for wish in wishes]
    try:
        done = subprocess.run(  # noqa: S603  # this module
            [sys.executable, "-P", "-m", "lowfc.adapters.trial", *words],
            capture_output=True,
            text=True,
            timeout=2 * seconds + _STARTING_S,
            check=False,
        )
    except subprocess.TimeoutExpired as fault:
        raise OSError(f"the process that tries it did not end within {fault.timeout:g} s") from fault
    if done.returncode:
        said = done.stderr.strip().splitlines()[-1:] or ["it said nothing"]
        raise OSError(f"the process that tries it ended with exit status {done.returncode}: {said[0]}")
    found = json.loads(done.stdout)
    refused = {name: (what, cost) for name, (what, cost) in found["refused"].items()}
    return Trial(refused, set(found["cpus"]), found["normal_ns"], found["first_ns"])


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


def _main(priority: int, lock_memory: bool, stay_awake: bool, cpus: set[int], seconds: float) -> None:
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # not the class of a parent that has another
    wake_ups = max(1, round(seconds * RATE_HZ))
    inherited = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(_CPUS))
    reachable = os.sched_getaffinity(0)
    os.sched_setaffinity(0, (cpus & reachable) or inherited)
    refused = {
        "lock_memory": _refused(set_up(None, None, lock_memory=lock_memory, stay_awake=False)),
        "stay_awake": _refused(set_up(None, None, lock_memory=False, stay_awake=stay_awake)),
    }
    normal_ns = lateness_ns(wake_ups)
    refused["priority"] = _refused(set_up(priority or None, None, lock_memory=False, stay_awake=False))
    first_ns = lateness_ns(wake_ups) if priority and not refused["priority"] else []
    found = {
        "refused": {name: what for name, what in refused.items() if what},
        "cpus": sorted(reachable),
        "normal_ns": normal_ns,
        "first_ns": first_ns,
    }
    sys.stdout.write(json.dumps(found))


def _refused(granted: Granted) -> tuple[str, str] | None:
    return granted.refused[0] if granted.refused else None


if __name__ == "__main__":
    _priority, _lock, _awake, _cpus, _seconds = sys.argv[1:]
    _main(int(_priority), _lock == "1", _awake == "1", {int(cpu) for cpu in _cpus.split(",") if cpu}, float(_seconds))
