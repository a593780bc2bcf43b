"""`lowfc doctor` on suitable hosts, on unsuitable ones, and on the host that runs the tests."""

import ctypes
import json
import multiprocessing.resource_tracker
import multiprocessing.spawn
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import psutil
import pytest

from lowfc.adapters.bus.run import runtime_base
from lowfc.adapters.logs.selection import EVERYTHING
from lowfc.adapters.process import host as host_module
from lowfc.adapters.process import trial as trial_module
from lowfc.adapters.process.clock import boot_file
from lowfc.adapters.process.host import Host, Synchronisation, Timex
from lowfc.adapters.process.trial import Trial, lateness_ns, try_out
from lowfc.contract.configuration import Configuration, Realtime, load
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.programs.commissioning.checks import Check, note, ok
from lowfc.programs.commissioning.doctor import command, permissions, resources, timing
from lowfc.programs.commissioning.doctor import facts as facts_module
from lowfc.programs.commissioning.doctor.facts import Facts, gather
from lowfc.programs.core.recording.volume import bytes_per_s
from tests.support.loops import LOWFC, lowfc, refusal, until

DOCUMENT = Path(__file__).parents[2] / "docs" / "howto" / "doctor.md"
CHECKS = {**timing.CHECKS.functions, **resources.CHECKS.functions}
NO_RIGHTS = [
    *(["setpriv", "--inh-caps=-all", "--bounding-set=-sys_nice,-ipc_lock,-sys_resource"] if os.geteuid() == 0 else []),
    *("prlimit", "--rtprio=0", "--memlock=65536", sys.executable, "-P", "-c"),
]
"""Command that runs Python without the rights to a real-time class and locked memory, as root or as another user."""

CPUS = "sys/devices/system/cpu"
CLOCKSOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"
HUGE_PAGES = "sys/kernel/mm/transparent_hugepage/enabled"
SUITABLE_HOST = {
    "proc/self/cgroup": "0::/user.slice/loop.scope\n",
    "proc/sys/kernel/sched_rt_runtime_us": "950000\n",
    "proc/sys/kernel/sched_rt_period_us": "1000000\n",
    "proc/cpuinfo": "processor\t: 0\nflags\t\t: fpu tsc constant_tsc\n",
    "proc/version": "Linux version 6.12.1-rt (gcc) #1 SMP PREEMPT_RT Thu Jan 1\n",
    "proc/cmdline": "quiet isolcpus=4-7 nohz_full=4-7\n",
    "proc/sys/net/core/rmem_default": "212992\n",
    "proc/sys/net/core/wmem_default": "212992\n",
    "proc/sys/net/core/rmem_max": "8388608\n",
    "proc/sys/net/core/wmem_max": "4194304\n",
    "proc/sys/net/ipv4/tcp_rmem": "4096\t131072\t6291456\n",
    "proc/sys/net/ipv4/tcp_wmem": "4096\t16384\t4194304\n",
    f"{CPUS}/online": "0-7\n",
    f"{CPUS}/isolated": "4-7\n",
    f"{CPUS}/nohz_full": "4-6\n",
    **{f"{CPUS}/cpu{cpu}/cpufreq/scaling_governor": "performance\n" for cpu in range(8)},
    f"{CPUS}/intel_pstate/no_turbo": "1\n",
    f"{CPUS}/cpuidle/current_driver": "intel_idle\n",
    **{
        f"{CPUS}/cpu0/cpuidle/state{number}/{key}": f"{value}\n"
        for number, state in enumerate((("POLL", 0, 0), ("C1", 2, 0), ("C6", 133, 1)))
        for key, value in zip(("name", "latency", "disable"), state, strict=True)
    },
    HUGE_PAGES: "always [madvise] never\n",
    CLOCKSOURCE: "tsc\n",
    "usable_cpus": {0, 1, 2, 3},
    "max_open_files": 1024,
    "swap": (0, 0),
    "stolen_share": 0.0,
    "load": 0.15,
}
"""A suitable host: eight processors, four of them reserved for the loop. Files by path, readings by name."""

