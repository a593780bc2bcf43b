"""Replay of what real processes recorded: operators, a restart, dropped frames, rotation, a killed recorder."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import Run, new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.writer import LogWriter
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.messages import CONTROLLER_STATE, STEP, wire
from lowfc.programs.logs.replay.workers import replay_files
from tests.support.loops import LOWFC, loop, run, until

pytestmark = pytest.mark.exclusive

# A camera that loses one frame in a hundred on the way, as a bad cable does.
LOSSY_CAMERA = """
import sys
from lowfc.adapters.bus.zenoh_bus import ZenohPublisher
from lowfc.contract.messages import FRAME
from sim_camera.__main__ import main

def lost(attachment):
    return int.from_bytes(attachment[:4], "little") % 100 == 57

class Lossy:
    def __init__(self, publisher):
        self.publisher = publisher
    def put(self, payload, attachment):
        if not lost(attachment):
            self.publisher.put(payload, attachment=attachment)

class LossyDirectLink:
    def __init__(self, direct_link):
        self.direct_link, self.close = direct_link, direct_link.close
    def send(self, attachment, payload):
        return not lost(attachment) and self.direct_link.send(attachment, payload)

made = ZenohPublisher.__init__
def lossy(self, bus, session, topic, key, direct_link):
    made(self, bus, session, topic, key, direct_link)
    if topic is FRAME:
        self._publisher, self._direct_link = Lossy(self._publisher), LossyDirectLink(self._direct_link)

