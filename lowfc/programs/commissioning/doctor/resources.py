"""Checks of resources: memory, libraries, sockets, disk, files, certificates."""

import datetime

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from lowfc.adapters.bus.own_certificate import WARN_DAYS
from lowfc.adapters.bus.routed import certificate_warnings
from lowfc.adapters.process import compiled
from lowfc.contract.codecs.input_file import user_path
from lowfc.control.kernel.tables import FUSED
from lowfc.control.loop.wording import counted
from lowfc.programs.commissioning.checks import Check, Table, note, ok, warning
from lowfc.programs.commissioning.doctor.facts import Facts
from lowfc.programs.core.recording.volume import bytes_per_s, configured_selection

CHECKS: Table[Facts] = Table()
"""The docstring of each check describes what it examines; docs/howto/doctor.md also describes its warning."""

_STALL_S = 0.1  # stall of a reader that socket buffers should outlast
_MIN_OPEN_FILES = 256  # smallest limit of open files that suffices for a process
_MEMLOCK_ADVICE = "`lowfc doctor --setup` (memlock unlimited in limits.d), or the service's LimitMEMLOCK=infinity"


@CHECKS.check("locked memory")
def _locked_memory(facts: Facts) -> Check:
    """Locking a process's memory, as the loop requests it."""
    if not facts.config.realtime.lock_memory:
        return note("not requested by the configuration: realtime.lock_memory = false")
    if refused := facts.completed_trial.refused.get("lock_memory"):
        reason, cost = refused
        return warning(f"refused: {reason}", _MEMLOCK_ADVICE, cost)
    return ok("granted")


@CHECKS.check("swap")
def _swap(facts: Facts) -> Check:
    """Swap space, and whether the loop's memory can be swapped out."""
    total_bytes, used_bytes = facts.host.swap()
    if not total_bytes:
        return ok("none")
    detail = f"{used_bytes / 1e6:.0f} MB in use of {total_bytes / 1e6:.0f} MB"
    if facts.config.realtime.lock_memory and "lock_memory" not in facts.completed_trial.refused:
        return ok(f"{detail}; the loop's memory is locked")
    return warning(
        f"{detail}; the loop's memory is not locked",
        f"swapoff --all; or {_MEMLOCK_ADVICE}",
        "a page that was swapped out stalls the loop for milliseconds",
    )


@CHECKS.check(
    "huge pages",
    advice="echo madvise > /sys/kernel/mm/transparent_hugepage/enabled, or boot with transparent_hugepage=madvise",
    cost="a page fault may clear or gather 2 MB in the middle of a frame",
)
def _huge_pages(facts: Facts) -> Check:
    """Moving memory to huge pages, as the loop does, and the kernel's setting `transparent_hugepage/enabled`."""
    if refused := facts.completed_trial.refused.get("huge_pages"):
        reason, cost = refused
        return warning(f"refused: {reason}", "a kernel of version 6.1 or newer, with transparent huge pages", cost)
    text = facts.host.text("sys/kernel/mm/transparent_hugepage/enabled")
    setting = text[text.index("[") + 1 : text.index("]")]
    return ok(setting) if setting != "always" else warning(setting)


@CHECKS.check(
    "BLAS",
    advice="start the loop with OMP_NUM_THREADS=1, OPENBLAS_NUM_THREADS=1 and MKL_NUM_THREADS=1",
    cost="threads of a small matrix product wait for each other on the loop's processors",
)
def _blas(facts: Facts) -> Check:
    """Libraries of linear algebra in numpy, and whether they can be limited to one thread, as in the loop."""
    names = ", ".join(f"{name}, {counted(threads, 'thread')}" for name, threads in sorted(_blas_threads().items()))
    with threadpool_limits(limits=1):
        limited = _blas_threads()
    if limited and max(limited.values()) == 1:
        return ok(f"{names}; the loop limits them to one")
    return warning(names or f"none that threadpoolctl knows, in numpy {np.__version__}")