HOST_CHECKS = [
    *("real-time share", "processors", "isolation", "quota", "frequency", "idle states", "kernel", "virtualisation"),
    *("clock source", "wake-up", "load", "scheduling class", "locked memory", "swap", "huge pages"),
    *("socket buffers", "open files"),
]
"""Checks that pass on the suitable host and need its data."""
DMI = ("sys/class/dmi/id/sys_vendor", "sys/class/dmi/id/product_name")
DYNAMIC = {"proc/version": "Linux version 6.1.0 (gcc) #1 SMP PREEMPT_DYNAMIC Thu"}
PINNED: dict[str, object] = {
    "realtime.camera_cpus": [4],
    "realtime.controller_cpus": [5],
    "realtime.mirror_cpus": [6],
    "realtime.recorder_cpus": [0],  # not an isolated processor: the recorder can wait
}
NOTHING_REQUESTED = load(None, {"realtime.priority": 0, "realtime.recorder_priority": 0, "realtime.lock_memory": False})
REFUSED = {
    "priority": ("SCHED_FIFO priority 50 (no)", "frames come late"),
    "lock_memory": ("locked", "stalls"),
    "huge_pages": ("huge pages (no)", "frames take longer"),
    "disable_cpu_idle": ("processors awake (no)", "it wakes late"),
}
C6_ON = {f"{CPUS}/cpu0/cpuidle/state2/disable": "0\n"}


def trial(refused: dict[str, tuple[str, str]] | None = None, cpus: int = 8, **late_ns: list[int]) -> Trial:
    defaults = {"normal_ns": [40_000] * 99 + [900_000], "fifo_ns": [20_000] * 99 + [60_000]}
    return Trial(refused=refused or {}, cpus=set(range(cpus)), **{**defaults, **late_ns})


def machine(root: Path, changes: dict[str, object]) -> Host:
    """The suitable host with some files and readings changed; None removes one."""
    host, unreadable = Host(root), Mock(side_effect=OSError("not readable"))
    for name, value in {**SUITABLE_HOST, **changes}.items():
        if "/" not in name:
            setattr(host, name, unreadable if value is None else lambda value=value: value)
        elif value is not None:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(value)
    return host


def facts(root: Path, changes: dict[str, object] | None = None, **other_facts: object) -> Facts:
    """Facts about the suitable host with `changes`, and with these other facts in place of the defaults."""
    config = other_facts.pop(
        "config", load(None, {"recorder.folder": "/logs", "realtime.disable_cpu_idle": False, **PINNED})
    )
    defaults = {"host": machine(root, changes or {}), "config": config, "trial": trial(), "busy": ()}
    return Facts(**{**defaults, **other_facts})


def examine(facts: Facts) -> dict[str, Check]:
    return {check.name: check for check in command.examine(facts)}


def test_a_suitable_host_has_no_warning(tmp_path: Path) -> None:
    checks = examine(facts(tmp_path))
    assert {name: checks[name] for name in HOST_CHECKS if checks[name].status != "ok"} == {}
    assert checks["isolation"].got == "4-7; of these without a timer tick: 4-6"
    assert "turbo off" in checks["frequency"].got
    assert "C1 with 2 us" in checks["idle states"].got
    assert "213 kB, at most 4194 kB" in checks["socket buffers"].got
    assert "p99 20 us, max 60 us" in checks["wake-up"].got


