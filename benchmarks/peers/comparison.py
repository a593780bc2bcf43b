"""Comparison of lowfc with other implementations of the same loop: same frames and sizes, in turns.

All use SCHED_FIFO if the host grants it, and the normal scheduling class otherwise. CPU idle states are disabled for
all if permitted.

Example:
    git clone https://github.com/milk-org/ImageStreamIO DIR
    python -m venv RTC && RTC/bin/pip install pyrtcao
    python -m benchmarks peers --isio DIR --pyrtcao RTC/bin/python
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers import shared
from benchmarks.peers.implementations import (
    FUSED,
    IMPLEMENTATIONS,
    PYRTCAO,
    ComparisonError,
    Implementation,
    missing,
    program,
    versions,
)
from benchmarks.peers.plain_zenoh import PORTS
from benchmarks.peers.shared import ACTUATORS, LAST, MIRROR_SIDE, MODES, SIDE, TIME_STAMPS, NumpyStep, RunData
from benchmarks.runner import Lines, Report, Result, add_times, ranged
from benchmarks.sizes import Size, configuration, prepared_run, random_calibration
from lowfc.adapters.bus.run import free_ports
from lowfc.adapters.process.child import Child
from lowfc.adapters.process.realtime import set_up
from lowfc.contract.errors import ConfigurationError, LowfcError
from lowfc.programs.measure.latency.frame_statistics import WARM_UP_S, percentiles
from lowfc.programs.measure.latency.run import LatencyOptions, one_loop
from tools.shared import ROOT

SIZE = Size(SIDE, MODES, MIRROR_SIDE)
PRIORITY = 50

_MEMORY = Path("/dev/shm")  # noqa: S108  # a private folder is created in it
_READY_S, _SETTLE_S, _DEADLINE_MARGIN_S, _POLL_S, _STOP_TIMEOUT_S = 60.0, 0.3, 10.0, 0.02, 0.5
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
_FIRST_CPU_ROLES = ("source", "mirror", "modal_mirror")  # roles on the first processor

DEFINITIONS = {
    "t0": "just before the source sends a frame: before it writes the stream, before the zenoh put, or before "
    "pyrtcao's WavefrontSensor.expose",
    "t1": "just after the controller has sent the frame's command: after the stream's semaphores are posted, "
    "after the zenoh put, or after pyrtcao's write_stream; for lowfc after the direct link's send, before zenoh's",
    "frame to command": "from t0 to t1",
    "frame to mirror": "from t0 until the mirror's process has received the actuator values; for lowfc until just "
    "before the mirror publishes its state",
    "clock": "CLOCK_MONOTONIC, one host",
    "pacing": "the source sleeps until absolute times; a late frame is sent at once, and its t0 is the actual time of "
    "sending; no frame is skipped",
    "cells": "median (lowest to highest) over the turns; each turn runs every implementation once, every other turn in "
    "the opposite order",
    "frames without a command": "measured frames that led to no command, in all turns",
    "pinning": "source and mirror on the first processor, all else on the second; with three or more processors "
    "lowfc's mirror on the third",
    "memory": "lowfc's processes lock their memory (`realtime.lock_memory`), the other implementations' do not",
    "threads": "BLAS and numba 1; garbage collection off everywhere",
    "compiler": "the C implementation (chain.c) is built with cc -O3 -march=native -ffast-math",
}


def options(parser: argparse.ArgumentParser) -> None:
    """Add duration, repeats, rate and implementations."""
    add_times(parser, seconds=3.0, repeats=9)
    parser.add_argument("--warm-up", type=int, default=500, help="warm-up frames (%(default)s)")
    parser.add_argument("--rate", dest="rate_hz", type=float, default=1000.0, help="frames per second (%(default)g)")
    parser.add_argument(
        "--only",
        action="append",
        metavar="WORD",
        help="run only the implementations whose name contains WORD; the option may be repeated",
    )
    isio = os.environ.get("ISIO_DIR")
    parser.add_argument(
        "--isio", type=Path, default=isio and Path(isio), metavar="DIR", help="a checkout of ImageStreamIO ($ISIO_DIR)"
    )
    python = os.environ.get("PYRTCAO_PYTHON", sys.executable)
    parser.add_argument(
        "--pyrtcao", default=python, metavar="PYTHON", help="an interpreter that has pyrtcao ($PYRTCAO_PYTHON)"
    )


def measure(options: argparse.Namespace, report: Report) -> Result:
    """Run all implementations in turns: statistics of each run (None if it failed), and why any is missing."""
    chosen = [one for one in IMPLEMENTATIONS if any(word in one.name for word in options.only or [""])]
    if not chosen:
        raise ConfigurationError(f"--only: none of {'; '.join(one.name for one in IMPLEMENTATIONS)}")
    if options.warm_up < 0:
        raise ConfigurationError(f"--warm-up must be at least 0, got {options.warm_up}")
    configuration(SIZE, options.rate_hz)  # refuses an impossible rate
    absent = {one.name: why for one in chosen if (why := missing(one, options))}
    present = [one for one in chosen if one.name not in absent]
    realtime = set_up(None, None, lock_memory=False, disable_cpu_idle=True)  # processors stay awake in all runs
    priority = PRIORITY if fifo_granted() else 0
    runs: dict[str, list[Any]] = {one.name: [] for one in chosen}
    failed = []
    for turn in range(options.repeats):
        for one in present[:: -1 if turn % 2 else 1]:
            report(f"turn {turn + 1} of {options.repeats}: {one.name}")
            try:
                runs[one.name].append(one_run(one, options, priority))
            except (ComparisonError, LowfcError) as fault:
                runs[one.name].append(None)
                failed.append(f"{one.name}: {fault}")
    return {
        "runs": runs,
        "missing": absent,
        "rules": {name: getattr(options, name) for name in ("repeats", "seconds", "warm_up", "rate_hz")},
        "priority": priority,
        "granted": realtime.granted,
        "refused": [name for name, _ in realtime.refused],
        "pinned_to": processors(),
        "versions": versions(options),
        "failed": failed,
    }


def one_run(implementation: Implementation, options: argparse.Namespace, priority: int) -> dict[str, Any]:
    """Run an implementation once; ComparisonError or LowfcError if it does not start or end, or sends no command."""
    if implementation.kernel:
        return _lowfc(implementation.kernel, options, priority)
    frames = options.warm_up + round(options.seconds * options.rate_hz)
    with tempfile.TemporaryDirectory(prefix="lowfc-peers-", dir=_MEMORY) as name:
        folder = Path(name)
        write_shared_files(folder, frames)
        with _processes(implementation, options, folder, [str(options.rate_hz), str(frames)], priority) as children:
            time.sleep(_SETTLE_S)
            shared.go(folder)
            source = children["source"]
            deadline_s = time.monotonic() + frames / options.rate_hz + _DEADLINE_MARGIN_S
            while source.status is None and time.monotonic() < deadline_s:
                time.sleep(_POLL_S)
            if source.status != 0:
                end = "did not end" if source.status is None else f"ended with exit status {source.status}"
                raise ComparisonError(f"the source of frames {end}: {source.stderr_tail()}")
            complaints = "\n".join(child.stderr_tail() for child in children.values())
        found = run_statistics(folder, options.warm_up)
        if found["frame_to_command"] is None:
            raise ComparisonError(f"no command was sent: {complaints}")
        return found


def run_statistics(folder: Path, warm_up: int) -> dict[str, Any]:
    """Statistics of a run without its first `warm_up` frames; percentiles in us, None without any command.

    command_error: largest difference between the actuator values of the last command and numpy's values, relative to
    numpy's largest value; None if a command is missing.
    """
    due, published, commanded, received = (np.fromfile(folder / name, np.int64)[1:] for name in TIME_STAMPS)
    command_error = _command_error(folder, commanded.size) if commanded.all() and received[-1] else None
    due, published, commanded, received = (times[warm_up:] for times in (due, published, commanded, received))
    period_ns = np.diff(due).mean() if due.size > 1 else np.inf
    return {
        "frames": int(due.size),
        "without_command": int((commanded == 0).sum()),
        "sent_late": int((published - due > period_ns).sum()),
        "frame_to_command": percentiles((commanded - published)[commanded > 0] / 1e3),
        "frame_to_mirror": percentiles((received - published)[received > 0] / 1e3),
        "command_error": command_error,
    }


def _command_error(folder: Path, frames: int) -> float:
    run_data = RunData(folder)
    step, payload = NumpyStep(run_data), b""
    for number in range(1, frames + 1):
        payload = step.command(run_data.frame(number).tobytes())
    expected, found = np.frombuffer(payload, np.float32), np.fromfile(folder / LAST, np.float32)
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def _lowfc(kernel: str, options: argparse.Namespace, priority: int) -> dict[str, Any]:
    """Run lowfc's own loop with the size of the comparison; frames of its first half second do not count."""
    config = configuration(SIZE, options.rate_hz, priority=priority, disable_cpu_idle=True, kernel=kernel)
    with prepared_run(SIZE, config) as run:
        found = one_loop(LatencyOptions(config, options.seconds, 1), run)
    return {
        "frames": found["frames"],
        "without_command": found["frames_without_command"],
        "sent_late": found["frames_sent_late"],
        **{span: found["latency_us"][span] for span in ("frame_to_command", "frame_to_mirror")},
        "command_error": None,
    }


