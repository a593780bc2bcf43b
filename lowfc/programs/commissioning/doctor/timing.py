"""Checks of scheduling and timing: processors, kernel, clocks, other processes."""

import re
import time
import timeit

import numpy as np

from lowfc.adapters.process.clock import WALL_TOLERANCE_NS, HostClock, boot_file
from lowfc.adapters.process.host import CPUS
from lowfc.adapters.process.join import fifo_priority
from lowfc.adapters.process.trial import Trial
from lowfc.programs.commissioning.checks import Check, Table, note, ok, warning
from lowfc.programs.commissioning.doctor.facts import Facts, named_cpus, ranges

CHECKS: Table[Facts] = Table()
"""The docstring of each check describes its subject; docs/howto/doctor.md also describes its warning."""

PROCESSES = ("camera", "controller", "mirror", "recorder")

_IN_LOOP = 3  # number of these processes that are in the control loop
_SLOW_EXIT_US = 50  # longest acceptable exit from an idle state
_SLOW_SOURCES = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
_SLOW_READING_NS = 1000
_READINGS = 200  # number of readings of the clock that are timed together
_MAX_WAKE_UP_PERIODS = 0.1  # largest acceptable p99 of the wake-up latency, frame periods
_STOLEN = 1e-3  # fraction of stolen time above which the report says that it is much
_BUSY = 0.1  # smallest share of a processor that is reported
_BUSY_SHOWN = 3


@CHECKS.check("scheduling class")
def _scheduling_class(facts: Facts) -> Check:
    """SCHED_FIFO at `realtime.priority`, requested as the loop requests it."""
    priority = fifo_priority(facts.config)
    if not priority:
        reason = "lockstep" if facts.config.lockstep else "realtime.priority = 0"
        return note(f"the configuration requests normal scheduling: {reason}")
    if refused := facts.completed_trial.refused.get("priority"):
        reason, cost = refused
        advice = f"`lowfc doctor --setup` (rtprio {priority} in limits.d), or the service's LimitRTPRIO={priority}"
        return warning(f"refused: {reason}", advice, cost)
    return ok(f"SCHED_FIFO priority {priority} is granted")


@CHECKS.check("real-time share")
def _realtime_share(facts: Facts) -> Check:
    """Share of a processor for real-time processes: `kernel.sched_rt_runtime_us`."""
    share = "proc/sys/kernel/sched_rt_{}_us"
    runtime_us, period_us = (int(facts.host.text(share.format(name))) for name in ("runtime", "period"))
    if runtime_us < 0:
        return ok("real-time processes may use all of a processor")
    detail = f"real-time processes may use {runtime_us / 1e3:g} ms of every {period_us / 1e3:g} ms"
    advice = "a processor for each of camera, controller and mirror, or sysctl kernel.sched_rt_runtime_us=-1"
    if runtime_us == 0:
        return warning(detail, "sysctl kernel.sched_rt_runtime_us=950000", "SCHED_FIFO is refused to all processes")
    if len(facts.host.usable_cpus()) >= _IN_LOOP:
        return ok(detail)
    cost = f"real-time processes that use up their share of a processor stall for {(period_us - runtime_us) / 1e3:g} ms"
    return note(detail, advice, cost)


@CHECKS.check("processors")
def _processors(facts: Facts) -> Check:
    """Processors available to the loop's processes, and those in the configuration."""
    usable, online = facts.host.usable_cpus(), facts.host.cpus("online")
    detail = f"{len(usable)} usable ({ranges(usable)}) of {len(online)}"
    named = named_cpus(facts.config)
    if named and (missing := named - facts.completed_trial.cpus):
        return warning(
            f"{detail}; the configuration names {ranges(missing)}, on which lowfc cannot run",
            "correct realtime.camera_cpus, controller_cpus, mirror_cpus and recorder_cpus",
            "the kernel moves the loop between processors; expect a longer tail of the latencies",
        )
    if len(usable | named) < len(PROCESSES):
        return warning(
            f"{detail}, for {len(PROCESSES)} processes: {', '.join(PROCESSES)}",
            f"a host with {len(PROCESSES)} processors or more; if it has them, a wider affinity (taskset, cpuset)",
            "the processes wait for each other: a longer tail of the latencies, and a lower maximum rate",
        )
    return ok(detail)


@CHECKS.check("isolation")
def _isolation(facts: Facts) -> Check:
    """Processors kept free of other programs: `isolcpus` and `nohz_full`."""
    isolated, online = facts.host.cpus("isolated"), facts.host.cpus("online")
    cost = "other programs and the kernel's own work share the loop's processors; expect a longer tail of the latencies"
    if not isolated:
        if len(online) <= len(PROCESSES):
            return note(f"none is isolated, and none of the {len(online)} can be spared")
        spare = ranges(sorted(online)[-_IN_LOOP:])
        advice = f"boot with isolcpus={spare} nohz_full={spare} and name them in realtime.*_cpus"
        return warning("none", advice, cost)
    without_tick = ranges(isolated & facts.host.cpus("nohz_full")) or "none"
    detail = f"{ranges(isolated)}; of these without a timer tick: {without_tick}"
    section = facts.config.realtime
    named = {*section.camera_cpus, *section.controller_cpus, *section.mirror_cpus}
    if named and named <= isolated:
        return ok(detail)
    return warning(
        f"{detail}; the configuration names {ranges(named) or 'none'}",
        "name isolated processors in realtime.camera_cpus, controller_cpus and mirror_cpus",
        cost,
    )


