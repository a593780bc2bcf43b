"""Other ways to close the same loop beside lowfc, at the same sizes, on this host, at the same time.

The contestants take turns within every repeat, once in the normal scheduling class and once under SCHED_FIFO.

Example:
    python -m benchmarks peers --pyrtcao DIR/bin/python
"""

import argparse
import contextlib
import importlib.metadata
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.peers.shared import ACTUATORS, GRID, MODES, SHAPE, Plan, go, ready_file
from benchmarks.runner import Lines, Result, Tell, add_times, ranged
from benchmarks.sizes import Size, configuration, run_loop
from lowfc.adapters.bus.run import free_ports
from lowfc.adapters.process.child import Child
from lowfc.contract.errors import ConfigurationError, LowfcError
from lowfc.programs.measure.latency.figures import percentiles

ROOT = Path(__file__).parents[2]
PRIORITY = 50
SCHEDULING = {"normal": 0, "FIFO": PRIORITY}

_MEMORY = Path("/dev/shm")  # noqa: S108  # a folder of one's own is made in it
_READY_S, _SETTLE_S, _LATER_S, _LOOK_S, _PATIENCE_S = 60.0, 0.3, 10.0, 0.02, 0.5
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


class ContestError(Exception):
    """A contestant did not start, or did not come to its end."""


@dataclass(frozen=True)
class Contestant:
    """One row of the table.

    Attributes:
        name: in the table.
        what: it is, in a sentence.
        roles: its processes in the order in which they start; the source's end is the end of a run. None: lowfc itself.
        module: whose roles its processes play.
        package: that must be installed in the interpreter of its processes, beside what lowfc needs.
    """

    name: str
    what: str
    roles: tuple[str, ...] = ()
    module: str = "benchmarks.peers.plain_zenoh"
    package: str = ""


BARE = "zenoh"
CONTESTANTS = (
    Contestant(
        BARE,
        "zenoh as it comes, in sessions set up as lowfc's, the step in numpy, in the subscriber's callback",
        ("source", "controller"),
    ),
    Contestant(
        "lowfc",
        "its controller and mirror as they run, frames made beforehand: the loop of `lowfc latency`, of this size",
    ),
    Contestant(
        "pyrtcao, fused",
        "WavefrontSensor, one component of one's own with all of the step compiled, and WavefrontCorrector, each a "
        "process; in the normal class it sets nice -20 where it may",
        ("mirror", "source", "controller"),
        module="benchmarks.peers.pyrtcao_loop",
        package="pyrtcao",
    ),
)

DEFINITIONS = {
    "t0": "just before the source sends a frame: before the put, or pyrtcao's WavefrontSensor.expose",
    "t1": "just after the controller has sent the frame's command: after the put, or pyrtcao's "
    "write_stream; for lowfc after its socket's send, before zenoh's",
    "to the mirror": "from t0 until the command is in the mirror's process: the source's own, on its receiving thread; "
    "for pyrtcao the corrector's process, its actuators made; for lowfc until just before the mirror's state is put",
    "clock": "CLOCK_MONOTONIC, one host",
    "pacing": "the source sleeps until absolute times; a late frame is sent at once, its t0 is when it was sent, and "
    "none is left out",
    "cells": "us, median (lowest to highest) over the repeats; contestants and classes take turns within every repeat",
    "without a command": "measured frames that no command was made from: median over the repeats, of how many",
    "pinning": "source and mirror on the first processor, controller on the second",
    "threads": "BLAS and numba 1; garbage collection off everywhere",
    "FIFO": f"SCHED_FIFO {PRIORITY} for all, idle processors kept awake",
}


def options(parser: argparse.ArgumentParser) -> None:
    """How long, how often, how fast, and who."""
    add_times(parser, seconds=8.0, repeats=5)
    parser.add_argument("--warm-up", type=int, default=500, help="frames before (%(default)s)")
    parser.add_argument("--rate", dest="rate_hz", type=float, default=1000.0, help="frames per second (%(default)g)")
    parser.add_argument("--only", action="append", metavar="WORD", help="contestants with this in their name; repeat")
    parser.add_argument("--pyrtcao", default=sys.executable, metavar="PYTHON", help="an interpreter that has pyrtcao")


