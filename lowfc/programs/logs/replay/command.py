"""The command `lowfc replay`."""

import os
import time
from typing import Annotated

import typer
from rich.console import Console

from lowfc.adapters.logs.parts import named_files
from lowfc.adapters.logs.recovery import missing_end_text
from lowfc.adapters.process.progress import reading_bar
from lowfc.adapters.process.provenance import provenance
from lowfc.adapters.process.terminal import Json, Logs
from lowfc.control.kernel.tables import KernelName
from lowfc.programs.cli.result import print_result

_HOST = ("lowfc", "git", "python", "numpy", "numba", "scipy", "blas", "processor", "cpu_features")
"""Versions and processor features on which bit-exact results may depend."""


def _host_differences(logged: dict[str, str]) -> dict[str, tuple[str, str]]:
    """Differences in versions and processor between the log's host and this one."""
    present = provenance()
    both = {key: (logged[key], present.get(key, "")) for key in _HOST if key in logged}
    differs = {key: (before, now) for key, (before, now) in both.items() if before != now}
    if "cpu_features" in differs:
        before, now = (set(features.split()) for features in differs["cpu_features"])
        differs["cpu_features"] = " ".join(sorted(before - now)), " ".join(sorted(now - before))
    return differs


def replay_log(
    logs: Logs,
    tolerance: Annotated[
        float, typer.Option(min=0, max=1e9, help="Largest difference to ignore, nm: for a log from another processor.")
    ] = 0.0,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Largest number of processes; default: one per processor.")
    ] = None,
    kernel: Annotated[
        KernelName | None, typer.Option(help="Implementation of the control step; default: the log's.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Replay the recorded inputs through the controller, and compare every step and command with the log, bit for bit.

    The exit status is 0 only if everything that could be compared is identical, or differs by at most --tolerance, and
    the kernel is the log's. Logs may be complete, rotated, truncated or damaged.

    Example: lowfc replay last
    """
    from lowfc.programs.logs.replay.workers import replay_files

    files = named_files(logs)
    total = sum(path.stat().st_size for path in files if os.access(path, os.R_OK))
    begun_s = time.monotonic()
    with reading_bar(Console(stderr=True)) as count:
        account = replay_files(files, tolerance, jobs or 0, lambda done: count("replaying", done, total), kernel or "")
    account.speed = round(account.log_s / (time.monotonic() - begun_s), 2)
    account.log_s = round(account.log_s, 3)
    account.version, account.tolerance_nm = account.recorded_on.get("lowfc", ""), tolerance
    account.no_end = missing_end_text(files, finished=account.finished)
    account.host_differs = _host_differences(account.recorded_on)
    print_result(account, as_json=as_json)
    if not account.identical:
        raise typer.Exit(1)
