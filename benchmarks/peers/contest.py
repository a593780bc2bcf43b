"""Run the contestants, in turn within every repeat, and keep what each run showed."""

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.peers.contestants import PAIR, Contestant
from benchmarks.peers.process import Plan, go, ready_file
from lowfc.adapters.run import free_ports

ROOT = Path(__file__).parents[2]
PRIORITY = 50
_ONLOOKERS_PRIORITY = 10
_MEMORY = Path("/dev/shm")  # noqa: S108  # a folder of one's own is made in it
_READY_S = 60.0
_SETTLE_S = 0.3
_LATER_S = 10.0
_LOOK_S = 0.02
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

SCHEDULING = {"normal": 0, "FIFO": PRIORITY}


class ContestError(Exception):
    """A contestant did not start, or did not come to its end."""


@dataclass(frozen=True)
class Rules:
    """What is the same for all.

    Attributes:
        seconds: that are measured of each run, after `warm_up` frames.
        rate_hz: of the frames.
        pyrtcao: an interpreter that has pyrtcao, if one does.
    """

    seconds: float
    warm_up: int
    rate_hz: float
    pyrtcao: str = sys.executable


def hold(
    contestants: Sequence[Contestant],
    rules: Rules,
    repeats: int,
    scheduling: Sequence[str],
    tell: Callable[[str], None] = lambda _: None,
) -> list[dict[str, Any]]:
    """Run them all, each once in every repeat and scheduling class.

    Returns:
        One row for each contestant and class: contestant, what, scheduling, repeats (the figures of each run that came
        to its end, see `figures`), failures (what is said of the others), and missing where it could not take part.
    """
    rows: list[dict[str, Any]] = [
        {"contestant": one.name, "what": one.what, "scheduling": name, "repeats": [], "failures": []}
        for name in scheduling
        for one in contestants
    ]
    missing = {one.name: _missing(one, rules) for one in contestants}
    for repeat in range(repeats):
        for row, one in zip(rows, [*contestants] * len(scheduling), strict=True):
            if missing[one.name]:
                row["missing"] = missing[one.name]
                continue
            tell(f"repeat {repeat + 1} of {repeats}: {one.name}, {row['scheduling']}")
            try:
                row["repeats"].append(one_run(one, rules, SCHEDULING[row["scheduling"]]))
            except ContestError as fault:
                row["failures"].append(str(fault))
    return rows


def one_run(contestant: Contestant, rules: Rules, priority: int) -> dict[str, Any]:
    """Run one contestant once; figures as `figures` makes them.

    Raises:
        ContestError: it did not start, did not come to its end, or made no command at all.
    """
    frames = rules.warm_up + round(rules.seconds * rules.rate_hz)
    first, second = processors()
    plan = Plan(
        rate_hz=rules.rate_hz,
        frames=frames,
        cpus={role: second if role in ("controller", "signal", "timer") else first for role in contestant.roles},
        priority={
            role: min(priority, _ONLOOKERS_PRIORITY) if role == "onlooker" else priority for role in contestant.roles
        },
        ports=dict(zip(PAIR, free_ports(len(PAIR)), strict=True)),
        options=contestant.options,
    )
    with tempfile.TemporaryDirectory(prefix="lowfc-peers-", dir=_MEMORY) as name:
        folder = Path(name)
        plan.write(folder)
        (folder / "credentials").write_text("contest:contest\n")
        with _awake() if priority else contextlib.nullcontext(), _processes(contestant, rules, folder) as pacer:
            time.sleep(_SETTLE_S)
            go(folder)
            try:
                pacer.wait(frames / rules.rate_hz + _LATER_S)
            except subprocess.TimeoutExpired:
                raise ContestError(f"{contestant.name}: the frames did not come to an end") from None
            if pacer.returncode:
                raise ContestError(f"{contestant.name}: {_said(folder, contestant.pacer)}")
        found = figures(folder, rules.warm_up, observed="onlooker" in contestant.roles)
        if found["frame_to_command"] is None:
            raise ContestError(f"{contestant.name}: no command came: {_said(folder, 'controller')}")
        return found


