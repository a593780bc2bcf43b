"""Each set-up runs in a process of its own: it cannot be undone."""

import json
import os
import resource
import subprocess
import sys

import pytest

from lowfc.adapters.process.realtime import spread

pytestmark = pytest.mark.exclusive

LATENCY_DEVICE = "/dev/cpu_dma_latency"
REPORT = """
import gc, json, os, sys
import numpy
from threadpoolctl import threadpool_info
{limits}
from lowfc.adapters.process.realtime import set_up, step_back
granted = {call}
print(json.dumps({{
    "granted": granted.granted, "refused": granted.refused,
    "policy": os.sched_getscheduler(0), "priority": os.sched_getparam(0).sched_priority,
    "cpus": sorted(os.sched_getaffinity(0)), "collects": gc.isenabled(), "frozen": gc.get_freeze_count(),
    "blas": [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"],
    "locked_kb": [int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmLck")][0],
    "open": [os.readlink(f"/proc/self/fd/{{number}}") for number in os.listdir("/proc/self/fd")[:-1]],
    "slack_ns": int(open("/proc/self/timerslack_ns").read()) if os.path.exists("/proc/self/timerslack_ns") else 1,
}}))
"""

# What a host without privileges refuses; the process gives its own up first.
UNPRIVILEGED = """
import ctypes, resource
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
version_3, no_capabilities = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
assert ctypes.CDLL(None).capset(version_3, no_capabilities) == 0
"""

NO_DEVICE = """
import lowfc.adapters.process.realtime
lowfc.adapters.process.realtime._LATENCY_DEVICE = "/there/is/none"
"""


def report(call: str, limits: str = "") -> dict[str, object]:
    done = subprocess.run(
        [sys.executable, "-c", REPORT.format(call=call, limits=limits)], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def test_the_interpreter_is_quiet_and_nothing_unasked_is_changed() -> None:
    found = report("set_up(None, None, lock_memory=False, disable_cpu_idle=False)")
    assert found["granted"] == ["memory kept", "one BLAS thread", "garbage collector off", "timer slack 1 ns"]
    assert found["refused"] == []
    assert (found["policy"], found["cpus"]) == (os.SCHED_OTHER, sorted(os.sched_getaffinity(0)))
    assert (found["collects"], found["slack_ns"], found["locked_kb"]) == (False, 1, 0)
    assert found["frozen"] > 0
    assert set(found["blas"]) == {1}


def test_what_the_host_refuses_is_named_with_its_cost() -> None:
    found = report("set_up(50, {4096}, lock_memory=True, disable_cpu_idle=True)", UNPRIVILEGED + NO_DEVICE)
    measures = [measure for measure, _ in found["refused"]]
    assert [measure.split(" (")[0] for measure in measures] == [
        "processors [4096]",
        "locked memory",
        "processors awake",
        "SCHED_FIFO priority 50",
    ]
    assert "64 kB" in measures[1]
    assert all(len(cost) > 30 for _, cost in found["refused"])
    assert (found["policy"], found["locked_kb"]) == (os.SCHED_OTHER, 0)
    assert found["granted"] == ["memory kept", "one BLAS thread", "garbage collector off", "timer slack 1 ns"]


def may_be_real_time() -> bool:
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    return os.geteuid() == 0 or limit == resource.RLIM_INFINITY or limit >= 10


@pytest.mark.skipif(not may_be_real_time(), reason="this user may not have SCHED_FIFO")
def test_a_host_that_allows_it_grants_real_time() -> None:
    cpu = min(os.sched_getaffinity(0))
    found = report(f"set_up(10, {{{cpu}}}, lock_memory=False, disable_cpu_idle=False)")
    if found["refused"]:  # a container's root may not have CAP_SYS_NICE
        pytest.skip(str(found["refused"]))
    assert (found["policy"], found["priority"], found["cpus"]) == (os.SCHED_FIFO, 10, [cpu])
    assert found["granted"][-2:] == [f"processors [{cpu}]", "SCHED_FIFO priority 10"]


@pytest.mark.skipif(not os.access(LATENCY_DEVICE, os.W_OK), reason="this user may not keep processors awake")
def test_processors_are_kept_awake_as_long_as_the_process_lives() -> None:
    twice = "[set_up(None, None, lock_memory=False, disable_cpu_idle=True) for _ in range(2)][-1]"
    found = report(twice)
    assert (found["granted"][-1], found["open"].count(LATENCY_DEVICE)) == ("processors awake", 1)


def test_the_recorder_steps_back_out_of_its_parents_class() -> None:
    limits = "os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))" if may_be_real_time() else ""
    found = report("step_back(None)", limits)
    assert (found["policy"], found["granted"]) == (os.SCHED_OTHER, ["memory kept", "normal scheduling class"])
    cpu = min(os.sched_getaffinity(0))
    found = report(f"step_back(None, {{{cpu}}})")
    assert (found["cpus"], found["granted"][1]) == ([cpu], f"processors [{cpu}]")
    found = report("step_back(None, {4096})")
    assert [measure.split(" (")[0] for measure, _ in found["refused"]] == ["processors [4096]"]


def test_processes_are_kept_apart_as_far_as_there_are_processors() -> None:
    def of(*cpus: int, simulated: bool = True) -> list[list[int]]:
        return list(spread(cpus, simulated=simulated).values())

    assert of(3) == []
    assert of(5, 1) == [[1], [5], [5], []]
    assert of(5, 1, simulated=False) == [[1], [5], [1], [1]]
    assert of(0, 1, 2) == [[0], [1], [2], [0, 2]]
    assert of(0, 1, 2, 3) == [[0], [1], [2], [0, 2, 3]]
