"""The recorder as a process: killed, stopped by signals or requests, refused if disk space is short."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import pytest

from lowfc.adapters.bus.run import Run, new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.writer import UNFINISHED
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.provenance import provenance
from lowfc.adapters.process.realtime import NOTHING
from lowfc.adapters.process.service import Service
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import FRAME, STEP, Role, Topic
from lowfc.programs.core.recording.summary import Summary
from lowfc.programs.launch.watch import topic_count
from tests.support.loops import json_of, lowfc, refusal, start, until
from tests.support.recording import PATIENCE_S, bodies_of

SAFE_S = 0.6
"""A kill -9 may lose only messages published less than this time before it."""


class Bench:
    """A run with a camera in this process and a recorder in another."""

    def __init__(self, folder: Path, *options: object) -> None:
        self.run = open_run(new_run_id())
        self.folder = folder / self.run.run_id
        clock = HostClock()
        self.bus = ZenohBus(self.run.links, "camera", clock)
        self.service = Service("camera", self.run.run_id, clock, self.bus)
        self.frames, self.steps = self.service.publisher(FRAME), self.service.publisher(STEP)
        self.service.state = "ready"
        self.recorder = start(folder, "record", "--run", self.run.run_id, "--folder", self.folder, *options)

    def put(self) -> None:
        number = self.frames.published
        self.frames.put(number.to_bytes(8) * 1600)
        self.steps.put(number.to_bytes(8) * 30)
        self.service.beat()

    def put_many(self, count: int) -> None:
        """Put `count` frames and steps, slowly enough for a loaded host; wait until the recorder has counted them."""
        for _ in range(count):
            self.put()
            time.sleep(0.002)
        until(lambda: self.recorder_is("ready") and self.recorded(FRAME) == self.recorded(STEP) == count)

    def recorded(self, topic: Topic) -> int:
        return topic_count(self.service.last_health["recorder"], topic.key).received

    def recorder_is(self, state: str) -> bool:
        self.service.beat()
        return "recorder" in self.service.last_health and self.service.last_health["recorder"].state == state

    def stop(self, *signals: int) -> tuple[str, str]:
        """Send the recorder these signals, 50 ms apart; return its output."""
        for number in signals:
            self.recorder.send_signal(number)
            time.sleep(0.05)  # by then the recorder waits for the camera's last Health
        if len(signals) == 1 and signals[0] != signal.SIGKILL:
            until(lambda: self.recorder_is("stopping"))
            self.service.finish()
        return self.recorder.communicate(timeout=PATIENCE_S)

    def close(self) -> None:
        self.recorder.kill()
        self.recorder.communicate()
        self.bus.close()
        self.run.remove()


@pytest.fixture
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup the recorder would ignore SIGHUP
    started = Bench(tmp_path, *getattr(request, "param", ()))
    signal.signal(signal.SIGHUP, inherited)
    with closing(started):
        until(lambda: started.recorder_is("ready"))
        yield started


@pytest.mark.parametrize("signals", [(signal.SIGHUP,), (signal.SIGINT, signal.SIGTERM), (signal.SIGKILL,)])
def test_the_log_has_every_message_after_any_signal(bench: Bench, signals: tuple[signal.Signals, ...]) -> None:
    bench.put_many(50)
    killed = signal.SIGKILL in signals
    if killed:
        time.sleep(SAFE_S)
    bench.stop(*signals)
    assert bench.recorder.returncode == (-signal.SIGKILL if killed else 0)
    (log,) = bench.folder.iterdir()
    reader = LogReader(log)
    messages = list(reader)
    assert (reader.complete, log.suffix == UNFINISHED) == (not killed, killed)
    assert list(reader.attachments) == ["config.toml"]
    assert abs(float(reader.metadata["lowfc"]["clock_ahead_ms"])) < 1000
    for topic in (FRAME, STEP):
        assert [int.from_bytes(body[:8]) for body in bodies_of(messages, topic)] == list(range(50))
    assert killed or reader.metadata["recording"]["messages_lost"] == "0"


@pytest.mark.parametrize("bench", [("--longest-s", 1, "--json")], indirect=True)
def test_record_rotates_logs_and_reports_messages_and_losses(bench: Bench) -> None:
    until(lambda: len(list(bench.folder.iterdir())) > 1, each=bench.put)
    bench.frames.published += 3  # three counts are skipped, as if messages were lost
    bench.put()
    out, errors = bench.stop(signal.SIGTERM)
    published = bench.frames.published - 3
    done = json.loads(out)
    logs = [Path(log) for log in done["logs"]]
    assert (bench.recorder.returncode, done["failure"]) == (0, None)
    assert sorted(bench.folder.iterdir()) == sorted(logs)
    assert len(logs) > 1
    assert (done["messages_lost"], done["lost"]) == (3, {FRAME.key: 3})
    assert f"MESSAGES_LOST 3 messages lost on {FRAME.key}" in errors
    readers = [LogReader(log) for log in logs]
    messages = [message for reader in readers for message in reader]
    assert all(reader.complete for reader in readers)
    assert (len(messages), len(bodies_of(messages, FRAME))) == (done["messages_recorded"], published)
    assert readers[-1].metadata["recording"][f"lost {FRAME.key}"] == "3"
    assert done["longest_unflushed_ms"] >= done["longest_wait_ms"] > 0


def test_a_recording_is_stopped_without_a_controller_and_a_second_recorder_is_refused(
    own_runtime: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lowfc.programs.core.recording.process.set_up_below_loop", lambda *_: NOTHING)
    (config := own_runtime / "other.toml").touch()
    assert "cannot listen" in refusal("record", "--run", bench.run.run_id, "--config", config)
    assert not (bench.run.path / "config.toml").exists()
    reader = LogReader(Path(json_of("ctl", "record", "stop")["log"]))
    assert (len(list(reader)) > 0, reader.complete) == (True, True)
    refused = refusal("ctl", "status", "--run", bench.run.run_id)
    assert f"run '{bench.run.run_id}' has no controller" in refused


@pytest.mark.usefixtures("own_runtime")
def test_a_recorder_in_lockstep_requests_no_real_time_priority(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    set_up = Mock(side_effect=DataFileError("set up"))
    monkeypatch.setattr("lowfc.programs.core.recording.process.set_up_below_loop", set_up)
    for lockstep in ("true", "false"):
        (config := tmp_path / "lowfc.toml").write_text(f"lockstep = {lockstep}")
        assert refusal("record", "--folder", tmp_path, "--run", new_run_id(), "--config", config) == "set up"
    priorities = [call.args[0] for call in set_up.mock_calls]
    assert priorities == [None, 10]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--folder", "{}/logs", "--min-free-mb", 1e9), "MB free, and recorder.min_free_mb is 1000000000"),
        (("--folder", "/proc/logs", "--min-free-mb", 0), "/proc/logs"),
        (("--folder", "{}/logs", "--longest-s", 0.5), "recorder.longest_s = 0.5"),
    ],
)
def test_an_impossible_recording_is_refused_before_any_file_is_created(
    options: tuple[object, ...], complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lowfc.programs.core.recording.process.set_up_below_loop", lambda *_: NOTHING)
    done = lowfc("record", "--run", new_run_id(), *(str(option).format(tmp_path) for option in options))
    assert (done.exception.exit_status, complaint in str(done.exception)) == (2, True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("own_runtime")
def test_a_recording_has_the_configuration_of_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded: list[tuple[float, int]] = []

    def record(run: Run, config: Configuration, calibration: Path | None, shared: bytes | None) -> Summary:
        recorded.append((config.star.magnitude, config.recorder.every))
        if shared is not None:
            (run.path / "config.toml").write_bytes(shared)
        return Summary((), 0, {}, "", 0, 0, 0)

    monkeypatch.setattr("lowfc.programs.core.recording.process.record", record)
    launcher_configuration = open_run("launched", listeners=(Role.LAUNCHER,)).path / "config.toml"
    launcher_configuration.write_text(load(None, {"star.magnitude": 3.0}).to_toml())
    other = tmp_path / "other.toml"
    other.write_text("[star]\nmagnitude = 4.0\n")
    for options in (
        ("launched", "--every", 5),
        ("launched", "--config", other),
        ("by-hand",),
        ("by-hand", "--every", 5, "--config", other),
        ("by-hand",),
    ):
        assert lowfc("record", "--run", *options).exit_code == 0
    default = Configuration().star.magnitude
    assert recorded == [(3.0, 5), (4.0, 1), (default, 1), (4.0, 5), (4.0, 1)]
    assert load(launcher_configuration).star.magnitude == 3.0


def test_the_provenance_identifies_processor_and_blas() -> None:
    recorded = provenance("night", seed=3)
    assert (recorded["run"], recorded["seed"], recorded["processors"]) == ("night", "3", str(os.cpu_count()))
    flags = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith(("flags", "Feat")))
    features = recorded["cpu_features"].split()
    assert features == sorted(set(features))
    assert set(features) <= set(flags.partition(":")[2].split())
    assert {"sse2", "asimd"} & set(features)
    assert all(recorded[key] for key in ("host", "kernel", "processor", "python", "numpy", "eclipse-zenoh"))
    assert any(character.isdigit() for character in recorded["blas"])
    import scipy.linalg  # noqa: F401  # loads a BLAS of its own, which the loop does not use

    assert provenance() == {key: value for key, value in recorded.items() if key not in ("run", "seed")}


def test_the_provenance_has_no_commit_if_git_is_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", Mock(side_effect=subprocess.TimeoutExpired("git", 1)))
    assert "git" not in provenance()