@pytest.mark.parametrize(
    ("name", "status", "text", "changes"),
    [
        ("real-time share", "note", "stall for 50 ms", {"usable_cpus": {0, 1}}),
        ("real-time share", "warning", "0 ms of every", {"proc/sys/kernel/sched_rt_runtime_us": "0"}),
        ("real-time share", "ok", "all of a processor", {"proc/sys/kernel/sched_rt_runtime_us": "-1"}),
        ("processors", "warning", "names 6", {"trial": trial(cpus=6)}),
        ("isolation", "warning", "isolcpus=5-7 nohz_full=5-7", {f"{CPUS}/isolated": "\n"}),
        ("isolation", "note", "none of the 2 can be spared", {f"{CPUS}/isolated": "\n", f"{CPUS}/online": "0-1"}),
        ("isolation", "warning", "the configuration names 4-6", {f"{CPUS}/isolated": "4-5"}),
        ("isolation", "warning", "0-1,3,8; of these", {f"{CPUS}/isolated": "8,0-1,3\n"}),
        ("isolation", "ok", "without a timer tick: none", {f"{CPUS}/nohz_full": "(null)\n"}),
        ("quota", "warning", "1.5 processors", {"sys/fs/cgroup/user.slice/cpu.max": "150000 100000\n"}),
        ("quota", "ok", "none", {"sys/fs/cgroup/user.slice/cpu.max": "max 100000\n"}),
        ("frequency", "warning", "powersave", {f"{CPUS}/cpu2/cpufreq/scaling_governor": "powersave\n"}),
        ("frequency", "ok", "turbo on", {f"{CPUS}/intel_pstate/no_turbo": None, f"{CPUS}/cpufreq/boost": "1\n"}),
        ("frequency", "note", "not shown", {f"{CPUS}/cpu{cpu}/cpufreq/scaling_governor": None for cpu in range(4)}),
        ("idle states", "warning", "may wait 133 us", C6_ON),
        ("idle states", "note", "no states shown", {f"{CPUS}/cpuidle/current_driver": "none\n"}),
        ("kernel", "warning", "no preemption", {"proc/version": "Linux version 6.1.0 (gcc) #1 SMP Thu"}),
        ("kernel", "ok", "PREEMPT", {"proc/version": "Linux version 6.1.0 (gcc) #1 SMP PREEMPT Thu"}),
        ("kernel", "note", "cannot be read", DYNAMIC),
        ("kernel", "ok", "full", DYNAMIC | {"proc/cmdline": "quiet preempt=full"}),
        ("kernel", "warning", "voluntary", DYNAMIC | {"sys/kernel/debug/sched/preempt": "none (voluntary) full\n"}),
        (
            "virtualisation",
            "warning",
            "QEMU Standard PC",
            {"proc/cpuinfo": "flags\t: fpu hypervisor\n"} | dict(zip(DMI, ("QEMU\n", "Standard PC\n"), strict=True)),
        ),
        (
            "virtualisation",
            "warning",
            "10.00 % of its time stolen since boot; that is much",
            {"sys/hypervisor/type": "xen\n", "stolen_share": 0.1},
        ),
        ("clock source", "warning", "hpet", {CLOCKSOURCE: "hpet\n"}),
        ("load", "warning", "9.50 in the last minute", {"load": 9.5}),
        ("swap", "ok", "1 MB in use of 2097 MB; the loop's memory is locked", {"swap": (2_097_152_000, 1_048_576)}),
        ("huge pages", "warning", "always", {HUGE_PAGES: "[always] madvise never\n"}),
        ("socket buffers", "warning", "550 kB", {"proc/sys/net/ipv4/tcp_rmem": "4096 131072 550000\n"}),
        ("socket buffers", "ok", "560 kB", {"proc/sys/net/ipv4/tcp_rmem": "4096 131072 560000\n"}),
        ("open files", "warning", "64", {"max_open_files": 64}),
        (
            "synchronisation",
            "ok",
            "synchronised; 12 us to correct",
            {"synchronisation": Synchronisation(True, 12e-6, 0.001)},
        ),
        ("synchronisation", "warning", "not synchronised", {"synchronisation": Synchronisation(False, 12e-6, 0.001)}),
        ("wake-up", "warning", "max 4100 us", {"trial": trial(fifo_ns=[1000] * 999 + [4_100_000])}),
        ("wake-up", "warning", "a frame period is 4000 us", {"trial": trial(REFUSED, normal_ns=[500_000], fifo_ns=[])}),
        ("scheduling class", "note", "realtime.priority = 0", {"config": NOTHING_REQUESTED}),
        ("scheduling class", "note", "normal scheduling: lockstep", {"config": load(None, {"lockstep": True})}),
        ("scheduling class", "warning", "frames come late", {"trial": trial(REFUSED)}),
        ("locked memory", "warning", "stalls", {"trial": trial(REFUSED)}),
        ("huge pages", "warning", "frames take longer", {"trial": trial(REFUSED)}),
        ("swap", "warning", "memory is not locked", {"trial": trial(REFUSED), "swap": (1 << 31, 0)}),
        ("idle states", "ok", "133 us to wake; kept awake", C6_ON | {"config": load(None, PINNED)}),
        ("idle states", "warning", "it wakes late", C6_ON | {"config": load(None, PINNED), "trial": trial(REFUSED)}),
        ("load", "warning", "busy now: chromium 60 %", {"busy": (("chromium", 0.6), ("sshd", 0.05))}),
        ("locked memory", "note", "lock_memory = false", {"config": NOTHING_REQUESTED}),
    ],
)
def test_each_property_of_a_host_has_its_status_and_text(
    tmp_path: Path, name: str, status: str, text: str, changes: dict[str, object]
) -> None:
    other_facts = {key: changes[key] for key in ("trial", "config", "busy") if key in changes}
    host_changes = {key: value for key, value in changes.items() if key not in other_facts}
    check = examine(facts(tmp_path, host_changes, **other_facts))[name]
    assert (check.status, text in " ".join([check.got, check.advice, check.cost])) == (status, True), check
    assert status != "warning" or (check.advice and check.cost)


