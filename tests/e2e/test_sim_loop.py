"""The simulated loop as a user runs it: real processes, a real bus, a real log."""

import json
import os
import re
import resource
import signal
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.logs.selection import EVERYTHING
from lowfc.contract.configuration import load
from lowfc.contract.messages import TOPICS, RawImage, from_timestamp, topic_of, wire
from lowfc.programs.cli.ctl import SAFE_BY_SIGNAL
from lowfc.programs.core.recording.volume import bytes_per_s
from tests.support.loops import FIXED, LOWFC, children, loop, lowfc, output_of, payloads, recorded_bytes, start, until
from tests.support.other_readers import foxglove

pytestmark = pytest.mark.exclusive

FRAMES = 1000


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("live")
    return loop(folder, "--duration", "2", "--rate", "500", "--star-magnitude", "0", "--seed", "3", config=FIXED)


@pytest.fixture(scope="module")
def topics(live: dict[str, Any]) -> dict[str, list[bytes]]:
    return payloads(live["log"])


def test_the_residual_is_below_half_of_the_disturbance_and_every_frame_is_counted(live: dict[str, Any]) -> None:
    assert live["frames_published"] == FRAMES
    assert live["frames_processed"] + live["frames_skipped"] + live["frames_missing"] == FRAMES
    assert live["frames_processed"] > 0.9 * FRAMES
    assert 0 < live["commands_applied"] <= live["frames_processed"]
    assert live["tilt_residual_mas"] < 0.5 * live["tilt_disturbance_mas"]
    assert live["residual_rms_nm"] < 0.5 * live["disturbance_rms_nm"]
    assert live["dark_zone_contrast"], "the camera computes it from full science images after its last frame"
    for stage in ("frame_to_command", "frame_to_mirror"):
        values = live["latency_us"][stage]
        assert 0 < values["p50"] <= values["p99"] <= values["p99_9"] <= values["max"]


def test_the_log_holds_every_topic_that_needs_no_request_and_lost_messages_are_counted(
    live: dict[str, Any], topics: dict[str, list[bytes]]
) -> None:
    recorded = sum(map(len, topics.values()))
    assert recorded == live["messages_recorded"]
    absent = {"lowfc/bench/{name}", *(f"lowfc/control/{name}" for name in ("request", "law", "play", "offload"))}
    assert {topic_of(topic[1:]).key for topic in topics} >= {topic.key for topic in TOPICS} - absent
    assert len(topics["/lowfc/camera/frame"]) <= FRAMES
    assert len(topics["/lowfc/calibration"]) == 1
    missing = FRAMES - len(topics["/lowfc/camera/frame"]) + FRAMES - len(topics["/lowfc/sim/truth"])
    assert live["messages_lost"] >= missing


def test_the_log_grows_at_the_estimated_rate(live: dict[str, Any]) -> None:
    info = json.loads(output_of(live["log"].parent, f"lowfc info {live['log']} --json"))
    constant_bytes = sum(info["attachments"].values()) + info["topics"]["lowfc/calibration"]["bytes"]
    growth_bytes_per_s = (info["bytes"] - constant_bytes) * 500 / FRAMES
    estimated_bytes_per_s = bytes_per_s(load(None, {"camera.rate_hz": 500.0}), EVERYTHING)
    assert estimated_bytes_per_s == pytest.approx(growth_bytes_per_s, rel=0.25)


def test_frame_step_command_and_state_can_be_joined(topics: dict[str, list[bytes]]) -> None:
    """Each message has the sequence of its frame; a step and a command also have the frame's time."""
    frames = {from_timestamp(RawImage.FromString(payload).timestamp) for payload in topics["/lowfc/camera/frame"]}
    steps = [wire.ControlStep.FromString(payload) for payload in topics["/lowfc/control/step"]]
    commands = {
        message.frame_sequence: message
        for message in map(wire.MirrorCommand.FromString, topics["/lowfc/mirror/dm/command"])
    }
    states = {
        message.frame_sequence: message
        for message in map(wire.MirrorState.FromString, topics["/lowfc/mirror/dm/state"])
        if message.status == wire.MIRROR_STATUS_FOLLOWING
    }
    joined = 0
    for step in steps:
        command, state = commands.get(step.frame_sequence), states.get(step.frame_sequence)
        if command is None or state is None or from_timestamp(step.timestamp) not in frames:
            continue
        joined += 1
        assert step.timestamp == command.timestamp
        assert list(step.command_nm) == list(command.command_nm)
        expected, driven = (np.frombuffer(message.actuators, "<f4") for message in (command, state))
        np.testing.assert_allclose(driven, expected, atol=0.02)  # the driver rounds to its steps
    assert joined > 0.8 * len(steps)