ZenohPublisher.__init__ = lossy
main()
"""


def forged(log: Path, path: Path) -> None:
    """The same log of another host, with one actuator of one command a trifle off."""
    reader = LogReader(log)
    messages = list(reader)
    metadata = {name: dict(entries) for name, entries in reader.metadata.items()}
    metadata["lowfc"] |= {"numpy": "1.0", "cpu_features": metadata["lowfc"]["cpu_features"] + " abacus"}
    writer = LogWriter(path, messages[0].log_time_ns, metadata)
    for message in messages:
        payload = message.payload
        if message.key == "lowfc/mirror/dm/command" and message.sequence & 0xFFFF == 700:
            command = wire.MirrorCommand.FromString(payload)
            surface = np.frombuffer(command.actuators, np.float32).copy()
            surface[600] = np.nextafter(surface[600], np.float32(np.inf))
            command.actuators = surface.tobytes()
            payload = command.SerializeToString()
        writer.write(Sample(message.key, payload, message.sequence, message.publish_time_ns, message.log_time_ns))
    writer.finish({})


def replayed(folder: Path, *logs: Path | str, status: int = 0) -> dict[str, Any]:
    done = run(folder, "replay", "--json", *map(str, logs))
    assert done.returncode == status, done.stdout + done.stderr
    figures: dict[str, Any] = json.loads(done.stdout)
    return figures


def steps_of(*logs: Path) -> int:
    return sum(1 for log in logs for message in LogReader(log, topics=[STEP]) if message.key == STEP.key)


HELD = """
[control]
start_mode = "closed"
[mirror]
on_command_timeout = "hold"
"""


class Night:
    """Processes started by hand, with a camera that loses frames."""

    def __init__(self, folder: Path, rate_hz: int) -> None:
        (folder / "night.toml").write_text(f"[camera]\nrate_hz = {rate_hz}\n{HELD}")
        self.folder = folder
        self.run: Run = open_run(new_run_id())
        shared = ["--run", self.run.run_id, "--config", str(folder / "night.toml")]
        self.commands = {
            "mirror": [sys.executable, "-m", "sim_dm", *shared],
            "controller": [*LOWFC, "controller", *shared],
            "recorder": [*LOWFC, "record", *shared, "--folder", str(folder / "logs")],
            "camera": [sys.executable, "-c", LOSSY_CAMERA, *shared],
        }
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.bus = ZenohBus(self.run.links, "operator", HostClock())

    def start(self, name: str, *more: str) -> None:
        with (self.folder / f"{name}.stderr").open("ab") as said:
            self.running[name] = subprocess.Popen([*self.commands[name], *more], stderr=said)

    def ask(self, name: str, *values: float) -> None:
        answers = self.bus.get(f"lowfc/request/{name}", wire.Request(values=values).SerializeToString(), 5.0)
        assert answers, f"nobody answered {name}"
        assert wire.Request.FromString(answers[0].payload).accepted

    def ready(self, name: str) -> bool:
        process = {"mirror": "mirror-dm"}.get(name, name)
        answers = self.bus.get(f"lowfc/health/{process}", timeout_s=0.5)
        return any(wire.Health.FromString(one.payload).state in ("ready", "running") for one in answers)

    def kill(self, name: str) -> None:
        process = self.running.pop(name)
        process.kill()
        process.wait()

    def stop(self) -> None:
        """From the source of the data to its end."""
        for name in ("camera", "controller", "mirror", "recorder"):
            process = self.running.pop(name, None)
            if process is not None:
                process.send_signal(signal.SIGTERM)
                process.wait(20)

    def close(self) -> None:
        for process in self.running.values():
            process.kill()
            process.wait()
        self.bus.close()
        self.run.remove()


@pytest.fixture
def night(tmp_path: Path) -> Iterator[Night]:
    made = Night(tmp_path, rate_hz=400)
    yield made
    made.close()


@pytest.mark.slow
def test_operators_a_restart_and_dropped_frames(night: Night, tmp_path: Path) -> None:
    for name in ("mirror", "controller", "recorder"):
        night.start(name)
    until(lambda: all(map(night.ready, night.running)))
    night.start("camera")
    until(lambda: night.ready("camera"))
    for gain in (0.2, 0.4, 0.6):
        night.ask("gain", gain)
        time.sleep(0.3)
    night.ask("open")
    time.sleep(0.2)
    night.ask("leak", 0.01)
    night.ask("close")
    time.sleep(0.3)
    night.kill("controller")
    time.sleep(0.2)
    night.start("controller")
    until(lambda: night.ready("controller"))
    for gain in (0.3, 0.5):
        night.ask("gain", gain)
        time.sleep(0.3)
    night.stop()
    (log,) = (tmp_path / "logs").iterdir()
    figures = replayed(tmp_path, log)
    assert (figures["identical"], figures["different"], figures["largest_difference_nm"]) == (True, 0, 0.0)
    assert figures["frames"] + figures["unchecked"] == steps_of(log) > 500
    assert figures["unchecked"] < 5, figures["unchecked_because"]  # what the kill cut off
    assert figures["requests"] == 8
    events = [message.payload for message in LogReader(log) if message.key == "lowfc/event"]
    assert any(b"FRAMES_MISSING" in payload for payload in events)
    assert any(b"MIRROR_ADOPTED" in payload for payload in events)
    starts = {message.sequence >> 32 for message in LogReader(log, topics=[CONTROLLER_STATE])}
    assert len(starts) == 2


@pytest.mark.slow
def test_rotated_logs_one_by_one_and_together(night: Night, tmp_path: Path) -> None:
    for name in ("mirror", "controller"):
        night.start(name)
    night.start("recorder", "--largest-mb", "12")
    until(lambda: all(map(night.ready, night.running)))
    night.start("camera")
    until(lambda: len(list((tmp_path / "logs").glob("*.mcap"))) >= 2)
    night.stop()
    logs = sorted((tmp_path / "logs").iterdir())
    assert len(logs) >= 3
    middle = replayed(tmp_path, logs[1])
    assert middle["identical"]
    assert 0 < middle["unchecked"] < 450  # a state comes every second
    assert middle["frames"] + middle["unchecked"] == steps_of(logs[1])
    together = replayed(tmp_path, *logs)
    assert (together["identical"], together["unchecked"]) == (True, 0)
    assert together["frames"] == steps_of(*logs)


@pytest.mark.slow
def test_a_log_cut_short_and_a_log_with_a_hole(tmp_path: Path) -> None:
    made = loop(tmp_path, "--lockstep", "--rate", "400", "--duration", "3")["log"]
    whole = replayed(tmp_path, made)
    assert (whole["frames"], whole["commands"], whole["unchecked"], whole["identical"]) == (1200, 1200, 0, True)
    data = made.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    short = replay_files([cut], 0.0, 1, lambda done: None)
    assert (short.account.identical, short.complete) == (True, False)
    assert 500 < short.account.frames < 1200
    hole = bytearray(data)
    middle = len(data) // 2
    hole[middle] ^= 0x40
    (tmp_path / "hole.mcap").write_bytes(hole)
    holed = replay_files([tmp_path / "hole.mcap"], 0.0, 1, lambda done: None)
    assert holed.account.identical
    assert len(holed.damage) == 1
    assert 600 < holed.account.frames < 1200
    there = len(list(LogReader(tmp_path / "hole.mcap", topics=[STEP], skip_damaged=True)))
    assert holed.account.frames + sum(holed.account.unchecked.values()) == there < 1200
    assert holed.account.missing == 1200 - there
    said = run(tmp_path, "replay", "hole.mcap").stdout
    assert "unchecked" in said
    assert "damaged" in said
    forged(made, tmp_path / "forged.mcap")
    done = run(tmp_path, "replay", "forged.mcap")
    assert done.returncode == 1
    assert "1200 frames, 1 messages differ" in done.stdout
    assert "first difference   MirrorCommand of frame 700 " in done.stdout
    assert "actuators: [600] log" in done.stdout
    assert "numpy              1.0 in the log" in done.stdout
    assert "cpu_features       abacus in the log, none here" in done.stdout
    assert replayed(tmp_path, tmp_path / "forged.mcap", "--tolerance", "0.001")["identical"]


@pytest.mark.slow
def test_a_minute_at_a_kilohertz_is_lossless_and_identical(tmp_path: Path) -> None:
    words = ("--rate", "1000", "--duration", "60", "--disturbance", "reaction-wheel")
    figures = loop(tmp_path, *words, timeout_s=200)
    assert figures["messages_lost"] == 0
    again = replayed(tmp_path, figures["log"])
    assert again["identical"]
    assert again["frames"] == figures["frames_processed"]
    assert again["unchecked"] == 0