def test_unreadable_data_gives_a_note(tmp_path: Path) -> None:
    unreadable = dict.fromkeys(SUITABLE_HOST)
    failed = OSError("the trial's process ended with exit status 1: no")
    checks = examine(facts(tmp_path, unreadable, trial=failed))
    unknown = {name for name, check in checks.items() if check.got.startswith("not known: ")}
    assert unknown >= set(HOST_CHECKS)
    assert {checks[name].status for name in unknown} == {"note"}
    assert checks["scheduling class"].got == f"not known: {failed}"
    assert command.measured(facts(tmp_path, unreadable, trial=failed))["wake_up_us"] == {}
    files = {path: "\x00 ?" for path in SUITABLE_HOST if "/" in path}
    nonsense = examine(facts(tmp_path, files))
    assert {nonsense[name].status for name in ("isolation", "huge pages")} == {"note"}


def test_the_check_of_the_disk_uses_the_recorders_volume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = SimpleNamespace(free=0)
    monkeypatch.setattr(host_module.psutil, "disk_usage", lambda path: usage)
    keys = {"recorder.folder": "~/not/yet", "recorder.min_free_mb": 500, "camera.rate_hz": 1000}
    facts_with_disk = facts(tmp_path, config=load(None, {**keys, "mirror.rows": 10, "mirror.columns": 10}))
    assert facts_with_disk.bytes_per_s == 1000 * (80 * 80 * 2 + 2 * 100 * 4)
    log_gb_per_h = bytes_per_s(facts_with_disk.config, EVERYTHING) * 3600 / 1e9
    bytes_for_an_hour = 500_000_000 + round(log_gb_per_h * 1e9) + 1
    for free, status in ((bytes_for_an_hour, "ok"), (bytes_for_an_hour - 10**6, "warning"), (10**6, "warning")):
        usage.free = free
        check = examine(facts_with_disk)["disk"]
        assert check.status == status
        assert check.got.startswith(f"{Path.home()}/not/yet: ")
        assert (f"enough for 1.0 h at 1000 Hz, {log_gb_per_h:.1f} GB an hour" in check.got) == (free > 10**9)
    monkeypatch.setattr(host_module.os, "access", lambda path, mode: False)
    usage.free = bytes_for_an_hour
    assert "not writable" in examine(facts_with_disk)["disk"].got


@pytest.mark.parametrize(("behind_ms", "status"), [(50, "ok"), (1000, "warning"), (-1000, "warning")])
def test_a_wrong_boot_clock_is_a_warning(own_runtime: Path, behind_ms: int, status: str) -> None:
    assert examine(facts(own_runtime))["boot's clock"][:2] == ok("not set yet: the first process of a run sets it")[:2]
    assert not (own_runtime / "lowfc").exists(), "the check changes nothing"
    file = boot_file(runtime_base())
    file.write_text(str(time.time_ns() - time.monotonic_ns() - behind_ms * 1_000_000))
    finding = examine(facts(own_runtime))["boot's clock"]
    assert finding.status == status
    assert (status == "warning") == (f"remove {file}" in finding.advice)
    file.write_text("noon")
    assert "not known" in examine(facts(own_runtime))["boot's clock"].got


def test_expiring_or_absent_certificates_are_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    certificates = pytest.importorskip("lowfc.adapters.bus.certificates")
    folder = tmp_path / "certs"
    monkeypatch.setenv("HOME", str(tmp_path))
    routed = load(None, {"network.router": "tls/bench:7447", "network.certificates": "~/certs", **PINNED})
    absent = examine(facts(tmp_path, config=routed))["certificates"]
    assert (absent.status, f"{folder} has no certificate" in absent.got) == ("warning", True)
    certificates.make_certificates(folder, ("camera",), [])
    assert examine(facts(tmp_path))["certificates"].status == "ok"
    assert examine(facts(tmp_path, config=routed))["certificates"].status == "ok"
    certificates.make_certificates(folder, ("camera",), [], 59, renew=True)
    finding = examine(facts(tmp_path, config=routed))["certificates"]
    assert finding.status == "warning"
    assert "camera's certificate expires in 58 days" in finding.got


