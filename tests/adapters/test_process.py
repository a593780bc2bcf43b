"""Process adapters: clocks, child processes, real-time set-up, and install advice."""

import json
import os
import resource
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from unittest.mock import Mock

import pytest
import zenoh

from lowfc.adapters.bus.zenoh_fault import cause_of
from lowfc.adapters.process import join
from lowfc.adapters.process.child import Child
from lowfc.adapters.process.clock import SIMULATED_START_NS, HostClock, SimulatedClock, boot_offset_ns
from lowfc.adapters.process.extras import install_advice
from lowfc.adapters.process.realtime import spread
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import Role
from tests.support.loops import until


def test_simultaneous_calls_get_the_same_clock_offset(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(boot_offset_ns, [tmp_path] * 8))) == 1
    (file,) = tmp_path.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    for damaged, got in ((b"noon", "noon"), (b"\xff", "\N{REPLACEMENT CHARACTER}")):
        file.write_bytes(damaged)
        with pytest.raises(DataFileError, match=f"offset in ns, got '{got}'"):
            boot_offset_ns(tmp_path)


def test_the_clock_does_not_step_with_the_wall_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = HostClock(tmp_path)
    before = clock.now_ns()
    monkeypatch.setattr(time, "time_ns", lambda: 0)  # the wall clock is set back to 1970
    assert HostClock(tmp_path).now_ns() >= before
    assert clock.host_ns() >= before
    assert before // 1_000_000_000 - clock.start_s in (0, 1)
    assert clock.now_ns() - time.monotonic_ns() <= clock.offset_ns
    for deadline in (clock.now_ns() + 3_000_000, before):  # the second deadline has passed
        clock.sleep_until_ns(deadline)
        assert clock.now_ns() >= deadline


def test_the_clock_reports_its_lead_over_the_wall_clock(tmp_path: Path) -> None:
    clock = HostClock(tmp_path)
    assert abs(clock.ahead_ns()) < 1_000_000_000
    (file,) = tmp_path.iterdir()
    file.write_text(str(clock.offset_ns - 3600 * 10**9))  # as if fixed before NTP synchronised
    late = HostClock(tmp_path)
    assert abs(late.ahead_ns() + 3600 * 10**9) < 1_000_000_000
    assert abs(SimulatedClock(base=tmp_path).ahead_ns() + 3600 * 10**9) < 1_000_000_000