def figures(folder: Path, warm_up: int, *, observed: bool = False) -> dict[str, Any]:
    """What the times of a run say, its first `warm_up` frames left out.

    Returns:
        frames; without_command of them; sent_late, of them, more than a period after they were due; frame_to_command
        and frame_to_mirror (until the command was back), each p50_us, p99_us, p99_9_us and max_us, None where no
        command came; frames_observed where somebody looks on.
    """
    due, published, commanded, received, seen = (
        np.fromfile(folder / name, np.int64)[1 + warm_up :]
        for name in ("due", "published", "commanded", "received", "observed")
    )
    period_ns = np.diff(due).mean() if due.size > 1 else np.inf
    found = {
        "frames": int(due.size),
        "without_command": int((commanded == 0).sum()),
        "sent_late": int((published - due > period_ns).sum()),
        "frame_to_command": _percentiles(published, commanded),
        "frame_to_mirror": _percentiles(published, received),
    }
    return found | ({"frames_observed": int((seen > 0).sum())} if observed else {})


def processors() -> tuple[int, int]:
    """The first two that this process may run on; the same one twice where there is but one."""
    allowed = sorted(os.sched_getaffinity(0))
    return allowed[0], allowed[1 % len(allowed)]


@contextlib.contextmanager
def _awake() -> Iterator[None]:
    """Idle processors kept awake for everybody, where this user may."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            held.enter_context(Path("/dev/cpu_dma_latency").open("wb", buffering=0)).write(bytes(4))
        yield


def may_run_first() -> bool:
    """Whether this host lets us have SCHED_FIFO."""
    before = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    os.sched_setscheduler(0, before, os.sched_param(0))
    return True


def _percentiles(begun_ns: npt.NDArray[np.int64], ended_ns: npt.NDArray[np.int64]) -> dict[str, float] | None:
    took_us = (ended_ns - begun_ns)[ended_ns > 0] / 1e3
    if not took_us.size:
        return None
    p50, p99, p99_9 = np.percentile(took_us, (50, 99, 99.9), method="inverted_cdf")
    return {"p50_us": float(p50), "p99_us": float(p99), "p99_9_us": float(p99_9), "max_us": float(took_us.max())}


@contextlib.contextmanager
def _processes(contestant: Contestant, rules: Rules, folder: Path) -> "Iterator[subprocess.Popen[bytes]]":
    """Start all processes, one after the other is ready; yield the one that paces, end all."""
    started: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for role in contestant.roles:
            started[role] = _start(contestant, rules, folder, role)
            deadline_s = time.monotonic() + _READY_S
            while not ready_file(folder, role).exists():
                if started[role].poll() is not None or time.monotonic() > deadline_s:
                    raise ContestError(f"{contestant.name}: {role} did not get ready: {_said(folder, role)}")
                time.sleep(_LOOK_S)
        yield started[contestant.pacer]
    except BaseException:
        if contestant.package:  # it may have left streams in shared memory
            _start(contestant, rules, folder, "clear").wait()
        raise
    finally:
        for process in started.values():
            process.kill()
            process.wait()


def _start(contestant: Contestant, rules: Rules, folder: Path, role: str) -> "subprocess.Popen[bytes]":
    with (folder / f"{role}.txt").open("wb") as said:
        return subprocess.Popen(  # noqa: S603  # our own programs
            [_python(contestant, rules), "-m", contestant.module, role, str(folder)],
            cwd=folder,
            env=os.environ | _ONE_THREAD | {"PYTHONPATH": str(ROOT)},
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
        )


def _said(folder: Path, role: str) -> str:
    """The last line of what a process wrote: of a traceback, the fault."""
    lines = (folder / f"{role}.txt").read_text(errors="replace").strip().splitlines()
    return lines[-1][:500] if lines else "it said nothing"


def _python(contestant: Contestant, rules: Rules) -> str:
    return rules.pyrtcao if contestant.package else sys.executable


def _missing(contestant: Contestant, rules: Rules) -> str:
    """Why a contestant cannot take part; empty where it can."""
    if not contestant.package:
        return ""
    python = _python(contestant, rules)
    asked = f"import importlib.metadata as m; m.version({contestant.package!r})"
    try:
        done = subprocess.run([python, "-c", asked], capture_output=True, check=False)  # noqa: S603  # an interpreter
    except OSError as fault:
        return f"not run: {python} cannot be started ({fault.strerror})"
    if not done.returncode:
        return ""
    return (
        f"not installed: python -m venv DIR && DIR/bin/pip install {contestant.package}, then "
        f"--{contestant.package} DIR/bin/python"
    )
