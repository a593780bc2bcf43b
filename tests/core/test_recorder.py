"""The recorder: every message on the bus is in the log, or counted in it as missing."""

import threading
from pathlib import Path

import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.names import MAX_HEALTH_LOGS, Names
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
        "lowfc": {"run": "test"},
        "part": {"of": path.stem, "number": "1"},
        "recording": {"messages": str(len(messages)), "messages_lost": "0"},
    }
    final = [wire.Health.FromString(m.payload) for m in messages if m.key == HEALTH.at("camera")][-1]
    assert final.state == "stopped"
    assert bench.camera.last_health["recorder"].recording == wire.Recording(
        file=str(path), messages=len(messages), bytes=path.stat().st_size, files=[str(path)], folder=str(Path.cwd())
    )


@pytest.mark.parametrize("camera_present", [False, True])
def test_a_log_is_kept_only_if_the_run_had_another_process(tmp_path: Path, camera_present: bool) -> None:
    hub, clock = MemoryHub(), HostClock()
    folder = tmp_path / "caf\udce9"  # a name in Latin-1, not valid as UTF-8
    recorder = Recorder(MemoryBus(hub, "recorder", clock), clock, "bnch", folder, metadata={})
    thread = threading.Thread(target=recorder.run, daemon=True)
    thread.start()
    until(lambda: list(folder.glob("*.part")))
    if camera_present:  # a camera that publishes no Health and starts after the recorder
        MemoryBus(hub, "camera", clock).publisher(FRAME).put(b"a frame")
    recorder.service.stop("end of the test")
    thread.join(PATIENCE_S)
    assert len(list(folder.iterdir())) == camera_present
    assert len(recorder.service.health().recording.files) == camera_present


def test_the_health_of_a_recorder_of_many_logs_names_the_newest_logs_and_is_accepted(tmp_path: Path) -> None:
    hub, clock = MemoryHub(), HostClock()
    recorder = Recorder(MemoryBus(hub, "recorder", clock), clock, "bnch", tmp_path / "logs", metadata={})
    recorder._series.files += [tmp_path / "logs" / f"20260101T000000Z-{number}.mcap" for number in range(5000)]
    _, health = Names().health(HEALTH.at("recorder"), recorder.service.health().SerializeToString())
    assert list(health.recording.files) == [str(path) for path in recorder._series.files[-MAX_HEALTH_LOGS:]]
    assert health.recording.file == str(recorder._series.files[-1])


def test_states_published_before_the_recorder_started_are_written_first_and_once(bench: Bench) -> None:
    calibrations = bench.controller.publisher(CALIBRATION)
    states = bench.camera.publisher(CAMERA_STATE), bench.controller.publisher(CONTROLLER_STATE)
    put(calibrations, 2)
    for state in states:
        put(state, 3)
    frames = bench.camera.publisher(FRAME)
    put(frames, 10)  # before the recorder started: not lost
    bench.start()
    put(states[0], 1)
    put(frames, 10)
    summary = bench.stop()
    messages = logged(summary)
    states_in_log = [message for message in messages if message.key in (CALIBRATION.key, *(s.key for s in states))]
    assert [(message.key, count_of(message.sequence)) for message in states_in_log] == [
        (CAMERA_STATE.key, 2),
        (CONTROLLER_STATE.key, 2),
        (CALIBRATION.key, 1),
        (CAMERA_STATE.key, 3),
    ]
    assert messages[:3] == states_in_log[:3]
    assert len(bodies_of(messages, FRAME)) == 10
    assert summary.lost == {}


@pytest.mark.parametrize("state", [wire.CameraState(rows=6, columns=7), None, b"\xff"])
def test_the_state_of_the_camera_is_queried_before_the_first_log_begins(
    bench: Bench, state: wire.CameraState | bytes | None
) -> None:
    if state is not None:
        payload = state if isinstance(state, bytes) else state.SerializeToString()
        bench.camera.publisher(CAMERA_STATE).put(payload)
    bench.start()
    bench.stop()
    assert bench.cameras == [state if isinstance(state, wire.CameraState) else None]