@CHECKS.check("control step")
def _control_step(facts: Facts) -> Check:
    """Implementation of the control step, `realtime.kernel`: numpy, or the fused step, which needs the extra `fast`."""
    available = compiled.available()
    if facts.config.realtime.kernel == FUSED:
        return ok("the fused step") if available else warning("numpy, not the fused step", compiled.advice())
    advice = 'realtime.kernel = "fused"' if available else compiled.advice()
    return note("numpy", advice, "a longer latency from frame to command: see `lowfc latency --kernel both`")


@CHECKS.check("socket buffers")
def _socket_buffers(facts: Facts) -> Check:
    """Bytes that sockets buffer for a slow reader: `net.core.{r,w}mem_{default,max}` and `net.ipv4.tcp_{r,w}mem`."""
    net, read = "proc/sys/net", facts.host.text
    default_bytes, largest_bytes = (
        min(int(read(f"{net}/core/{direction}mem_{size}")) for direction in "rw") for size in ("default", "max")
    )
    tcp_bytes = min(int(read(f"{net}/ipv4/tcp_{direction}mem").split()[2]) for direction in "rw")
    held_s = tcp_bytes / facts.bytes_per_s
    detail = (
        f"TCP up to {tcp_bytes / 1e3:.0f} kB, {held_s * 1e3:.0f} ms of the loop's traffic; other sockets "
        f"{default_bytes / 1e3:.0f} kB, at most {largest_bytes / 1e3:.0f} kB"
    )
    if held_s >= _STALL_S:
        return ok(detail)
    need = round(facts.bytes_per_s * _STALL_S)
    return warning(
        detail,
        f"raise the third value of sysctl net.ipv4.tcp_rmem and net.ipv4.tcp_wmem to {need} or more",
        f"a reader that stalls for more than {held_s * 1e3:.0f} ms loses messages unnecessarily",
    )


@CHECKS.check("disk")
def _disk(facts: Facts) -> Check:
    """Free space in `recorder.folder`, and how long it lasts at `camera.rate_hz` by the recorder's estimate."""
    section, rate_hz = facts.config.recorder, facts.config.camera.rate_hz
    folder = user_path(section.folder)
    free_bytes, writable = facts.host.disk(folder)
    growth_bytes_per_s = bytes_per_s(facts.config, configured_selection(facts.config))
    lasts_s = max(0.0, free_bytes - section.min_free_mb * 1e6) / growth_bytes_per_s
    detail = (
        f"{folder.absolute()}: {free_bytes / 1e9:.1f} GB free, enough for {lasts_s / 3600:.1f} h at {rate_hz:g} Hz, "
        f"{growth_bytes_per_s * 3.6e-6:.1f} GB an hour"
    )
    if not writable:
        return warning(f"{detail}; not writable", "set recorder.folder to a writable folder", "nothing is recorded")
    if lasts_s >= section.longest_s:
        return ok(detail)
    return warning(
        detail,
        "make room, or set recorder.folder to a larger disk",
        f"recording ends when {section.min_free_mb:g} MB are left (recorder.min_free_mb); the loop goes on",
    )


@CHECKS.check(
    "open files", advice="ulimit -n 1024, or LimitNOFILE=1024 of the service", cost="a process may fail to join the bus"
)
def _open_files(facts: Facts) -> Check:
    """Limit of open files and sockets of a process."""
    limit = facts.host.max_open_files()
    detail = "no limit" if limit is None else f"{limit}"
    return ok(detail) if limit is None or limit >= _MIN_OPEN_FILES else warning(detail)


@CHECKS.check(
    "certificates",
    advice="lowfc certs FOLDER --renew where the authority's key is, and copy each ROLE.pem here",
    cost="existing links persist; processes and routers that start after the expiry are rejected",
)
def _certificates(facts: Facts) -> Check:
    """Certificates in this host's folder, `network.certificates`, if the loop uses a router."""
    network = facts.config.network
    if not network.router:
        return ok("none needed: the configuration names no router")
    warnings = certificate_warnings(network, datetime.datetime.now(datetime.UTC))
    if not warnings:
        return ok(f"all in {network.certificates} are valid for more than {WARN_DAYS} days")
    return warning("; ".join(warnings))


def _blas_threads() -> dict[str, int]:
    return {
        f"{library['internal_api']} {library['version']}": library["num_threads"]
        for library in threadpool_info()
        if library["user_api"] == "blas"
    }
