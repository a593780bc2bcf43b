"""The bench of a chaos case with processes that only sleep, acts on a mock bench, and a console in a terminal."""

import contextlib
import json
import os
import random
import re
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock, call

import psutil
import pytest

from lowfc.adapters.logs import writer
from lowfc.adapters.process.child import Child
from lowfc.contract.configuration import load
from lowfc.contract.messages import TIMING, Role, wire
from lowfc.programs.reliability.chaos import bench, console, disk, processes
from lowfc.programs.reliability.chaos.bench import CaseFailedError, ChaosBench, ProcessEnd
from lowfc.programs.reliability.chaos.case import HOLD_FRAMES
from lowfc.programs.reliability.chaos.cases import CASES
from lowfc.programs.reliability.chaos.console import TerminalConsole
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.loops import until

SLEEP = ["sleep", "60"]


@pytest.fixture
def sleeping(own_runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ChaosBench:
    """A bench with faulty camera frames, whose processes only sleep; they have not been started."""
    monkeypatch.setattr(bench, "_POLL_S", 0.001)
    monkeypatch.setattr(bench, "_LAST_HEALTH_S", 0.0)
    monkeypatch.setattr(bench, "prepare", lambda *_: None)
    names = (Role.CAMERA, Role.CONTROLLER, Role.RECORDER)
    children = [Child(name, [*SLEEP], tmp_path / name) for name in names]
    monkeypatch.setattr(bench, "children_of", lambda *_, **__: children)
    return ChaosBench(load(None), tmp_path, random.Random(1), {"kind": "dark"})  # noqa: S311


def status_of(child: Child) -> str:
    assert child.process is not None
    return psutil.Process(child.process.pid).status()


def test_the_outcome_records_how_each_process_ended(sleeping: ChaosBench) -> None:
    *_, option, file = sleeping.children[Role.CAMERA].command
    assert (option, json.loads(Path(file).read_text())) == ("--fault", {"kind": "dark"})
    for name in (Role.CONTROLLER, Role.RECORDER):
        sleeping.restart(name, ready=False)
    with sleeping.suspended(Role.CONTROLLER):
        until(lambda: status_of(sleeping.children[Role.CONTROLLER]) == psutil.STATUS_STOPPED)
    until(lambda: status_of(sleeping.children[Role.CONTROLLER]) != psutil.STATUS_STOPPED)
    sleeping.kill(Role.RECORDER)
    sleeping.restart(Role.RECORDER, ["sh", "-c", "echo no disk >&2; exit 2"], ready=False)
    assert sleeping.await_end(Role.RECORDER, 2) == "no disk"
    sleeping.restart(Role.CAMERA, ["sh", "-c", "exit 3"], ready=False)
    with pytest.raises(CaseFailedError, match="camera should have ended with exit status 2, got 3"):
        sleeping.await_end(Role.CAMERA, 2)
    sleeping.end()
    found = [(one.name, one.status, one.requested) for one in sleeping.outcome.ended]
    assert found == [
        ("recorder", -signal.SIGKILL, True),
        ("recorder", 2, True),
        ("camera", 3, True),
        ("controller", -signal.SIGTERM, True),
    ]
    assert len(sleeping.outcome.killed_ns) == 1
    assert sleeping.outcome.alive == []
    assert not sleeping.run.path.exists()


def test_a_process_whose_parent_has_ended_is_reported_as_alive(sleeping: ChaosBench) -> None:
    sleeping.restart(Role.CAMERA, ["sh", "-c", "sleep 60 & exit 0"], ready=False)
    until(lambda: sleeping.children[Role.CAMERA].status == 0)
    sleeping.end()
    assert sleeping.outcome.ended == [ProcessEnd("camera", 0, sleeping.outcome.ended[0].after_s, requested=False)]
    (left,) = sleeping.outcome.alive
    os.kill(int(left.split("(")[1].split(",")[0]), signal.SIGKILL)


def test_a_full_disk_is_simulated_by_a_limit_on_the_size_of_the_recorders_files(sleeping: ChaosBench) -> None:
    sleeping.restart(Role.RECORDER, ready=False)
    (sleeping.folder / "a.mcap.part").write_bytes(bytes(500))
    sleeping.health[Role.RECORDER] = wire.Health(recording=wire.Recording(failure="no space left"))
    CASES["disk-full"].act(sleeping)
    process = sleeping.children[Role.RECORDER].process
    assert process is not None
    assert resource.prlimit(process.pid, resource.RLIMIT_FSIZE) == (500 + disk.ROOM_BYTES,) * 2
    sleeping.end()


def test_a_slow_disk_delays_only_the_selected_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program that replaces the recorder runs in this process; instead of recording, it writes ten times."""
    mock_bench = Mock(
        spec=ChaosBench, children={Role.RECORDER: SimpleNamespace(command=["python", "-m", "lowfc", "record"])}
    )
    disk._on_slow_disk(mock_bench, 3.0, 4, 2)
    assert mock_bench.method_calls[:2] == [call.signal(Role.RECORDER, signal.SIGTERM), call.await_end(Role.RECORDER, 0)]
    (_, (python, option, program, *arguments)), ready = mock_bench.restart.call_args
    assert (python, option, arguments, ready) == ("python", "-c", ["3.0", "4", "2", "record"], {"ready": True})

    waited: list[tuple[int, float]] = []

    def record() -> None:
        assert sys.argv == ["lowfc", "record"]
        for _ in range(10):
            file.write(b"abc")

    monkeypatch.setattr(writer._File, "write", writer._File.write)  # restored afterwards
    monkeypatch.setattr("lowfc.programs.cli.main.main", record)
    monkeypatch.setattr(sys, "argv", ["-c", *arguments])
    monkeypatch.setattr(time, "sleep", lambda seconds: waited.append((file.size, seconds)))
    with writer._File(tmp_path / "log", 0o600) as file:
        exec(program, {})  # noqa: S102  # the program of `disk._on_slow_disk`
    assert waited == [(12, 3.0), (15, 3.0)]
    assert file.size == 30


def test_a_camera_with_another_clock_is_replaced_by_a_camera_with_the_hosts_clock() -> None:
    mock_bench = Mock(spec=ChaosBench, children={Role.CAMERA: SimpleNamespace(command=["sim-camera"])})
    CASES["clock-behind"].act(mock_bench)
    assert mock_bench.method_calls == [
        call.kill(Role.CAMERA),
        call.restart(Role.CAMERA, ["unshare", "--time", "--monotonic", "-3600", "sim-camera"]),
        call.await_steps(HOLD_FRAMES),
        call.kill(Role.CAMERA),
        call.restart(Role.CAMERA, ["sim-camera"]),
    ]


def test_the_random_case_restarts_killed_processes_and_continues_suspended_ones() -> None:
    mock_bench = MagicMock(spec=ChaosBench, rng=random.Random(3), process=str)  # noqa: S311
    CASES["random"].act(mock_bench)
    actions = " ".join(done[0] for done in mock_bench.mock_calls if done[0] != "pause")
    suspended = r"suspended suspended\(\).__enter__ suspended\(\).__exit__"
    assert re.fullmatch(rf"((kill restart|{suspended})( |$)){{{processes.RANDOM_FAULTS}}}", actions)
    assert mock_bench.suspended.called
    assert mock_bench.kill.call_args_list == mock_bench.restart.call_args_list != []


def test_a_stall_is_compared_with_the_time_before_and_after(monkeypatch: pytest.MonkeyPatch) -> None:
    bus, measurements = MemoryBus(MemoryHub(), "launcher", FakeClock()), dict[str, Any]()
    timings, latency_us = bus.publisher(TIMING), {"now": 0}

    def pass_time(seconds: float) -> None:
        """Publish timings with the latency of the phase; with 9 ms in the short waits between phases."""
        latency = latency_us["now"] if seconds > 1 else 9_000
        timings.put(wire.ControlTiming(frame_to_command_ns=[1000 * latency] * 3).SerializeToString())

    @contextlib.contextmanager
    def stall(_: str) -> Iterator[None]:
        latency_us["now"] = 300
        yield
        latency_us["now"] = 200

    monkeypatch.setattr(processes, "time", SimpleNamespace(sleep=pass_time))
    latency_us["now"] = 100
    stub: Any = SimpleNamespace(bus=bus, outcome=SimpleNamespace(measurements=measurements), suspended=stall)
    CASES["stall-recorder"].act(stub)
    each = {name: {"frames": 3, "p50_us": us, "p99_us": us} for name, us in (("before", 100.0), ("during", 300.0))}
    each["after"] = {"frames": 3, "p50_us": 200.0, "p99_us": 200.0}
    assert measurements == {"frame_to_command": each, "p99_during_over_calm": 2.0, "p99_after_over_before": 2.0}


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Function that replaces `lowfc console` by a shell script with this text."""
    script = tmp_path / "program"

    def write(text: str) -> None:
        script.write_text(f"#!/bin/sh\n{text}\n")
        script.chmod(0o700)

    monkeypatch.setattr(console, "sys", SimpleNamespace(executable=str(script)))
    monkeypatch.setattr(console, "_STEP_S", 0.001)
    return write


def test_a_console_has_its_own_terminal_until_it_is_closed(program: Callable[[str], None]) -> None:
    program('stty size; echo "loop CLOSED in $5 of $TERM"; read line; echo "[$line]"; exec sleep 60')
    with TerminalConsole("bench") as shown:
        until(lambda: shown.drew(rb"30 100\s+loop CLOSED in --run of xterm-256color"))
        shown.press(b"gain\n")
        until(lambda: shown.drew(rb"\[gain\]"))
        assert 0 <= shown.cpu_s() < 1
    assert shown.process.returncode == -signal.SIGKILL


def test_a_console_that_never_shows_the_loop_is_a_failure(
    program: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "START_S", 0.0)
    program("exec sleep 60")
    with pytest.raises(CaseFailedError, match="did not show the loop"):
        TerminalConsole("bench")
    assert not [one for one in psutil.Process().children() if one.name() == "sleep"]