def test_every_lost_message_is_counted(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (working_folder := tmp_path / "here").mkdir()
    monkeypatch.chdir(working_folder)
    frames, steps = bench.camera.publisher(FRAME), bench.controller.publisher(STEP)

    def lose(role: str, key: str, envelope: Envelope) -> bool:
        count = count_of(envelope.sequence)
        return role == "recorder" and ((key == FRAME.key and count in (7, 8, 20, 49)) or key == STEP.key)

    bench.hub.lose = lose
    bench.start()
    working_folder.rmdir()  # the recorder does not need its working directory
    put(frames, 50)  # the last frame is lost too: only the camera's Health reveals it
    put(steps, 5)  # no step arrives
    summary = bench.stop()
    assert summary.lost == {FRAME.key: 4, STEP.key: 5}
    assert bench.losses() == summary.lost
    missing = {count.topic: count.missing for count in bench.camera.last_health["recorder"].topics if count.missing}
    assert missing == summary.lost
    (path,) = summary.files
    reader = LogReader(path)
    recorded = [Log.FromString(message.payload).message for message in reader if message.key == EVENT.key]
    losses = [event for event in recorded if event.startswith("MESSAGES_LOST")]
    assert losses == bench.event_texts("MESSAGES_LOST")
    assert reader.metadata["recording"] == {
        "messages": str(summary.messages),
        "messages_lost": "9",
        f"lost {FRAME.key}": "4",
        f"lost {STEP.key}": "5",
    }


def test_a_folder_that_cannot_be_written_is_an_error(bench: Bench) -> None:
    bench.folder.write_text("a file")
    bus = MemoryBus(bench.hub, "recorder", bench.clock)
    with pytest.raises(DataFileError, match="cannot be created"):
        Recorder(bus, bench.clock, "test", bench.folder, metadata={}).run()


def entry(topic: Topic, count: int, start_s: int = 100, payload: bytes = b"", key: str = "") -> tuple[Topic, Sample]:
    """Topic and sample of the message number `count` of a publisher that started at `start_s`."""
    return topic, Sample(key or topic.key, payload, sequence_of(start_s, count), 0, 0)


def test_the_loss_account_counts_gaps_from_the_first_message_of_each_start() -> None:
    account = LossAccount()
    for count in (5, 6, 9, 9, 4):  # a duplicate, or a message older than the first, fills no gap
        account.enter(*entry(FRAME, count), recorded=True)
    assert account.lost() == {FRAME.key: 2}
    for count in (3, 5):
        account.enter(*entry(FRAME, count, start_s=101), recorded=True)
    account.enter(*entry(FRAME, 6, start_s=101), recorded=False)
    assert account.lost() == {FRAME.key: 4}
    assert (account.newly_lost(), account.newly_lost()) == ({FRAME.key: 4}, {})
    account.enter(*entry(FRAME, 8, start_s=101), recorded=True)
    assert account.newly_lost() == {FRAME.key: 1}


def test_a_late_message_is_removed_from_the_losses() -> None:
    account = LossAccount()
    for count in (5, 9, 7):
        account.enter(*entry(FRAME, count), recorded=True)
    assert (account.lost(), account.newly_lost()) == ({FRAME.key: 2}, {FRAME.key: 2})
    account.enter(*entry(FRAME, 6), recorded=True)
    account.enter(*entry(FRAME, 8), recorded=False)  # not written to the disk
    assert (account.lost(), account.newly_lost(), account.recorded()) == ({FRAME.key: 1}, {}, {FRAME.key: 4})
    account.enter(*entry(FRAME, 12), recorded=True)
    assert (account.lost(), account.newly_lost()) == ({FRAME.key: 3}, {FRAME.key: 1}), "two were already reported"


def reconcile(account: LossAccount, published: int, state: str = "", missing: int = 0, start_s: int = 100) -> None:
    """Reconcile the account with the Health of a camera that published `published` frames and missed `missing`."""
    message = wire.Health(process="camera", state=state)
    message.topics.add(topic=FRAME.key, published=published, missing=missing)
    message.topics.add(topic=STEP.key, received=9)
    message.topics.add(topic="lowfc/nothing", published=9)
    account.reconcile(entry(HEALTH, 0, start_s, key=HEALTH.at("camera"))[1], message)


def test_frames_that_the_camera_missed_before_publishing_are_not_losses() -> None:
    account = LossAccount()
    account.enter(*entry(FRAME, 50), recorded=True)
    reconcile(account, 51, missing=7)  # missed before the first frame that the recorder received
    account.enter(*entry(FRAME, 53), recorded=True)
    reconcile(account, 54, missing=9)
    assert (account.lost(), account.newly_lost()) == ({}, {})
    account.enter(*entry(FRAME, 56), recorded=True)
    assert account.newly_lost() == {}, "the camera may still report frames 54 and 55 as missed"
    reconcile(account, 57, missing=10)
    assert (account.newly_lost(), account.newly_lost()) == ({FRAME.key: 1}, {}), "one frame was lost on the bus"


def test_duplicates_neither_count_as_losses_nor_hide_them() -> None:
    account = LossAccount()
    for count in (0, 1, 1, 2, 2, 4, 4):
        account.enter(*entry(FRAME, count), recorded=True)
    account.mark_flushed()
    account.enter(*entry(FRAME, 4), recorded=True)
    account.revert()
    for published, lost in ((7, 1), (8, 1), (9, 2)):
        reconcile(account, published, "stopped")
        assert account.lost() == {FRAME.key: lost}, "frame 3 is lost, and one more message if nine were published"
    assert account.recorded() == {FRAME.key: 7}


def test_the_last_health_of_each_start_determines_the_losses_of_that_start() -> None:
    account = LossAccount()
    reconcile(account, 40, "running")  # messages before the first Health do not count as lost
    reconcile(account, 90, "running")  # messages may still arrive
    assert account.lost() == {}
    reconcile(account, 100, "stopped")
    assert account.lost() == {FRAME.key: 60}
    account.enter(*entry(FRAME, 2, start_s=101), recorded=True)
    reconcile(account, 5, "stopped", start_s=101)
    assert account.lost() == {FRAME.key: 62}


def test_gaps_are_counted_per_publisher_of_a_shared_topic() -> None:
    account = LossAccount()
    for name, count in (("camera", 0), ("controller", 0), ("camera", 1), ("controller", 2)):
        account.enter(*entry(EVENT, count, payload=Log(name=name).SerializeToString()), recorded=True)
    account.enter(*entry(EVENT, 0, payload=b"\xff"), recorded=True)
    assert account.lost() == {EVENT.key: 1}