def test_simulated_time_is_set_explicitly_and_host_time_advances(tmp_path: Path) -> None:
    host = HostClock(tmp_path)
    clock = SimulatedClock(base=tmp_path)
    assert (clock.now_ns(), clock.start_s, clock.lockstep) == (SIMULATED_START_NS, SIMULATED_START_NS // 10**9, True)
    clock.set_ns(SIMULATED_START_NS + 7)
    clock.sleep_until_ns(SIMULATED_START_NS + 9)
    clock.sleep_until_ns(SIMULATED_START_NS + 8)
    assert clock.now_ns() == SIMULATED_START_NS + 9
    assert host.now_ns() <= clock.host_ns() <= host.now_ns()


PATIENCE_S = 30.0

# Starts a child that ignores SIGTERM, and prints its process id.
PARENT = """
import signal, sys, time
from pathlib import Path
from lowfc.adapters.process.child import Child
program = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); time.sleep(600)"
child = Child("one", [sys.executable, "-c", program], Path(sys.argv[1]), death_signal=signal.SIGKILL)
child.start()
print(child.process.pid, flush=True)
time.sleep(600)
"""


def command_line(pid: int) -> bytes:
    """Command line of a process; empty once it has ended, also as a zombie."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def test_a_child_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT, tmp_path / "stderr"], stdout=subprocess.PIPE, text=True)
    pid = int(parent.stdout.readline())
    until(lambda: b"SIG_IGN" in command_line(pid) and b"prctl" not in command_line(pid))
    parent.kill()
    parent.communicate()
    until(lambda: not command_line(pid))


def test_a_child_is_the_program_itself_with_its_own_session_and_its_output_is_kept(tmp_path: Path) -> None:
    program = "import os, sys; print('done'); sys.stderr.write(repr((os.getpid(), os.getsid(0), os.environ['WORD'])))"
    environment, out = {**os.environ, "WORD": "received"}, tmp_path / "stdout"
    child = Child("one", [sys.executable, "-c", program], tmp_path / "stderr", environment, stdout_path=out)
    child.start()
    child.process.wait(PATIENCE_S)
    assert (child.status, child.stderr_tail()) == (0, repr((child.process.pid, child.process.pid, "received")))
    assert out.read_text() == "done\n"
    child.stop(PATIENCE_S)


def test_the_end_of_a_child_and_a_missing_program_are_reported(tmp_path: Path) -> None:
    for number, name in ((9, "SIGKILL"), (40, "signal 40")):
        child = Child("one", ["sleep", "600"], tmp_path / "stderr")
        child.start()
        child.process.send_signal(number)
        child.process.wait(PATIENCE_S)
        assert child.exit_description() == f"one was killed by {name}"
        child.stop(PATIENCE_S)
    with pytest.raises(FileNotFoundError, match="no-such-program"):
        Child("one", ["no-such-program"], tmp_path / "stderr").start()


LATENCY_DEVICE = "/dev/cpu_dma_latency"
REPORT = """
import gc, json, os, sys
import numpy
from threadpoolctl import threadpool_info
{setup}
from lowfc.adapters.process.realtime import set_up, set_up_below_loop, use_huge_pages
granted = {call}
print(json.dumps({{
    "granted": granted.granted, "refused": granted.refused,
    "policy": os.sched_getscheduler(0), "priority": os.sched_getparam(0).sched_priority,
    "cpus": sorted(os.sched_getaffinity(0)), "collects": gc.isenabled(), "frozen": gc.get_freeze_count(),
    "blas": [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"],
    "locked_kb": [int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmLck")][0],
    "resident_kb": [int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmRSS")][0],
    "huge_kb": [int(line.split()[1]) for line in open("/proc/self/smaps_rollup") if line.startswith("AnonHuge")][0],
    "open": [os.readlink(f"/proc/self/fd/{{number}}") for number in os.listdir("/proc/self/fd")[:-1]],
}}))
"""

# The process drops its privileges and limits first.
UNPRIVILEGED = """
import ctypes, resource
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
version_3, no_capabilities = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
assert ctypes.CDLL(None).capset(version_3, no_capabilities) == 0
"""

NO_DEVICE = """
import lowfc.adapters.process.realtime
lowfc.adapters.process.realtime._LATENCY_DEVICE = "/no/such/device"
"""


def report(call: str, setup: str = "") -> dict[str, object]:
    arguments = [sys.executable, "-c", REPORT.format(call=call, setup=setup)]
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    return json.loads(subprocess.run(arguments, env=environment, capture_output=True, text=True, check=True).stdout)


def test_set_up_changes_only_blas_threads_and_garbage_collection_by_default() -> None:
    reported = report("set_up(None, None, lock_memory=False, disable_cpu_idle=False)")
    assert reported["granted"] == ["one BLAS thread", "garbage collector off"]
    assert reported["refused"] == []
    assert (reported["policy"], reported["cpus"]) == (os.sched_getscheduler(0), sorted(os.sched_getaffinity(0)))
    assert (reported["collects"], reported["locked_kb"]) == (False, 0)
    assert reported["frozen"] > 0
    assert set(reported["blas"]) == {1}


def test_refused_measures_are_reported_with_their_cost() -> None:
    reported = report("set_up(50, {4096}, lock_memory=True, disable_cpu_idle=True)", UNPRIVILEGED + NO_DEVICE)
    measures = [measure for measure, _ in reported["refused"]]
    assert [measure.split(" (")[0] for measure in measures] == [
        "processors [4096]",
        "locked memory",
        "processors awake",
        "SCHED_FIFO priority 50",
    ]
    assert "64 kB" in measures[1]
    assert all(len(cost) > 30 for _, cost in reported["refused"])
    assert (reported["policy"], reported["locked_kb"]) == (os.sched_getscheduler(0), 0)
    assert reported["granted"] == ["one BLAS thread", "garbage collector off"]


def test_a_scheduling_class_below_the_normal_one_is_kept() -> None:
    reported = report(
        "set_up_below_loop(None, None)", f"os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0)); {UNPRIVILEGED}"
    )
    assert reported["policy"] == os.SCHED_IDLE


def test_locking_memory_does_not_allocate_reserved_memory() -> None:
    reserve = "from mmap import *; reserved = mmap(-1, 1 << 28, MAP_PRIVATE | MAP_ANONYMOUS)"
    reported = report("set_up(None, None, lock_memory=True, disable_cpu_idle=False)", reserve)
    if reported["refused"]:
        pytest.skip(str(reported["refused"]))
    assert reported["locked_kb"] > 1 << 18
    assert reported["resident_kb"] < 150_000


def test_memory_is_moved_to_huge_pages() -> None:
    allocate = "memory = bytearray(b'1' * (16 << 20))"
    reported = report("use_huge_pages()", allocate)
    if reported["refused"]:
        pytest.skip(str(reported["refused"]))
    assert reported["granted"] == ["huge pages"]
    assert reported["huge_kb"] >= 14 << 10


def test_a_host_without_huge_pages_refuses_them(tmp_path: Path) -> None:
    disable = "import ctypes; assert ctypes.CDLL(None).prctl(41, 1, 0, 0, 0) == 0  # PR_SET_THP_DISABLE"
    reported = report("use_huge_pages()", disable)
    ((measure, cost),) = reported["refused"]
    assert measure == "huge pages (Invalid argument)"
    assert "Linux 6.1" in cost
    assert (reported["granted"], reported["huge_kb"]) == ([], 0)
    (tmp_path / "bytes").write_text(str(1 << 40))  # larger than any memory here
    for file, why in (("bytes", "no memory fills one"), ("none", "not in this kernel")):
        setup = f"import lowfc.adapters.process.realtime as it; it._HUGE_PAGE_BYTES = {str(tmp_path / file)!r}"
        assert report("use_huge_pages()", setup)["refused"][0][0] == f"huge pages ({why})"


def fifo_permitted() -> bool:
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    return os.geteuid() == 0 or limit == resource.RLIM_INFINITY or limit >= 10


@pytest.mark.skipif(not fifo_permitted(), reason="this user may not have SCHED_FIFO")
def test_real_time_is_granted_on_a_host_that_allows_it() -> None:
    cpu = min(os.sched_getaffinity(0))
    reported = report(f"set_up(10, {{{cpu}}}, lock_memory=False, disable_cpu_idle=False)")
    if reported["refused"]:  # a container's root may not have CAP_SYS_NICE
        pytest.skip(str(reported["refused"]))
    assert (reported["policy"], reported["priority"], reported["cpus"]) == (os.SCHED_FIFO, 10, [cpu])
    assert reported["granted"][-2:] == [f"processors [{cpu}]", "SCHED_FIFO priority 10"]


@pytest.mark.skipif(not os.access(LATENCY_DEVICE, os.W_OK), reason="this user may not disable CPU idle")
def test_cpu_idle_stays_disabled_while_the_process_lives() -> None:
    twice = "[set_up(None, None, lock_memory=False, disable_cpu_idle=True) for _ in range(2)][-1]"
    reported = report(twice)
    assert (reported["granted"][-1], reported["open"].count(LATENCY_DEVICE)) == ("processors awake", 1)


def test_the_recorder_does_not_keep_the_real_time_class_of_its_parent() -> None:
    real_time, cpu = fifo_permitted(), min(os.sched_getaffinity(0))
    setup = "os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))" if real_time else ""
    reported = report(f"set_up_below_loop(None, {{{cpu}}})", setup)
    below_batch = os.sched_getscheduler(0) == os.SCHED_IDLE and not real_time
    assert (reported["policy"], reported["cpus"]) == (os.SCHED_IDLE if below_batch else os.SCHED_BATCH, [cpu])
    assert reported["granted"] == [*([] if below_batch else ["batch scheduling class"]), f"processors [{cpu}]"]


def test_a_host_without_the_batch_class_refuses_it() -> None:
    setup = "os.sched_getscheduler = lambda _: os.SCHED_OTHER; os.SCHED_BATCH = 99"
    ((measure, _),) = report("set_up_below_loop(None, None)", setup)["refused"]
    assert measure == "batch scheduling class (Invalid argument)"


def test_processes_in_lockstep_request_no_real_time_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    set_up = Mock()
    monkeypatch.setattr(join, "set_up", set_up)
    for lockstep in (True, False):
        config = Configuration.model_validate({"lockstep": lockstep, "realtime": {"priority": 50}})
        join.prepare(config, Role.CAMERA, [])
    assert [call.args[0] for call in set_up.mock_calls] == [None, 50]


def test_processes_are_spread_over_the_available_processors() -> None:
    def cpus_of(*cpus: int, simulated: bool = True) -> list[list[int]]:
        """Processors of camera, controller, mirror and recorder."""
        return list(spread(cpus, simulated=simulated).values())

    assert cpus_of(3) == []
    assert cpus_of(5, 1) == [[1], [5], [5], []]
    assert cpus_of(5, 1, simulated=False) == [[1], [5], [1], [1]]
    assert cpus_of(0, 1, 2) == [[0], [1], [2], [0, 2]]
    assert cpus_of(0, 1, 2, 3) == [[0], [1], [2], [0, 2, 3]]


def test_install_advice_lists_the_packages_of_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    assert install_advice("deploy") == f"{sys.executable} -m pip install 'cryptography>=44'"
    assert install_advice("epics") == f"{sys.executable} -m pip install 'p4p>=4.3'", "without those of epics-test"
    monkeypatch.setattr(metadata, "requires", Mock(side_effect=metadata.PackageNotFoundError))
    assert install_advice("plots").endswith("pip install -e '.[plots]' in the checkout of lowfc")


def test_zenohs_errors_are_shown_without_source_locations() -> None:
    text = (
        "Can not create a new TCP listener bound to tcp/127.0.0.1:4: [127.0.0.1:4: Address already in use "
        "(os error 98) at /root/.cargo/git/zenoh/io/tcp.rs:61.] at /root/.cargo/git/zenoh/unicast.rs:338."
    )
    assert cause_of(zenoh.ZError(text)) == "127.0.0.1:4: Address already in use (os error 98)"
    assert cause_of(zenoh.ZError(text.replace("127.0.0.1", "[::1]"))) == "[::1]:4: Address already in use (os error 98)"
    two_lines = zenoh.ZError("invalid configuration at zenoh/src/api/session.rs:12.\nmore")
    assert cause_of(two_lines) == "invalid configuration"
    timeout = "Unable to connect to any of [Single(tcp/127.0.0.1:99)]. Timeout!"
    assert cause_of(zenoh.ZError(f"{timeout} at /root/zenoh/orchestrator.rs:388.")) == timeout
    for unchanged in ("no peer among [tcp/127.0.0.1:99]", "an invalid key: [a/**b] cannot be used"):
        assert cause_of(zenoh.ZError(unchanged)) == unchanged