def test_npm_mcap_core_reads_the_same_messages(live: dict[str, Any], topics: dict[str, list[bytes]]) -> None:
    """npm's @mcap/core: same counts, valid CRCs, all attachments."""
    (read,) = foxglove([live["log"]])
    assert read["messages"] == read["counted"] == live["messages_recorded"]
    assert read["counts"] == {topic: len(values) for topic, values in topics.items()}
    assert set(read["attachments"]) == {"config.toml", "calibration.fits"}
    assert "lowfc" in read["metadata"]


def test_a_signal_makes_the_loop_safe_and_a_process_that_dies_is_named(tmp_path: Path) -> None:
    """The documented pattern of pkill finds the controller, and the log has the signal as a request."""
    (pattern,) = re.findall(r"pkill -USR1 -f '(.*)'", SAFE_BY_SIGNAL)
    process = start(tmp_path, "sim-loop", "--rate", "200", "--duration", "60")
    until(lambda: recorded_bytes(tmp_path) > 4e6)
    controller = children(process.pid)["controller"]
    command = Path(f"/proc/{controller}/cmdline").read_text().replace("\0", " ")
    assert re.search(pattern, command)
    assert not re.search(pattern, f"bash -c {command}")
    os.kill(controller, signal.SIGUSR1)
    until(lambda: "in safe mode" in lowfc("ctl", "status").stdout)
    os.kill(children(process.pid)["sim_dm"], signal.SIGKILL)
    stdout, stderr = process.communicate(timeout=30)
    assert process.returncode == 1
    assert not stdout
    assert "mirror-dm was killed by SIGKILL" in stderr
    assert "Traceback" not in stderr
    (log,) = (tmp_path / "logs").glob("*.mcap")  # the log is finished nevertheless
    assert stderr.endswith(f"recorded until then: logs/{log.name}\n")
    recorded = payloads(log)
    assert recorded["/lowfc/camera/frame"]
    requests = [wire.Request.FromString(payload) for payload in recorded["/lowfc/control/request"]]
    assert [(one.name, one.text, one.accepted) for one in requests if one.name == "safe"] == [("safe", "SIGUSR1", True)]


@pytest.mark.slow
def test_two_loops_on_one_host_do_not_mix(tmp_path: Path) -> None:
    first, second = (tmp_path / name for name in ("first", "second"))
    for folder in (first, second):
        folder.mkdir()
    other = start(
        first, "sim-loop", "--rate", "100", "--duration", "4", "--seed", "1", "--json", "--disturbance", "quiet"
    )
    results = loop(second, "--rate", "100", "--duration", "4", "--seed", "2", "--disturbance", "quiet")
    stdout, stderr = other.communicate(timeout=60)
    assert other.returncode == 0, stderr
    assert results["frames_published"] == 400
    assert len(payloads(results["log"])["/lowfc/camera/frame"]) <= 400
    assert '"frames_published": 400' in stdout


@pytest.mark.slow
def test_a_log_at_the_file_size_limit_does_not_stop_the_loop(tmp_path: Path) -> None:
    command = [*LOWFC, "sim-loop", "--rate", "200", "--duration", "1", "--json"]
    file_size_limit = (3_000_000, 3_000_000)
    done = subprocess.run(
        command,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, file_size_limit),
    )
    results = json.loads(done.stdout)
    assert done.returncode == 1, done.stderr
    assert "File too large" in results["recording_failure"]
    assert results["frames_published"] == 200
    assert results["frames_processed"] + results["frames_skipped"] == 200
    assert sum(results["lost"].values()) == results["messages_lost"] > 100
