"""The console as a process: it ends on a signal, and a calibration started in it continues."""

import signal
from pathlib import Path

import pytest

from lowfc.adapters.files import calibration_file
from lowfc.client import Client, running
from lowfc.contract.errors import BusError
from lowfc.contract.messages import wire
from lowfc.programs.reliability.chaos.console import TerminalConsole
from tests.support.loops import interrupt, start, until

pytestmark = [pytest.mark.exclusive, pytest.mark.slow, pytest.mark.timeout(480)]
CONFIG = """
[camera]
rate_hz = 200
[star]
magnitude = -0.5
[control]
start_mode = "open"
"""


def test_a_calibration_continues_when_its_console_is_killed(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(CONFIG)
    process = start(tmp_path, "sim-loop", "--config", "bench.toml", "--run", "outlived", "--duration", "600")
    try:
        until(lambda: "outlived" in running(), 60)
        with Client("outlived") as loop:
            until(lambda: state(loop).frame_sequence, 60)
            with TerminalConsole("outlived") as leaving:
                leaving.process.send_signal(signal.SIGTERM)
                assert leaving.process.wait(10) == 0
            with TerminalConsole("outlived", tmp_path) as console:
                console.press(b"b")
                until(lambda: console.drew(b"signal-to-noise"))
                console.press(b"\r")
                until(lambda: reserved(loop), 60)
                console.process.kill()
                assert console.process.wait(10) == -signal.SIGKILL
                assert reserved(loop), "the calibration continues"
            until(lambda: list(tmp_path.glob("calibration-*.fits")), 200)
            until(lambda: not reserved(loop))
            (file,) = tmp_path.glob("calibration-*.fits")
            assert calibration_file.load(file).noll == loop.calibration().noll
    finally:
        interrupt(process)


def state(loop: Client) -> wire.ControllerState:
    """State of the controller; empty while it does not answer."""
    try:
        return loop.status().state or wire.ControllerState()
    except BusError:
        return wire.ControllerState()


def reserved(loop: Client) -> bool:
    """Whether a lease is in force."""
    lease = state(loop).lease
    return bool(lease.holder) and not lease.ended
