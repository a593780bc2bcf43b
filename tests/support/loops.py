"""Helpers to run the real processes and read their logs."""

import contextlib
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from mcap.reader import make_reader
from typer.testing import CliRunner

from lowfc.contract.errors import LowfcError
from lowfc.programs.cli.main import app

STILL = """
[star]
magnitude = -1.0
[camera]
rate_hz = 100
[disturbance]
preset = "quiet"
static_nm = {2 = 8.0, 4 = 5.0}
[control]
start_mode = "closed"
tilt_gain = 0.3
gain = 0.3
"""
"""Configuration of a closed loop with a bright star and a static wavefront of 8 nm tilt x and 5 nm focus."""
LOWFC = [sys.executable, "-m", "lowfc"]
PROGRAMS = Path(sys.executable).parent
FIXED = "[control]\ntilt_gain = 0.5\ngain = 0.05\n"
"""Fixed gains, for a loop that is closed from its first frame on."""


def run(folder: Path, *arguments: str, config: str = "", timeout_s: float = 120) -> "subprocess.CompletedProcess[str]":
    """Run `lowfc` with these arguments in a folder."""
    command_line = [*LOWFC, *arguments]
    if config:
        (folder / "test.toml").write_text(config)
        command_line += ["--config", "test.toml"]
    return subprocess.run(command_line, cwd=folder, capture_output=True, text=True, timeout=timeout_s, check=False)


def mount(*arguments: object) -> None:
    """Mount a file system; skip the test where this is not permitted."""
    if subprocess.run(["mount", *map(str, arguments)], check=False).returncode:
        pytest.skip("mounting a file system is not permitted")


def lowfc(*arguments: object) -> Result:
    """Run `lowfc` with these arguments in this process; the result's `exception` is the error that ended it."""
    return CliRunner().invoke(app, [*map(str, arguments)])


def json_of(*arguments: object, status: int = 0) -> Any:
    """JSON printed by `lowfc` with these arguments and --json, run in this process."""
    done = lowfc(*arguments, "--json")
    assert done.exit_code == status, (done.output, done.exception)
    return json.loads(done.stdout)


def refusal(*arguments: object, kind: type[LowfcError] | tuple[type[LowfcError], ...] = LowfcError) -> str:
    """Text of the error with which `lowfc` refuses these arguments, run in this process."""
    error = lowfc(*arguments).exception
    assert isinstance(error, kind), error
    return str(error)


def output_of(folder: Path, line: str) -> str:
    """Output of a documented command that starts no loop, run in this process with this working directory."""
    command_line, _, output = line.partition(" > ")
    with contextlib.chdir(folder):
        done = lowfc(*shlex.split(command_line)[1:])
    assert done.exit_code == 0, f"{line}: {done.output} {done.exception}"
    if output:
        (folder / output).write_text(done.stdout)
    return done.stdout


def loop(folder: Path, *arguments: str, config: str = "", timeout_s: float = 120) -> dict[str, Any]:
    """Run `sim-loop`, which must succeed, and return its results; `log` becomes an absolute path."""
    done = run(folder, "sim-loop", "--json", *arguments, config=config, timeout_s=timeout_s)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 1, done.stdout
    results: dict[str, Any] = json.loads(lines[0])
    if results["log"]:
        results["log"] = folder / results["log"]
    return results


def payloads(log: Path) -> dict[str, list[bytes]]:
    """Payloads of every topic of a log, in order; CRCs are checked."""
    bodies: dict[str, list[bytes]] = defaultdict(list)
    with log.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            bodies[channel.topic].append(message.data)
    return dict(bodies)


def children(launcher: int) -> dict[str, int]:
    """Process ids of a launcher's processes, by subcommand of `lowfc` or by module."""
    pids = {}
    listed = Path(f"/proc/{launcher}/task/{launcher}/children").read_text().split()
    for pid in map(int, listed):
        arguments = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
        if "-m" not in arguments:  # between fork and exec
            continue
        module = arguments[arguments.index("-m") + 1]
        pids[module if module != "lowfc" else arguments[arguments.index("-m") + 2]] = pid
    return pids


def start(folder: Path, *arguments: object) -> "subprocess.Popen[str]":
    """Start `lowfc` in the background."""
    return subprocess.Popen(
        [*LOWFC, *map(str, arguments)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )


@contextlib.contextmanager
def started(folder: Path, *arguments: object) -> Iterator["subprocess.Popen[str]"]:
    """Run `lowfc` in the background; at the end of the block it is killed, unless it has ended."""
    with start(folder, *arguments) as process:
        try:
            yield process
        finally:
            process.kill()


def command(folder: Path, line: str, timeout_s: float = 120, statuses: tuple[int, ...] = (0,)) -> str:
    """Output of a documented command, which must end with one of the statuses; a redirection is also carried out."""
    command_line, _, output = line.partition(" > ")
    program, *rest = shlex.split(command_line, comments=True)
    done = subprocess.run(
        [PROGRAMS / program, *rest], cwd=folder, capture_output=True, text=True, timeout=timeout_s, check=False
    )
    assert done.returncode in statuses, f"{line}: {done.stdout} {done.stderr}"
    assert "Traceback" not in done.stderr, done.stderr
    if output:
        (folder / output).write_text(done.stdout)
    return done.stdout


@contextlib.contextmanager
def in_background(folder: Path, *lines: str) -> Iterator[list[str]]:
    """Run documented commands in the background, then stop them; the list has their standard errors afterwards."""
    processes = [
        subprocess.Popen([PROGRAMS / program, *rest], cwd=folder, stderr=subprocess.PIPE, text=True)
        for program, *rest in map(shlex.split, lines)
    ]
    stderr: list[str] = []
    try:
        yield stderr
    finally:
        for process in processes:
            process.terminate()
        stderr += [process.communicate(timeout=20)[1] for process in processes]
    assert all(process.returncode in (0, -signal.SIGTERM, 130) for process in processes), stderr


def interrupt(process: "subprocess.Popen[str]") -> tuple[str, str]:
    """Send Ctrl-C and return standard output and standard error."""
    process.send_signal(signal.SIGINT)
    return process.communicate(timeout=20)


def until(
    condition: Callable[[], object], timeout_s: float = 30.0, *, each: Callable[[], object] = lambda: None
) -> None:
    """Wait for a condition; `each` is called before each check."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        each()
        if condition():
            return
        assert time.monotonic() < deadline_s, "timeout"
        time.sleep(0.01)


def socket_options(level: int, option: int) -> list[int]:
    """Values of a socket option, for those sockets of this process that have it."""
    found = []
    for descriptor in (int(path.name) for path in Path("/proc/self/fd").iterdir()):
        with contextlib.suppress(OSError):
            one = socket.socket(fileno=descriptor)
            try:
                found.append(one.getsockopt(level, option))
            finally:
                one.detach()
    return found


def recorded_bytes(folder: Path) -> int:
    """Size of the log that is being written in `folder`/logs; beyond 4 MB it contains frames."""
    return sum(path.stat().st_size for path in (folder / "logs").glob("*.part"))
