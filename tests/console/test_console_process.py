"""The console as a process: how it ends, and what it leaves running."""

import signal
from pathlib import Path

import pytest

from lowfc.adapters.files import calibration_file
from lowfc.client import Client, running
from lowfc.contract.errors import BusError
from lowfc.contract.messages import wire
from lowfc.programs.reliability.chaos.console import TerminalConsole
from tests.support.loops import interrupt, start, until

pytestmark = [pytest.mark.exclusive, pytest.mark.slow]
CONFIG = """
[camera]
rate_hz = 200
[control]
start_mode = "open"
"""


def test_a_calibration_outlives_a_console_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(CONFIG)
    process = start(tmp_path, "sim-loop", "--config", "bench.toml", "--run", "outlived", "--duration", "600")
    try:
        until(lambda: "outlived" in running(), 60)
        with Client("outlived") as loop:
            until(lambda: state(loop).frame_sequence, 60)
            before = state(loop).calibration_id
            with TerminalConsole("outlived") as leaving:
                leaving.process.send_signal(signal.SIGTERM)
                assert leaving.process.wait(10) == 0
            with TerminalConsole("outlived", tmp_path) as console:
                console.press(b"b")
                until(lambda: console.drew(b"signal-to-noise"))
                console.press(b"\r")
                until(lambda: state(loop).lease.holder, 60)
                console.process.kill()
                assert console.process.wait(10) == -signal.SIGKILL
                assert state(loop).lease.holder, "it goes on"
            until(lambda: state(loop).calibration_id not in ("", before), 120)
            until(lambda: not state(loop).lease.holder)
            (made,) = tmp_path.glob("calibration-*.fits")
            assert calibration_file.load(made).id == state(loop).calibration_id
    finally:
        interrupt(process)


def state(loop: Client) -> wire.ControllerState:
    """What the controller says of itself; nothing where it does not answer yet."""
    try:
        return loop.status().state or wire.ControllerState()
    except BusError:
        return wire.ControllerState()