def write_shared_files(folder: Path, frames: int) -> None:
    """Write the files that the processes of a run share."""
    calibration, images = random_calibration(SIZE, configuration(SIZE, 1.0))
    images.tofile(folder / "frames")
    (calibration.dark + calibration.flux_dn * calibration.reference).tofile(folder / "I0")
    (calibration.reconstructor / calibration.flux_dn).tofile(folder / "R")
    calibration.modes_to_actuators.tofile(folder / "to_actuators")
    for name in TIME_STAMPS:
        (folder / name).write_bytes(bytes(8 * (frames + 1)))
    (folder / LAST).write_bytes(bytes(4 * ACTUATORS))
    (folder / PORTS).write_text(json.dumps(dict(zip(("camera", "controller"), free_ports(2), strict=True))))
    (folder / "credentials").write_text("lowfc:lowfc\n")


def processors() -> tuple[int, int]:
    """The first two processors that this process may run on; the same one twice if there is only one."""
    allowed = sorted(os.sched_getaffinity(0))
    return allowed[0], allowed[1 % len(allowed)]


def fifo_granted() -> bool:
    """Whether this host grants SCHED_FIFO."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    os.sched_setscheduler(0, *before)
    return True


@contextlib.contextmanager
def _processes(
    implementation: Implementation, options: argparse.Namespace, folder: Path, arguments: list[str], priority: int
) -> Iterator[dict[str, Child]]:
    start = program(implementation, options, folder)
    environment = os.environ | _ONE_THREAD | {"PYTHONPATH": str(ROOT), "MILK_SHM_DIR": str(folder)}

    def command(role: str) -> list[str]:
        processor = processors()[role not in _FIRST_CPU_ROLES]
        return [*start, role, str(folder), *arguments, str(processor), str(priority)]

    children = {role: Child(role, command(role), folder / f"{role}.txt", environment) for role in implementation.roles}
    try:
        for role, child in children.items():
            child.start()
            deadline_s = time.monotonic() + _READY_S
            while not shared.ready_file(folder, role).exists():
                if child.status is not None or time.monotonic() > deadline_s:
                    raise ComparisonError(f"{role} did not become ready: {child.stderr_tail()}")
                time.sleep(_POLL_S)
        yield children
    except BaseException:
        if implementation.program == PYRTCAO:  # streams may remain in shared memory
            subprocess.run(command("clear"), env=environment, check=False)  # noqa: S603  # our own program
        raise
    finally:
        for child in children.values():
            child.stop(_STOP_TIMEOUT_S)


PERCENTILES = {"p50": "p50", "p99": "p99", "p99_9": "p99.9", "max": "max"}
HEADINGS = [
    "implementation",
    *(f"frame to command {at}, us" for at in PERCENTILES.values()),
    "frames without a command",
    *(f"frame to mirror {at}, us" for at in ("p50", "p99")),
]


def tables(result: Result) -> list[Lines]:
    """Tables of the latencies, of the differences within a turn, and of the features of the implementations."""
    runs = result["runs"]
    features = [
        [one.name, str(len(one.roles) or 3), one.log, one.safety, one.multi_host]
        for one in IMPLEMENTATIONS
        if one.name in runs
    ]
    latencies = [HEADINGS, *(_cells(name, each, name in result["missing"]) for name, each in runs.items())]
    others = [name for name in runs if name != FUSED and pairs(runs, name)]
    return [
        latencies,
        [
            [f"{FUSED} minus the other, us", "p50", "p99", "turns with lower p50", "turns with lower p99"],
            *(_difference(runs, name) for name in others),
        ],
        [["implementation", "processes", "log", "safety", "other machines"], *features],
    ]


def _cells(name: str, turns: Sequence[Result | None], is_missing: bool) -> list[str]:
    done = [turn for turn in turns if turn is not None]
    if not done:
        return [name, "not installed" if is_missing else "failed", *[""] * (len(HEADINGS) - 2)]
    without, frames = (sum(turn[one] for turn in done) for one in ("without_command", "frames"))
    to_mirror = _spans(done, "frame_to_mirror", ("p50", "p99"))
    return [name, *_spans(done, "frame_to_command", PERCENTILES), f"{without} of {frames}", *to_mirror]


def _spans(turns: Sequence[Result], span: str, names: Iterable[str]) -> list[str]:
    measured = [turn[span] for turn in turns if turn[span] is not None]
    return [ranged([one[at] for one in measured], "{:.0f}".format) if measured else "" for at in names]


def pairs(runs: Result, other: str) -> list[tuple[Result, Result]]:
    """Percentiles from frame to command of lowfc's fused step and of another implementation, by turn."""
    turns = zip(runs.get(FUSED, ()), runs[other], strict=False)
    return [
        (fused["frame_to_command"], compared["frame_to_command"]) for fused, compared in turns if fused and compared
    ]


