"""Run a lowfc command for a benchmark, and measure the processor time and memory of its processes."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import psutil

from benchmarks.runner import Result

MODULES = {
    "sim_camera": "camera",
    "lowfc.programs.measure.frame_source": "camera",
    "lowfc controller": "controller",
    "sim_dm": "mirror",
    "lowfc record": "recorder",
    "lowfc view": "view",
}
"""Roles in the loop by the module that Python runs."""
LOOP = {"camera", "controller", "mirror"}

_EVERY_S = 0.2
_FRACTION = 0.8  # the use of processors is averaged over this last fraction of the duration
_START_S, _TIMEOUT_RATIO = 60.0, 12.0


class Used(NamedTuple):
    """Processor time of a process so far, and its permitted processors and memory at that time."""

    used_s: float
    processors: str
    resident_bytes: int


class Moment(NamedTuple):
    """Sample of all processes at one time, by role."""

    at_s: float
    roles: dict[str, Used]


@contextlib.contextmanager
def sampled_processes() -> Iterator[list[Moment]]:
    """Sample the child processes five times a second within a `with` block; `shares` evaluates the samples."""
    moments: list[Moment] = []
    ended = threading.Event()

    def sample() -> None:
        while not ended.wait(_EVERY_S):
            moments.append(_moment())

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield moments
    finally:
        ended.set()
        thread.join()


def _moment() -> Moment:
    moment = Moment(time.monotonic(), {})
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # the process has ended meanwhile
            role = role_of(process.cmdline())
            if role is not None:
                times, cpus = process.cpu_times(), ",".join(map(str, process.cpu_affinity()))
                moment.roles[role] = Used(times.user + times.system, cpus, process.memory_info().rss)
    return moment


def shares(moments: Sequence[Moment], seconds: float) -> dict[str, Result]:
    """Use of processors and memory by each role over the last 80 % of the frames, which are sent for `seconds`.

    `share`: processor time of all threads, in processors. Empty with fewer than two samples in that time.
    """
    complete = [moment for moment in moments if moment.roles.keys() >= LOOP][:-1]  # the last may be from the shutdown
    inside = [moment for moment in complete if moment.at_s >= complete[-1].at_s - _FRACTION * seconds]
    if len(inside) < 2:
        return {}
    first, last = inside[0], inside[-1]
    return {
        role: {
            "share": (used.used_s - first.roles[role].used_s) / (last.at_s - first.at_s),
            "processors": used.processors,
            "mb": used.resident_bytes / 1e6,
        }
        for role, used in last.roles.items()
        if role in first.roles
    }


def role_of(arguments: Sequence[str]) -> str | None:
    """Role of a process in the loop, from its command line; None if it has none."""
    module = arguments[arguments.index("-m") + 1 :] if "-m" in arguments else []
    return MODULES.get(" ".join(module[:1])) or MODULES.get(" ".join(module[:2]))


def run_lowfc(arguments: Sequence[str], seconds: float) -> dict[str, Any]:
    """JSON output of `lowfc` with these arguments, and `usage` by `shares`.

    `failure` replaces both if the command fails: the last line of its standard error, or the timeout.
    """
    command = [sys.executable, "-P", "-m", "lowfc", *arguments, "--duration", f"{seconds:g}", "--json"]
    timeout_s = _START_S + _TIMEOUT_RATIO * seconds
    with tempfile.TemporaryDirectory() as folder, sampled_processes() as moments:
        where: dict[str, Any] = {"cwd": folder, "env": os.environ | {"XDG_RUNTIME_DIR": folder}}
        try:
            done = subprocess.run(  # noqa: S603  # lowfc itself
                command, **where, capture_output=True, text=True, timeout=timeout_s, check=False
            )
        except subprocess.TimeoutExpired:
            return {"failure": f"not done after {timeout_s:g} s"}
    if done.returncode:
        return {"failure": "; ".join(done.stderr.strip().splitlines()[-1:]) or f"exit status {done.returncode}"}
    found: dict[str, Any] = json.loads(done.stdout)
    return found | {"usage": shares(moments, seconds)}