@CHECKS.check(
    "quota",
    advice="remove it: CPUQuota= of the service, --cpus of the container",
    cost="once it is used up, every process stalls until the quota is renewed",
)
def _quota(facts: Facts) -> Check:
    """Limits of processor time on this process's control groups, such as a container's."""
    cpus = facts.host.quota_cpus()
    return ok("none") if cpus is None else warning(f"{cpus:g} processors' worth of time")


@CHECKS.check(
    "frequency",
    advice="cpupower frequency-set --governor performance",
    cost="a processor slows down while waiting for a frame, and computes the next one slowly",
)
def _frequency(facts: Facts) -> Check:
    """Frequency governor of the usable processors, and turbo."""
    read, cpus = facts.host.text_or_nothing, facts.host.usable_cpus()
    governors = {read(f"{CPUS}/cpu{cpu}/cpufreq/scaling_governor") for cpu in cpus} - {""}
    if not governors:
        return note("not shown; in a virtual machine the hypervisor decides")
    turbo = {"0": "on", "1": "off"}.get(read(f"{CPUS}/intel_pstate/no_turbo"))
    turbo = turbo or {"0": "off", "1": "on"}.get(read(f"{CPUS}/cpufreq/boost"))
    detail = ", ".join(sorted(governors)) + (f", turbo {turbo}" if turbo else "")
    return ok(detail) if governors == {"performance"} else warning(detail)


@CHECKS.check("idle states")
def _idle_states(facts: Facts) -> Check:
    """Depth of processor sleep: the driver and the longest exit latency of the states in use."""
    host, folder = facts.host, f"{CPUS}/cpu{min(facts.host.usable_cpus())}/cpuidle"
    driver, states = host.text(f"{CPUS}/cpuidle/current_driver"), sorted((host.root / folder).glob("state*"))
    rows = [[host.text(f"{folder}/{state.name}/{key}") for key in ("latency", "name", "disable")] for state in states]
    used = [(int(exit_us), name) for exit_us, name, disabled in rows if disabled == "0"]
    if driver == "none" or not used:
        return note(f"driver {driver}, no states shown; in a virtual machine the hypervisor decides")
    exit_us, deepest = max(used)
    detail = f"driver {driver}, deepest state {deepest} with {exit_us} us to wake"
    if facts.config.realtime.disable_cpu_idle:
        if refused := facts.completed_trial.refused.get("disable_cpu_idle"):
            reason, cost = refused
            return warning(
                f"{detail}; not granted: {reason}",
                "`lowfc doctor --setup`: a udev rule, and this user in its group",
                cost,
            )
        return ok(f"{detail}; kept awake while the loop runs")
    if exit_us <= _SLOW_EXIT_US:
        return ok(detail)
    return warning(
        detail,
        f"cpupower idle-set --disable-by-latency {_SLOW_EXIT_US}, or boot with processor.max_cstate=1",
        f"a frame that wakes a processor may wait {exit_us} us for it",
    )


@CHECKS.check("kernel")
def _kernel(facts: Facts) -> Check:
    """Preemption model of the kernel."""
    version = facts.host.text("proc/version").split()
    release = version[2]
    advice = "boot with preempt=full, or a kernel with PREEMPT_RT"
    cost = "a frame may have to wait for the end of another program's system call"
    if "PREEMPT_RT" in version:
        return ok(f"{release}, PREEMPT_RT")
    if "PREEMPT_DYNAMIC" in version:
        model = re.search(r"\((\w+)\)", facts.host.text_or_nothing("sys/kernel/debug/sched/preempt"))
        model = model or re.search(r"(?:^| )preempt=(\w+)", facts.host.text("proc/cmdline"))
        if model is None:
            return note(f"{release}, PREEMPT_DYNAMIC; the preemption model cannot be read", advice, cost)
        detail = f"{release}, PREEMPT_DYNAMIC, {model[1]}"
        return ok(detail) if model[1] == "full" else warning(detail, advice, cost)
    if "PREEMPT" in version:
        return ok(f"{release}, PREEMPT")
    return warning(f"{release}, no preemption of the kernel", advice, cost)