def test_the_kernels_clock_state_is_read_from_the_right_fields() -> None:
    timex = Timex(modes=0)
    assert ctypes.CDLL(None).adjtimex(ctypes.byref(timex)) >= 0
    seconds = timex.rest[3]  # the field `time`, after constant, precision and tolerance
    assert abs(seconds - time.time()) < 60
    assert Host().synchronisation().error_s >= 0


def test_missed_wake_ups_count_as_late(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [0]
    stalls = iter([500_000, 3_200_000])

    def sleep(seconds: float) -> None:
        now_ns[0] += round(seconds * 1e9) + next(stalls, 0)

    monkeypatch.setattr(trial_module, "time", SimpleNamespace(monotonic_ns=lambda: now_ns[0], sleep=sleep))
    assert lateness_ns(7) == [500_000, 3_200_000, 2_200_000, 1_200_000, 200_000, 0, 0]


def test_a_trial_leaves_no_real_time_class_or_affinity() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    tried = try_out(Realtime(), {min(before[1])}, 0.02)
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before
    assert tried.cpus >= before[1]
    assert len(tried.normal_ns) == 20
    assert len(tried.fifo_ns) == (0 if "priority" in tried.refused else 20)


def test_a_trial_without_rights_reports_what_is_refused() -> None:
    program = """
from lowfc.adapters.process.trial import try_out
from lowfc.contract.configuration import Realtime
trial = try_out(Realtime(), set(), 0.01)
print(*trial.refused["priority"], *trial.refused["lock_memory"], len(trial.normal_ns), len(trial.fifo_ns), sep="\\n")
"""
    done = subprocess.run([*NO_RIGHTS, program], capture_output=True, text=True, timeout=60, check=True)
    refused, cost, unlocked, stall, normal, fifo = done.stdout.splitlines()
    assert refused.startswith("SCHED_FIFO priority 50 (")
    assert "LimitRTPRIO" in cost
    assert "the limit is 64 kB" in unlocked
    assert "swapped out" in stall
    assert (normal, fifo) == ("10", "0"), "numbers of wake-ups measured"


def test_a_trial_ends_after_an_interrupt() -> None:
    with subprocess.Popen([*LOWFC, "doctor"], stderr=subprocess.PIPE, text=True, start_new_session=True) as doctor:
        assert "measuring" in doctor.stderr.readline()
        until(lambda: any(child.cpu_times().user > 0.1 for child in psutil.Process(doctor.pid).children()))
        os.killpg(doctor.pid, signal.SIGINT)  # as a terminal does
        try:
            assert doctor.communicate(timeout=60)[1] == "interrupted\n"
        finally:
            doctor.kill()


def test_a_failed_trial_names_its_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    multiprocessing.resource_tracker.ensure_running()  # started now, because /bin/false cannot start it
    monkeypatch.setattr(multiprocessing.spawn, "get_executable", lambda: b"/bin/false")
    with pytest.raises(OSError, match="the trial's process ended"):
        try_out(Realtime(), set(), 0.01)
    checks = examine(gather(Host(), Configuration(), 0.01))
    assert "the trial's process ended" in checks["wake-up"].got
    assert checks["wake-up"].status == "note"


def test_busy_finds_a_process_that_uses_the_cpu() -> None:
    host, own_pid = Host(), f"({os.getpid()})"
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as process:
        try:
            until(lambda: any(share > 0.1 and f"({process.pid})" in name for name, share in host.busy()))
        finally:
            process.kill()
    assert not any(name.endswith(own_pid) for name, _ in host.busy())


def test_doctor_checks_this_host(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "TRIAL_S", 0.02)
    done = lowfc("doctor", "--json")
    assert done.exit_code == 0, done.output
    (line,) = done.stdout.splitlines()
    report = json.loads(line)
    assert [check["name"] for check in report["checks"]] == list(CHECKS)
    assert all(set(check) == {"name", "status", "detail", "advice", "cost"} for check in report["checks"])
    assert not [check for check in report["checks"] if check["status"] == "warning" and not check["advice"]]
    assert sum(report["counts"].values()) == len(report["checks"])
    normal = report["wake_up_us"]["normal"]
    assert 0 < normal["p50"] <= normal["p99"] <= normal["max"]
    assert "1000 sleeps per second" in done.stderr


def test_strict_fails_on_warnings_but_not_on_notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(facts_module, "try_out", lambda *_: trial())
    config = tmp_path / "lowfc.toml"
    config.write_text("[realtime]\ncamera_cpus = [8000]\n")
    done = lowfc("doctor", "--config", config)
    assert done.exit_code == 0, done.output
    row = next(line for line in done.stdout.splitlines() if " processors " in line)
    assert row.startswith("warning")
    assert re.search(r"\d+ warnings, \d+ notes, \d+ ok", done.stdout)
    assert lowfc("doctor", "--config", config, "--strict").exit_code == 1
    monkeypatch.setattr(command, "examine", lambda _: [ok("fine"), note("odd")])
    assert lowfc("doctor", "--strict").exit_code == 0, "a note is no warning"


def test_the_document_describes_every_check_by_its_docstring() -> None:
    rows = [line.split(" | ") for line in DOCUMENT.read_text().splitlines() if line.startswith("| ")]
    assert [(name.removeprefix("| "), description) for name, description, _ in rows[1:]] == [
        (name, function.__doc__) for name, (_, function) in CHECKS.items()
    ]


@pytest.mark.parametrize(
    ("kernel", "available", "status", "text"),
    [
        ("fused", True, "ok", "the fused step"),
        ("fused", False, "warning", "numba"),
        ("numpy", True, "note", 'realtime.kernel = "fused"'),
        ("numpy", False, "note", "numba"),
    ],
)
def test_the_check_of_the_control_step_names_the_kernel(
    kernel: str, available: bool, status: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resources.compiled, "available", lambda: available)
    check = examine(facts(tmp_path, config=load(None, {"realtime.kernel": kernel})))["control step"]
    assert check.status == status
    assert text in f"{check.got} {check.advice}"


def test_real_time_rights_are_shown_applied_and_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OSError, match="exit 6: no such user"):
        permissions._run("sh", "-c", "echo no such user >&2; exit 6")
    calls: list[tuple[str, ...]] = []
    monkeypatch.setattr(permissions, "_run", lambda *arguments: calls.append(arguments) or " ".join(arguments))
    monkeypatch.setattr(permissions.shutil, "chown", lambda path, group: calls.append((str(group),)))
    monkeypatch.setattr(permissions.os, "geteuid", lambda: 1000)
    for change in (lambda: permissions.apply(tmp_path, "me"), lambda: permissions.undo(tmp_path)):
        with pytest.raises(ConfigurationError, match="needs root"):
            change()
    monkeypatch.setattr(permissions.os, "geteuid", lambda: 0)
    device = tmp_path / permissions.DEVICE
    device.parent.mkdir()
    device.touch(0o600)
    permissions.apply(tmp_path, "me")
    for name, text in permissions.FILES.items():
        assert (tmp_path / name).read_text() == text
        assert text in lowfc("doctor", "--setup").stdout
    assert device.stat().st_mode & 0o777 == 0o660
    assert [arguments[0] for arguments in calls] == ["groupadd", "lowfc", "usermod"]
    assert "exclude each other" in refusal("doctor", "--apply", "--undo")
    assert "leave out --json" in refusal("doctor", "--setup", "--json")
    assert "leave out --device" in refusal("doctor", "--apply", "--device", "isio")
    permissions.undo(tmp_path)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path != device]
    assert device.stat().st_mode & 0o777 == 0o600
    for other in (b"somebody's own\n", b"\xff"):
        (tmp_path / next(iter(permissions.FILES))).write_bytes(other)
        with pytest.raises(ConfigurationError, match="exists with other contents"):
            permissions.apply(tmp_path, "me")
    for fault in (OSError("Read-only file system: '/etc'"), LookupError("no such group: 'lowfc'")):
        monkeypatch.setattr(permissions, "apply", Mock(side_effect=fault))
        failed = lowfc("doctor", "--apply").exception
        assert (type(failed), str(failed)) == (DataFileError, f"the settings cannot be changed completely: {fault}")


def test_the_udev_rule_of_doctor_setup_equals_the_rule_shipped_for_the_services() -> None:
    shipped = Path(__file__).parents[2] / "deploy/udev/70-lowfc.rules"
    assert permissions.FILES["etc/udev/rules.d/90-lowfc-user.rules"] == shipped.read_text()