def measure(options: argparse.Namespace, tell: Tell) -> Result:
    """Hold the contest.

    Returns:
        rows, one for each contestant and class: contestant, what, scheduling, repeats (figures of each run that came to
        its end, see `figures`), failures (why the others did not), and missing where it could not take part;
        rules, notes, pinned_to, versions and failed.
    """
    chosen = [one for one in CONTESTANTS if any(word in one.name for word in options.only or [""])]
    if not chosen:
        raise ConfigurationError(f"--only: none of {'; '.join(one.name for one in CONTESTANTS)}")
    classes, notes = list(SCHEDULING), []
    if not may_run_first():
        classes.remove("FIFO")
        notes.append(f"FIFO: this host does not allow SCHED_FIFO {PRIORITY} (LimitRTPRIO=, CAP_SYS_NICE).")
    rows: list[dict[str, Any]] = [
        {"contestant": one.name, "what": one.what, "scheduling": name, "repeats": [], "failures": []}
        for name in classes
        for one in chosen
    ]
    missing = {one.name: _missing(one, options.pyrtcao) for one in chosen}
    for repeat in range(options.repeats):
        for row, one in zip(rows, [*chosen] * len(classes), strict=True):
            if missing[one.name]:
                row["missing"] = missing[one.name]
                continue
            tell(f"repeat {repeat + 1} of {options.repeats}: {one.name}, {row['scheduling']}")
            try:
                row["repeats"].append(one_run(one, options, SCHEDULING[row["scheduling"]]))
            except (ContestError, LowfcError) as fault:
                row["failures"].append(f"{one.name}: {fault}")
    return {
        "rows": rows,
        "rules": {name: getattr(options, name) for name in ("repeats", "seconds", "warm_up", "rate_hz")},
        "notes": notes,
        "pinned_to": list(processors()),
        "versions": _versions(options.pyrtcao),
        "failed": [fault for row in rows for fault in row["failures"]],
    }


def one_run(contestant: Contestant, rules: argparse.Namespace, priority: int) -> dict[str, Any]:
    """Run one contestant once; figures as `figures` makes them.

    Raises:
        ContestError: it did not start, did not come to its end, or made no command at all.
        LowfcError: the same of lowfc's loop.
    """
    if not contestant.roles:
        return _lowfc(rules, priority)
    frames = rules.warm_up + round(rules.seconds * rules.rate_hz)
    first, second = processors()
    plan = Plan(
        rate_hz=rules.rate_hz,
        frames=frames,
        cpus={role: second if role == "controller" else first for role in contestant.roles},
        priority=dict.fromkeys(contestant.roles, priority),
        ports=dict(zip(("source", "controller"), free_ports(2), strict=True)),
    )
    with tempfile.TemporaryDirectory(prefix="lowfc-peers-", dir=_MEMORY) as name:
        folder = Path(name)
        plan.write(folder)
        (folder / "credentials").write_text("contest:contest\n")
        with _awake(priority), _processes(contestant, rules.pyrtcao, folder) as children:
            time.sleep(_SETTLE_S)
            go(folder)
            pacer = children["source"]
            deadline_s = time.monotonic() + frames / rules.rate_hz + _LATER_S
            while pacer.status is None and time.monotonic() < deadline_s:
                time.sleep(_LOOK_S)
            if pacer.status != 0:
                raise ContestError(f"the frames did not come to an end: {pacer.stderr_tail()}")
            words = children["controller"].stderr_tail()
        found = figures(folder, rules.warm_up)
        if found["frame_to_command"] is None:
            raise ContestError(f"no command came: {words}")
        return found


def figures(folder: Path, warm_up: int) -> dict[str, Any]:
    """What the times of a run say, its first `warm_up` frames left out.

    Returns:
        frames; without_command of them; sent_late, of them, more than a period after they were due; frame_to_command
        and frame_to_mirror (until the command was back), each percentiles in us, None where no command came.
    """
    due, published, commanded, received = (
        np.fromfile(folder / name, np.int64)[1 + warm_up :] for name in ("due", "published", "commanded", "received")
    )
    period_ns = np.diff(due).mean() if due.size > 1 else np.inf
    return {
        "frames": int(due.size),
        "without_command": int((commanded == 0).sum()),
        "sent_late": int((published - due > period_ns).sum()),
        "frame_to_command": percentiles((commanded - published)[commanded > 0] / 1e3),
        "frame_to_mirror": percentiles((received - published)[received > 0] / 1e3),
    }


def _lowfc(rules: argparse.Namespace, priority: int) -> dict[str, Any]:
    """The real loop, of the contest's size; it warms up for half a second by itself."""
    size = Size(SHAPE[0], MODES, GRID[0])
    found = run_loop(
        size, configuration(size, rules.rate_hz, priority=priority, disable_cpu_idle=bool(priority)), rules.seconds
    )
    return {
        "frames": found["frames"],
        "without_command": found["frames_without_command"],
        "sent_late": found["frames_sent_late"],
        **{span: found["latency_us"][span] for span in ("frame_to_command", "frame_to_mirror")},
    }


def processors() -> tuple[int, int]:
    """The first two that this process may run on; the same one twice where there is but one."""
    allowed = sorted(os.sched_getaffinity(0))
    return allowed[0], allowed[1 % len(allowed)]


def may_run_first() -> bool:
    """Whether this host lets us have SCHED_FIFO."""
    before = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    os.sched_setscheduler(0, before, os.sched_param(0))
    return True


@contextlib.contextmanager
def _awake(priority: int) -> Iterator[None]:
    """Idle processors kept awake for everybody under FIFO, where this user may."""
    latency = Path("/dev/cpu_dma_latency")
    if priority and os.access(latency, os.W_OK):
        with latency.open("wb", buffering=0) as held:
            held.write(bytes(4))
            yield
    else:
        yield


