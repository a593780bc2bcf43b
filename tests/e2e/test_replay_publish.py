"""A log republished on the real bus, as received by a tool, a late joiner and a controller under test."""

import json
import signal
import socket
import subprocess
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import Run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.terminal import INTERRUPTED
from lowfc.contract.errors import BusError, ConfigurationError, DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    COMMAND,
    EVENT,
    FRAME,
    HEALTH,
    MIRROR_STATE,
    STEP,
    Topic,
    wire,
)
from lowfc.programs.logs.publish.player import Player, publish, render
from lowfc.programs.logs.publish.selection import PublishedKeys
from tests.support.loops import FIXED, LOWFC, loop, until

pytestmark = pytest.mark.exclusive


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = ("--lockstep", "--rate", "100", "--duration", "1")
    return Path(loop(tmp_path_factory.mktemp("night"), *options, config=FIXED)["log"])


@pytest.fixture(scope="module")
def logged(log: Path) -> dict[str, list[Sample]]:
    messages = defaultdict(list)
    for message in LogReader(log):
        messages[message.key].append(message)
    assert len(messages[FRAME.key]) > 80
    return messages


class Tool:
    """A user's own program: its role has no port, and it publishes no Health."""

    def __init__(self, run: Run, *topics: Topic) -> None:
        self.received: dict[str, list[Sample]] = defaultdict(list)
        self.bus = ZenohBus(run.links, "operator", HostClock())
        for topic in topics:
            self.bus.subscribe(topic, lambda sample: self.received[sample.key].append(sample))


@pytest.fixture
def tool(run: Run) -> Iterator[Tool]:
    tool = Tool(run, FRAME, STEP, MIRROR_STATE, COMMAND, EVENT, HEALTH)
    yield tool
    tool.bus.close()


