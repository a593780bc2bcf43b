"""Replay of logs of real processes: requests of an operator, a restart, dropped frames, rotation."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lowfc.adapters.bus.run import new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Client
from lowfc.contract.messages import CONTROLLER_STATE, EVENT, STEP
from tests.support.loops import LOWFC, json_of, loop, until

pytestmark = [pytest.mark.exclusive, pytest.mark.slow]

# A camera that loses one frame in a hundred on the way, as a bad cable does.
LOSSY_CAMERA = """
from lowfc.adapters.bus.zenoh_bus import ZenohPublisher
from lowfc.contract.envelope import Envelope, sequence_of
from lowfc.contract.messages import FRAME
from sim_camera.__main__ import main

put = ZenohPublisher.put

def lossy(self, payload, *more):
    if self.topic is not FRAME or self.published % 100 != 57:
        return put(self, payload, *more)
    self.published += 1
    return Envelope(sequence_of(self._bus.start_s, self.published - 1), self._host_ns())

ZenohPublisher.put = lossy
main()
"""


class Night:
    """Processes started by hand, with a camera that loses frames."""

    def __init__(self, folder: Path) -> None:
        (folder / "night.toml").write_text('[camera]\nrate_hz = 400\n[mirror]\non_command_timeout = "hold"\n')
        self.folder, self.run = folder, open_run(new_run_id())
        shared = ["--run", self.run.run_id, "--config", str(folder / "night.toml")]
        self.commands = {
            "mirror-dm": [sys.executable, "-m", "sim_dm", *shared],
            "controller": [*LOWFC, "controller", *shared],
            "recorder": [*LOWFC, "record", *shared, "--folder", str(folder / "logs"), "--largest-mb", "12"],
            "camera": [sys.executable, "-c", LOSSY_CAMERA, *shared],
        }
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.bus = ZenohBus(self.run.links, "operator", HostClock())
        self.loop = Client(self.run.run_id, bus=self.bus)

    def start(self, *names: str) -> None:
        for name in names:
            with (self.folder / f"{name}.stderr").open("ab") as stderr:
                self.running[name] = subprocess.Popen(self.commands[name], stderr=stderr)
        until(lambda: all(self.ready(name) for name in names))

    def ready(self, name: str) -> bool:
        health = self.loop.processes().get(name)
        return health is not None and health.state in ("ready", "running")

    def end(self, name: str, signal_: signal.Signals = signal.SIGTERM) -> None:
        process = self.running.pop(name)
        process.send_signal(signal_)
        process.wait(20)

    def close(self) -> None:
        for name in list(self.running):
            self.end(name, signal.SIGKILL)
        self.bus.close()
        self.run.remove()


@pytest.fixture
def night(tmp_path: Path) -> Iterator[Night]:
    night = Night(tmp_path)
    yield night
    night.close()


def test_logs_with_requests_a_restart_dropped_frames_and_rotation_are_replayed_identically(
    night: Night, tmp_path: Path
) -> None:
    night.start("mirror-dm", "controller", "recorder")
    night.start("camera")
    for _ in night.loop.steps(1, patience_s=20.0):
        night.loop.close_loop()
    for gain in (0.2, 0.4):
        night.loop.gain(gain)
        time.sleep(0.3)
    night.end("controller", signal.SIGKILL)
    time.sleep(0.2)
    night.start("controller")
    night.loop.gain(0.3)
    until(lambda: len(list((tmp_path / "logs").glob("*.mcap"))) >= 2)
    for name in ("camera", "controller", "mirror-dm", "recorder"):  # in the order of the data flow, the recorder last
        night.end(name)
    logs = sorted((tmp_path / "logs").iterdir())
    results = json_of("replay", *logs)
    assert (results["identical"], results["different"], results["largest_difference_nm"]) == (True, 0, 0.0)
    steps = sum(1 for log in logs for _ in LogReader(log, topics=[STEP]))
    assert results["frames"] + results["unchecked"] == steps > 500
    assert results["unchecked"] < 5, results["unchecked_because"]  # steps around the kill
    assert results["requests"] == 4
    events = [message.payload for log in logs for message in LogReader(log, topics=[EVENT])]
    for name in (b"FRAMES_MISSING", b"MIRROR_ADOPTED"):
        assert any(name in payload for payload in events)
    states = [message for log in logs for message in LogReader(log, topics=[CONTROLLER_STATE])]
    assert len({message.sequence >> 32 for message in states}) == 2


def test_a_minute_at_a_kilohertz_is_recorded_without_loss_and_replayed_identically(tmp_path: Path) -> None:
    options = ("--rate", "1000", "--duration", "60", "--disturbance", "reaction-wheel")
    results = loop(tmp_path, *options, timeout_s=200)
    assert results["messages_lost"] == 0
    replayed = json_of("replay", results["log"])
    assert replayed["identical"]
    assert replayed["frames"] == results["frames_processed"]
    assert replayed["unchecked"] == 0
