"""The recorder: everything on the bus is in the log, or the log says what is missing."""

import threading
from collections import Counter
from pathlib import Path

import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.loss_account import LossAccount
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.envelope import Envelope, count_of, sequence_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    CAMERA_STATE,
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    HEALTH,
    STEP,
    Log,
    Topic,
    wire,
)
from lowfc.programs.core.recording.recorder import Recorder
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.loops import until
from tests.support.recording import PATIENCE_S, Bench, bodies_of, logged, put

pytestmark = pytest.mark.usefixtures("own_runtime")


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "logs")


def test_everything_is_recorded_verbatim(bench: Bench) -> None:
    frames, steps = bench.camera.publisher(FRAME), bench.controller.publisher(STEP)
    bench.start()
    sent = put(frames, 500), put(steps, 300)
    summary = bench.stop()
    messages = logged(summary)
    assert (bodies_of(messages, FRAME), bodies_of(messages, STEP)) == sent
    assert (summary.messages, summary.lost, summary.failure) == (len(messages), {}, "")
    (path,) = summary.files
    reader = LogReader(path)
    assert len(list(reader)) == len(messages)
    assert reader.metadata == {
        "lowfc": {"run": "night"},
        "part": {"of": path.stem, "number": "1"},
        "recording": {"messages": str(len(messages)), "messages_lost": "0"},
    }
    final = [wire.Health.FromString(m.payload) for m in messages if m.key == HEALTH.at("camera")][-1]
    assert final.state == "stopped"
    assert bench.camera.last_health["recorder"].recording == wire.Recording(
        file=str(path),
        messages=len(messages),
        bytes=path.stat().st_size,
        files=[str(path)],
        folder=str(Path.cwd()),
    )


@pytest.mark.parametrize("there", [False, True])
def test_a_log_of_a_run_in_which_nobody_was_is_not_kept(tmp_path: Path, there: bool) -> None:
    hub, clock = MemoryHub(), HostClock()
    recorder = Recorder(MemoryBus(hub, "recorder", clock), clock, "bnch", tmp_path / "logs", metadata={})
    thread = threading.Thread(target=recorder.run, daemon=True)
    thread.start()
    until(lambda: list((tmp_path / "logs").glob("*.part")))
    if there:  # a camera without Health, which comes after the recorder
        MemoryBus(hub, "camera", clock).publisher(FRAME).put(b"a frame")
    recorder.service.stop("told")
    thread.join(PATIENCE_S)
    assert len(list((tmp_path / "logs").iterdir())) == there
    assert len(recorder.service.health().recording.files) == there


def test_what_came_before_the_recorder_comes_first_and_once(bench: Bench) -> None:
    calibrations = bench.controller.publisher(CALIBRATION)
    states = bench.camera.publisher(CAMERA_STATE), bench.controller.publisher(CONTROLLER_STATE)
    put(calibrations, 2)
    for state in states:
        put(state, 3)
    frames = bench.camera.publisher(FRAME)
    put(frames, 10)  # before the recorder: not its loss
    bench.start()
    put(states[0], 1)
    put(frames, 10)
    summary = bench.stop()
    messages = logged(summary)
    firsts = [message for message in messages if message.key in (CALIBRATION.key, *(s.key for s in states))]
    assert [(m.key, count_of(m.sequence)) for m in firsts] == [
        (CAMERA_STATE.key, 2),
        (CONTROLLER_STATE.key, 2),
        (CALIBRATION.key, 1),
        (CAMERA_STATE.key, 3),
    ]
    assert messages[:3] == firsts[:3]
    assert len(bodies_of(messages, FRAME)) == 10
    assert summary.lost == {}


def test_every_lost_message_is_counted(bench: Bench) -> None:
    frames, steps = bench.camera.publisher(FRAME), bench.controller.publisher(STEP)

    def lose(role: str, key: str, envelope: Envelope) -> bool:
        count = count_of(envelope.sequence)
        return role == "recorder" and ((key == FRAME.key and count in (7, 8, 20, 49)) or key == STEP.key)

    bench.hub.lose = lose
    bench.start()
    put(frames, 50)  # the last one is lost too: only the camera knows
    put(steps, 5)  # none arrives
    summary = bench.stop()
    assert summary.lost == {FRAME.key: 4, STEP.key: 5}
    told = [event for event in bench.events if event.startswith("MESSAGES_LOST")]
    counts: Counter[str] = Counter()
    for event in told:
        _, count, *_, topic = event.split()
        counts[topic] += int(count)
    assert counts == summary.lost
    missing = {count.topic: count.missing for count in bench.camera.last_health["recorder"].topics if count.missing}
    assert missing == summary.lost
    (path,) = summary.files
    reader = LogReader(path)
    recorded = [Log.FromString(m.payload).message for m in reader if m.key == EVENT.key]
    assert [event for event in recorded if event.startswith("MESSAGES_LOST")] == told
    assert reader.metadata["recording"] == {
        "messages": str(summary.messages),
        "messages_lost": "9",
        f"lost {FRAME.key}": "4",
        f"lost {STEP.key}": "5",
    }


