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

ROLES = {
    "sim_camera": "camera",
    "lowfc.programs.measure.frame_source": "camera",
    "lowfc controller": "controller",
    "sim_dm": "mirror",
    "lowfc record": "recorder",
    "lowfc view": "view",
}
"""Role of a process, by the module that Python runs."""
LOOP = {"camera", "controller", "mirror"}

_SAMPLING_PERIOD_S = 0.2
_FRACTION = 0.8  # the use of processors is averaged over this last fraction of the duration
_START_S, _TIMEOUT_RATIO = 60.0, 12.0  # a command must end within _START_S + _TIMEOUT_RATIO times its --duration


class Usage(NamedTuple):
    """Processor time of a process since its start, and its permitted processors and memory when sampled."""

    used_s: float
    processors: str
    resident_bytes: int


class Sample(NamedTuple):
    """Usage of every process at one time, by role."""

    at_s: float
    roles: dict[str, Usage]


@contextlib.contextmanager
def sampled_processes() -> Iterator[list[Sample]]:
    """Sample the child processes five times a second within a `with` block; `shares` evaluates the samples."""
    samples: list[Sample] = []
    ended = threading.Event()

    def take_samples() -> None:
        while not ended.wait(_SAMPLING_PERIOD_S):
            samples.append(_sampled())

    thread = threading.Thread(target=take_samples, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        ended.set()
        thread.join()


def _sampled() -> Sample:
    sample = Sample(time.monotonic(), {})
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # the process has ended meanwhile
            role = role_of(process.cmdline())
            if role is not None:
                times, cpus = process.cpu_times(), ",".join(map(str, process.cpu_affinity()))
                sample.roles[role] = Usage(times.user + times.system, cpus, process.memory_info().rss)
    return sample


def shares(samples: Sequence[Sample], seconds: float) -> dict[str, Result]:
    """Use of processors and memory by each role in the last 80 % of the `seconds` for which frames are sent.

    `share`: processor time of all threads / elapsed time. `processors` (permitted) and `mb` are those at the end. The
    result is empty if fewer than two samples were taken in that time.
    """
    complete = [sample for sample in samples if sample.roles.keys() >= LOOP][:-1]  # the last may be from the shutdown
    averaged = [sample for sample in complete if sample.at_s >= complete[-1].at_s - _FRACTION * seconds]
    if len(averaged) < 2:
        return {}
    first, last = averaged[0], averaged[-1]
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
    """Role of a process, from its command line; None if its module is not in `ROLES`."""
    module = arguments[arguments.index("-m") + 1 :] if "-m" in arguments else []
    return ROLES.get(" ".join(module[:1])) or ROLES.get(" ".join(module[:2]))


def run_lowfc(arguments: Sequence[str], seconds: float) -> dict[str, Any]:
    """JSON output of `lowfc` with these arguments, and the result of `shares` as `usage`.

    `failure` replaces both if the command fails: the last line of its standard error, or the timeout.
    """
    command = [sys.executable, "-P", "-m", "lowfc", *arguments, "--duration", f"{seconds:g}", "--json"]
    timeout_s = _START_S + _TIMEOUT_RATIO * seconds
    with tempfile.TemporaryDirectory() as folder, sampled_processes() as samples:
        options: dict[str, Any] = {"cwd": folder, "env": os.environ | {"XDG_RUNTIME_DIR": folder}}
        try:
            completed = subprocess.run(  # noqa: S603  # lowfc itself
                command, **options, capture_output=True, text=True, timeout=timeout_s, check=False
            )
        except subprocess.TimeoutExpired:
            return {"failure": f"the command had not ended after {timeout_s:g} s"}
    if completed.returncode:
        last_line = "".join(completed.stderr.strip().splitlines()[-1:])
        return {"failure": last_line or f"exit status {completed.returncode}"}
    found: dict[str, Any] = json.loads(completed.stdout)
    return found | {"usage": shares(samples, seconds)}