@CHECKS.check(
    "virtualisation",
    advice="bare metal, or processors dedicated to this virtual machine",
    cost="the hypervisor may suspend a processor at any time, in any scheduling class",
)
def _virtualisation(facts: Facts) -> Check:
    """Hypervisor, and the processor time stolen by it since boot."""
    read = facts.host.text_or_nothing
    flags = re.search(r"^flags\s*:(.*)$", facts.host.text("proc/cpuinfo"), re.MULTILINE)
    kind, stolen = read("sys/hypervisor/type"), facts.host.stolen_share()
    if not kind and flags is None:
        raise ValueError("this processor's /proc/cpuinfo does not show whether there is a hypervisor")
    if not kind and flags is not None and "hypervisor" not in flags[1].split():
        return ok("none")
    machine = [read(f"sys/class/dmi/id/{name}") for name in ("sys_vendor", "product_name")]
    name = " ".join(filter(None, [kind, *machine])) or "unknown"
    much = "; that is much" if stolen > _STOLEN else ""
    return warning(f"a virtual machine ({name}); {100 * stolen:.2f} % of its time stolen since boot{much}")


@CHECKS.check(
    "clock source",
    advice="on x86, boot with clocksource=tsc, and with tsc=reliable if the processor's counter is stable",
    cost="every process reads the time several times a frame",
)
def _clock_source(facts: Facts) -> Check:
    """Time source of the kernel, and the duration of a reading."""
    source = facts.host.clock_source()
    reading_ns = min(timeit.repeat(time.monotonic_ns, number=_READINGS, repeat=10)) * 1e9 / _READINGS
    detail = f"{source}, {reading_ns:.0f} ns for a reading"
    return ok(detail) if source not in _SLOW_SOURCES and reading_ns <= _SLOW_READING_NS else warning(detail)


@CHECKS.check(
    "synchronisation",
    advice="run chronyd (with rtcsync), ntpd, systemd-timesyncd or phc2sys before the first run after a boot",
    cost="the first run after a boot sets the clock of all runs to CLOCK_REALTIME: times in logs keep its error of "
    "that moment, and times of two hosts cannot be compared; later steps of CLOCK_REALTIME do not affect the loop",
)
def _synchronisation(facts: Facts) -> Check:
    """Whether a daemon synchronises CLOCK_REALTIME, and the error that the kernel reports."""
    clock = facts.host.synchronisation()
    if clock.synchronised:
        return ok(f"synchronised; {clock.offset_s * 1e6:.0f} us to correct, error at most {clock.error_s * 1e3:.1f} ms")
    return warning("not synchronised: CLOCK_REALTIME may be wrong, and steps when it is set")


@CHECKS.check("boot's clock")
def _boot_clock(facts: Facts) -> Check:
    """Clock of all runs minus CLOCK_REALTIME; the first run after a boot sets the former to the latter."""
    file = boot_file()
    if not file.exists():
        return ok("not set yet: the first process of a run sets it")
    ahead_ns = HostClock(file.parent).ahead_ns()
    detail = f"{ahead_ns / 1e6:+.1f} ms from CLOCK_REALTIME"
    if abs(ahead_ns) <= WALL_TOLERANCE_NS:
        return ok(detail)
    return warning(
        detail,
        f"once CLOCK_REALTIME is right: stop all lowfc processes, remove {file} and start them again",
        "the times in logs are off by this much; the loop is not affected",
    )


@CHECKS.check(
    "wake-up",
    advice="see the checks scheduling class, processors, idle states, virtualisation and load; `lowfc latency --trace` "
    "shows which stalls of a loop are caused by the host",
    cost="every frame waits this long before processing, however fast the loop computes",
)
def _wake_up(facts: Facts) -> Check:
    """Latency of timer wake-ups, 1000 in one second, in normal scheduling and, if granted, SCHED_FIFO."""
    wake_up = wake_up_us(facts.completed_trial)
    detail = "; ".join(
        f"{name}: p50 {late_us['p50']:.0f} us, p99 {late_us['p99']:.0f} us, max {late_us['max']:.0f} us"
        for name, late_us in wake_up.items()
    )
    best = list(wake_up.values())[-1]
    period_us = facts.config.period_ns / 1e3
    if best["p99"] <= _MAX_WAKE_UP_PERIODS * period_us and best["max"] <= period_us:
        return ok(detail)
    return warning(f"{detail}; a frame period is {period_us:.0f} us")


def wake_up_us(trial: Trial) -> dict[str, dict[str, float]]:
    """Percentiles of the wake-up latency, us, by scheduling class; the best class last."""
    classes = {"normal": trial.normal_ns, "SCHED_FIFO": trial.fifo_ns}
    return {
        name: dict(zip(("p50", "p99", "max"), (np.percentile(late_ns, (50, 99, 100)) / 1e3).tolist(), strict=True))
        for name, late_ns in classes.items()
        if late_ns
    }


@CHECKS.check(
    "load",
    advice="end other busy processes, or keep them off the loop's processors",
    cost="with normal scheduling they delay the loop; under SCHED_FIFO they still evict its caches",
)
def _load(facts: Facts) -> Check:
    """Load average, and other processes that were busy during the measurement."""
    load, cpus = facts.host.load(), len(facts.host.usable_cpus())
    busy = [(name, share) for name, share in facts.busy if share > _BUSY]
    names = ", ".join(f"{name} {100 * share:.0f} %" for name, share in busy[:_BUSY_SHOWN]) or "none"
    detail = f"{load:.2f} in the last minute, {cpus} processors; busy now: {names}"
    return ok(detail) if not busy and load <= cpus else warning(detail)