def test_a_folder_that_cannot_be_written_is_an_error(bench: Bench) -> None:
    bench.folder.write_text("a file")
    bus = MemoryBus(bench.hub, "recorder", bench.clock)
    with pytest.raises(DataFileError, match="cannot be made"):
        Recorder(bus, bench.clock, "night", bench.folder, metadata={}).run()


def entry(topic: Topic, count: int, start_s: int = 100, payload: bytes = b"", key: str = "") -> tuple[Topic, Sample]:
    return topic, Sample(key or topic.key, payload, sequence_of(start_s, count), 0, 0)


def test_the_ledger_knows_beginnings_gaps_and_restarts() -> None:
    ledger = LossAccount()
    for count in (5, 6, 9, 9, 4):  # one that came before, or is older than the first, fills no gap
        ledger.enter(*entry(FRAME, count), recorded=True)
    assert ledger.lost() == {FRAME.key: 2}
    for count in (3, 5):
        ledger.enter(*entry(FRAME, count, start_s=101), recorded=True)
    ledger.enter(*entry(FRAME, 6, start_s=101), recorded=False)
    assert ledger.lost() == {FRAME.key: 4}
    assert (ledger.news(), ledger.news()) == ({FRAME.key: 4}, {})
    ledger.enter(*entry(FRAME, 8, start_s=101), recorded=True)
    assert ledger.news() == {FRAME.key: 1}


def test_the_ledger_takes_a_loss_back_when_the_message_comes_late() -> None:
    ledger = LossAccount()
    for count in (5, 9, 7):
        ledger.enter(*entry(FRAME, count), recorded=True)
    assert (ledger.lost(), ledger.news()) == ({FRAME.key: 2}, {FRAME.key: 2})
    ledger.enter(*entry(FRAME, 6), recorded=True)
    ledger.enter(*entry(FRAME, 8), recorded=False)  # the disk did not take it
    assert (ledger.lost(), ledger.news(), ledger.recorded()) == ({FRAME.key: 1}, {}, {FRAME.key: 4})
    ledger.enter(*entry(FRAME, 12), recorded=True)
    assert (ledger.lost(), ledger.news()) == ({FRAME.key: 3}, {FRAME.key: 1}), "two were said already"


def test_the_ledger_does_not_count_what_the_camera_lost_before_it_could_send_it() -> None:
    ledger = LossAccount()

    def health(published: int, missing: int) -> None:
        said = wire.Health(process="camera")
        said.topics.add(topic=FRAME.key, published=published, missing=missing)
        ledger.believe(entry(HEALTH, 0, key=HEALTH.at("camera"))[1], said)

    ledger.enter(*entry(FRAME, 50), recorded=True)
    health(51, 7)  # before the first frame that came
    ledger.enter(*entry(FRAME, 53), recorded=True)
    health(54, 9)
    assert (ledger.lost(), ledger.news()) == ({}, {})
    ledger.enter(*entry(FRAME, 56), recorded=True)
    assert ledger.news() == {}, "the camera may still say that it lost them"
    health(57, 10)
    assert (ledger.news(), ledger.news()) == ({FRAME.key: 1}, {}), "one was lost on the way"


def test_the_ledger_counts_nothing_as_lost_that_was_sent_twice() -> None:
    ledger = LossAccount()
    for count in (0, 1, 1, 2, 2, 4, 4):
        ledger.enter(*entry(FRAME, count), recorded=True)
    ledger.settle()
    ledger.enter(*entry(FRAME, 4), recorded=True)
    ledger.revert()
    for published, lost in ((7, 1), (8, 1), (9, 2)):
        message = wire.Health(process="camera", state="stopped")
        message.topics.add(topic=FRAME.key, published=published)
        ledger.believe(entry(HEALTH, 0)[1], message)
        assert ledger.lost() == {FRAME.key: lost}, "3 was not heard, and what the camera sent beyond those seven"
    assert ledger.recorded() == {FRAME.key: 7}


def test_the_ledger_believes_the_last_health_of_each_start() -> None:
    ledger = LossAccount()

    def health(published: int, state: str, start_s: int = 100) -> None:
        message = wire.Health(process="camera", state=state)
        message.topics.add(topic=FRAME.key, published=published)
        message.topics.add(topic=STEP.key, received=9)
        message.topics.add(topic="lowfc/nothing", published=9)
        ledger.believe(entry(HEALTH, 0, start_s)[1], message)

    health(40, "running")  # what it sent before it was heard is not lost
    health(90, "running")  # and what is on its way is not lost yet
    assert ledger.lost() == {}
    health(100, "stopped")
    assert ledger.lost() == {FRAME.key: 60}
    ledger.enter(*entry(FRAME, 2, start_s=101), recorded=True)
    health(5, "stopped", start_s=101)
    assert ledger.lost() == {FRAME.key: 62}


def test_the_ledger_tells_apart_who_shares_a_topic() -> None:
    ledger = LossAccount()
    for name, count in (("camera", 0), ("controller", 0), ("camera", 1), ("controller", 2)):
        ledger.enter(*entry(EVENT, count, payload=Log(name=name).SerializeToString()), recorded=True)
    ledger.enter(*entry(EVENT, 0, payload=b"\xff"), recorded=True)
    assert ledger.lost() == {EVENT.key: 1}