@contextlib.contextmanager
def _processes(contestant: Contestant, pyrtcao: str, folder: Path) -> Iterator[dict[str, Child]]:
    """Start all processes, one after the other is ready; end all."""
    python = pyrtcao if contestant.package else sys.executable
    environment = os.environ | _ONE_THREAD | {"PYTHONPATH": str(ROOT)}
    children = {
        role: Child(role, [python, "-m", contestant.module, role, str(folder)], folder / f"{role}.txt", environment)
        for role in contestant.roles
    }
    try:
        for role, child in children.items():
            child.start()
            deadline_s = time.monotonic() + _READY_S
            while not ready_file(folder, role).exists():
                if child.status is not None or time.monotonic() > deadline_s:
                    raise ContestError(f"{role} did not get ready: {child.stderr_tail()}")
                time.sleep(_LOOK_S)
        yield children
    except BaseException:
        if contestant.package:  # it may have left streams in shared memory
            words = [python, "-m", contestant.module, "clear", str(folder)]
            subprocess.run(words, env=environment, check=False)  # noqa: S603  # our own program
        raise
    finally:
        for child in children.values():
            child.stop(_PATIENCE_S)


def _missing(contestant: Contestant, python: str) -> str:
    """Why a contestant cannot take part; empty where it can."""
    package = contestant.package
    if not package or package in _versions(python):
        return ""
    how = f"python -m venv DIR && DIR/bin/pip install {package}, then --{package} DIR/bin/python"
    return f"not installed in {python}: {how}"


def _versions(python: str) -> dict[str, str]:
    """Versions of the packages in the contest; pyrtcao's where that interpreter has it."""
    found = {name: importlib.metadata.version(name) for name in ("lowfc", "eclipse-zenoh", "numpy")}
    words = [python, "-c", "import importlib.metadata as m; print(m.version('pyrtcao'))"]
    with contextlib.suppress(OSError):
        done = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603  # an interpreter
        if not done.returncode:
            found["pyrtcao"] = done.stdout.strip()
    return found


PERCENTILES = {"p50": "p50", "p99": "p99", "p99_9": "p99.9", "max": "max"}
HEADINGS = ["contestant", "class", *PERCENTILES.values(), f"p50 of {BARE}'s", "p99", "without a command"]
HEADINGS += ["to the mirror p50", "p99"]


def tables(result: Result) -> list[Lines]:
    """One line for each contestant and class."""
    bare = {row["scheduling"]: row for row in result["rows"] if row["contestant"] == BARE}
    lines = [_cells(row, bare.get(row["scheduling"])) for row in result["rows"]]
    return [[HEADINGS, *(line + [""] * (len(HEADINGS) - len(line)) for line in lines)]]


def _cells(row: Result, bare: Result | None) -> list[str]:
    head, runs = [row["contestant"], row["scheduling"]], row["repeats"]
    if "missing" in row:
        return [*head, "not installed"]
    if not runs:
        return [*head, "failed"]
    head += _span(runs, "frame_to_command", PERCENTILES)
    without, frames = (median(run[name] for run in runs) for name in ("without_command", "frames"))
    both = [_medians(runs), _medians(bare["repeats"] if bare else [])]
    head += [f"{both[0][at] / both[1][at]:.2f}" if all(both) else "" for at in ("p50", "p99")]
    return [*head, f"{without:g} of {frames:g}", *_span(runs, "frame_to_mirror", ("p50", "p99"))]


def _span(runs: Sequence[Result], span: str, names: Iterable[str]) -> list[str]:
    known = [run[span] for run in runs if run[span] is not None]
    return [ranged([one[at] for one in known], "{:.0f}".format) if known else "" for at in names]


def _medians(runs: Sequence[Result]) -> dict[str, float]:
    known = [run["frame_to_command"] for run in runs if run["frame_to_command"] is not None]
    return {at: median(one[at] for one in known) for at in ("p50", "p99")} if known else {}


def about(result: Result) -> str:
    """What the table's figures are."""
    rules, rows = result["rules"], result["rows"]
    lines = [
        f"{name}: {what}." for name, what in (DEFINITIONS | {row["contestant"]: row["what"] for row in rows}).items()
    ]
    lines.append(
        f"{rules['repeats']} repeats of {rules['seconds']:g} s at {rules['rate_hz']:g} Hz after {rules['warm_up']} "
        f"frames; {SHAPE[0]} x {SHAPE[1]} uint16 pixels, {MODES} modes, {ACTUATORS} actuators."
    )
    late, sent = (sum(run[name] for row in rows for run in row["repeats"]) for name in ("sent_late", "frames"))
    lines.append(f"{late} of all {sent} frames were sent more than a period late.")
    lines += sorted({f"{row['contestant']}: {row['missing']}." for row in rows if "missing" in row})
    lines += [f"Failed, {row['scheduling']}: {fault}." for row in rows for fault in row["failures"]]
    lines += result["notes"]
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    lines.append(f"Processors {result['pinned_to']}; {versions}.")
    return "\n".join(f"- {line}" for line in lines)