def _difference(runs: Result, other: str) -> list[str]:
    both = pairs(runs, other)
    each = [[fused[at] - compared[at] for fused, compared in both] for at in ("p50", "p99")]
    ahead = [f"{sum(one < 0 for one in differences)} of {len(both)}" for differences in each]
    return [other, *(ranged(differences, "{:+.0f}".format) for differences in each), *ahead]


def about(result: Result) -> str:
    """Definitions and conditions of the tables."""
    rules, runs = result["rules"], result["runs"]
    descriptions: dict[str, list[str]] = {}
    for one in IMPLEMENTATIONS:
        if one.name in runs:
            descriptions.setdefault(one.description, []).append(one.name)
    lines = [f"{name}: {text}." for name, text in DEFINITIONS.items()]
    lines += [f"{' and '.join(names)}: {text}." for text, names in descriptions.items()]
    lines.append(
        f"{rules['repeats']} turns of {rules['seconds']:g} s at {rules['rate_hz']:g} Hz after {rules['warm_up']} "
        f"frames (lowfc: {WARM_UP_S:g} s); {SIDE} x {SIDE} uint16 pixels, {MODES} modes, {ACTUATORS} actuators."
    )
    done = [turn for turns in runs.values() for turn in turns if turn is not None]
    late, sent = (sum(turn[name] for turn in done) for name in ("sent_late", "frames"))
    lines.append(f"{late} of all {sent} frames were sent more than a period late.")
    if command_errors := [turn["command_error"] for turn in done if turn["command_error"] is not None]:
        lines.append(
            f"In the {len(command_errors)} runs with a command for every frame, the final mirror command differs "
            f"from numpy's by at most {max(command_errors):.1g} of the largest actuator's value; lowfc is left out: "
            "its step also divides by the flux."
        )
    lines += [f"{name}: {why}." for name, why in result["missing"].items()]
    lines += [f"Failed run of {fault}." for fault in result["failed"]]
    priority = result["priority"]
    scheduling = f"SCHED_FIFO {priority} for all" if priority else "the normal class for all: SCHED_FIFO is refused"
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    granted = "; ".join([scheduling, *result["granted"], *(f"refused: {one}" for one in result["refused"])])
    lines.append(f"Processors {list(result['pinned_to'])}; {granted}; {versions}.")
    return "\n".join(f"- {line}" for line in lines)