def start(log: Path, run: Run, *options: str) -> "subprocess.Popen[str]":
    command = [*LOWFC, "publish", str(log), "--run", run.run_id, "--json", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def results_of(process: "subprocess.Popen[str]", status: int = 0) -> dict[str, Any]:
    output, stderr = process.communicate(timeout=60)
    assert process.returncode == status, stderr
    results: dict[str, Any] = json.loads(output)
    assert render(results)
    return results


def test_a_subscriber_receives_the_log_in_order_and_at_its_rate(
    log: Path, logged: dict[str, list[Sample]], run: Run, tool: Tool
) -> None:
    begun_ns = tool.bus.clock.host_ns()
    playing = start(log, run, "--speed", "2")
    until(lambda: tool.received[FRAME.key] or playing.poll() is not None)
    (calibration,) = tool.bus.get(CALIBRATION.key)
    (camera,) = tool.bus.get(CAMERA_STATE.key)
    results = results_of(playing)

    assert calibration.payload == logged[CALIBRATION.key][-1].payload
    assert camera.sequence in [message.sequence for message in logged[CAMERA_STATE.key]]
    for key in (FRAME.key, STEP.key, MIRROR_STATE.at("dm"), HEALTH.at("camera")):
        received, sent = tool.received[key], logged[key]
        assert [sample.payload for sample in received] == [message.payload for message in sent], key
        assert [sample.sequence for sample in received] == [message.sequence for message in sent], key
        times = [sample.publish_time_ns for sample in received]
        assert times == sorted(times)
        assert times[0] > begun_ns, "the time of publication is the present, not the log's"
        span_ns = sent[-1].receive_time_ns - sent[0].receive_time_ns
        assert times[-1] - times[0] > 0.9 * span_ns / 2, "published at twice the log's pace"
    frames = {sample.sequence for sample in tool.received[FRAME.key]}
    joined = {wire.ControlStep.FromString(sample.payload).frame_sequence for sample in tool.received[STEP.key]}
    assert joined
    assert joined <= frames

    command = COMMAND.at("dm")
    assert logged[command]
    assert command not in tool.received
    assert "allow-commands" in results["left_out"][command]
    assert HEALTH.at("recorder") not in tool.received
    assert HEALTH.at("replay") in tool.received
    assert results["published"][FRAME.key] == len(logged[FRAME.key])
    assert results["finished"]
    assert not results["interrupted"]
    assert results["timing_error_us"]["max"] >= results["timing_error_us"]["p50"] > 0


def test_a_truncated_log_is_published_faster_than_it_was_recorded_and_with_commands(
    log: Path, run: Run, tool: Tool, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap.part"
    content = log.read_bytes()
    cut.write_bytes(content[: len(content) * 2 // 3])
    recorded = defaultdict(list)
    for message in LogReader(cut):
        recorded[message.key].append(message.payload)
    assert len(recorded[COMMAND.at("dm")]) > 20
    results = results_of(start(cut, run, "--speed", "4", "--topics", "/lowfc/mirror/*", "--allow-commands"))
    for key in (COMMAND.at("dm"), MIRROR_STATE.at("dm")):
        assert [sample.payload for sample in tool.received[key]] == recorded[key]
    permitted = {HEALTH.at("replay"), EVENT.key, COMMAND.at("dm"), MIRROR_STATE.at("dm")}
    assert {key for key in tool.received if tool.received[key]} <= permitted
    assert not results["finished"]
    assert results["took_s"] < results["span_s"] * 0.9 or results["messages_behind"]


def test_a_live_controller_computes_the_recorded_errors(
    log: Path, logged: dict[str, list[Sample]], run: Run, tool: Tool, tmp_path: Path
) -> None:
    next(iter(reader := LogReader(log)))
    for name, content in reader.attachments.items():
        (tmp_path / name).write_bytes(content)
    files = ["--config", str(tmp_path / "config.toml"), "--calibration", str(tmp_path / "calibration.fits")]
    playing = start(log, run, "--speed", "2", "--wait-for", "controller")
    controller = subprocess.Popen([*LOWFC, "controller", "--run", run.run_id, *files], stderr=subprocess.DEVNULL)
    try:
        results = results_of(playing)
    finally:
        controller.terminate()
        controller.wait(10)
    assert results["left_out"][STEP.key] == "controller is live"

    recorded = [wire.ControlStep.FromString(message.payload) for message in logged[STEP.key]]
    errors = {step.frame_sequence: list(step.error_nm) for step in recorded}
    steps = [wire.ControlStep.FromString(sample.payload) for sample in tool.received[STEP.key]]
    assert {step.frame_sequence for step in steps} <= {message.sequence for message in logged[FRAME.key]}
    measured = [step for step in steps if step.error_nm and errors.get(step.frame_sequence)]
    assert len(measured) > len(errors) / 2
    for step in measured:  # the same frame through the same calibration, by another process on another day
        assert list(step.error_nm) == errors[step.frame_sequence]
    assert len(tool.received[COMMAND.at("dm")]) >= len(steps)


def test_publishing_holds_the_mirrors_role_until_ctrl_c_and_then_prints_the_summary(
    log: Path, run: Run, tool: Tool
) -> None:
    playing = start(log, run, "--speed", "0.05", "--topics", FRAME.key)
    until(lambda: tool.received[FRAME.key] or playing.poll() is not None)
    with pytest.raises(BusError, match="mirror-dm"):
        ZenohBus(run.links, "mirror-dm", HostClock())
    playing.send_signal(signal.SIGINT)
    results = results_of(playing, INTERRUPTED)
    assert results["interrupted"]
    assert set(results["published"]) == {FRAME.key}
    assert 0 < results["published"][FRAME.key] < 80
    assert "interrupted" in render(results)


def test_publishing_takes_the_roles_of_its_topics_and_with_frames_also_the_mirrors_role(run: Run) -> None:
    frames, steps = [FRAME.key], [STEP.key]
    assert PublishedKeys(run.links, frames, ()).roles == ("camera", "mirror-dm")
    assert PublishedKeys(run.links, frames, (), allow_commands=True).roles == ("camera",)
    assert PublishedKeys(run.links, steps, ()).roles == ("controller",)
    assert set(PublishedKeys(run.links, (), ()).roles) == {"camera", "controller", "mirror-dm"}


def test_a_log_without_the_selected_topics_is_an_error(log: Path, run: Run) -> None:
    with pytest.raises(DataFileError, match="no message of the selected topics"):
        publish([log], run.run_id, topics=["lowfc/control/request"])


def test_a_log_with_only_topics_of_a_live_controller_is_an_error_that_says_so(log: Path, run: Run) -> None:
    service = SimpleNamespace(running=True, clock=HostClock(), beat=lambda: None)
    selection = PublishedKeys(run.links, ["lowfc/control/ste*"], {"controller"})
    with pytest.raises(DataFileError, match=rf"selected topics; left out: {STEP.key} \(controller is live\)"):
        Player(service, {}, selection, 1.0, Console(quiet=True)).play([log])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"topics": ["lowfc/camera/fram"]}, "did you mean 'lowfc/camera/frame'"),
        ({"topics": ["lowfc/nothing/*"]}, "no topic fits"),
        ({"topics": ["lowfc/mirror/*/command"]}, "--allow-commands"),
        ({"wait_for": ["controler"]}, "did you mean 'controller'"),
        ({"speed": 0.0}, "above 0"),
    ],
)
def test_invalid_options_are_refused(log: Path, run: Run, options: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigurationError, match=expected):
        publish([log], run.run_id, **options)


@pytest.mark.parametrize(
    ("live", "options"),
    [
        ("camera", {}),
        ("camera", {"topics": ["lowfc/camera/*"]}),
        ("mirror-dm", {}),
        ("mirror-dm", {"topics": ["lowfc/camera/frame"]}),
        ("controller", {"topics": ["lowfc/mirror/dm/command"], "allow_commands": True}),
    ],
)
def test_a_log_is_not_published_while_a_process_of_a_published_role_is_live(
    log: Path, run: Run, live: str, options: dict[str, Any]
) -> None:
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", run.links.ports[live]))
        busy.listen()
        with pytest.raises(BusError, match=f"{live} of run '{run.run_id}' is live"):
            publish([log], run.run_id, **options)
