"""Faults injected into a recorder: disks that fail, stall, fill up or vanish; frozen processes; forged messages."""

import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.bus.backlog import Backlog
from lowfc.adapters.bus.bus import Publisher, Query, Sample
from lowfc.adapters.bus.names import MAX_NAMES
from lowfc.adapters.logs import writer
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.series import LogLimits
from lowfc.adapters.logs.writer import UNFINISHED, Attachment
from lowfc.contract.envelope import count_of, sequence_of
from lowfc.contract.messages import CALIBRATION, COMMAND, EVENT, FRAME, HEALTH, RECORD_KEY, STEP, Topic, wire
from lowfc.programs.core.recording import recorder as recorder_module
from lowfc.programs.core.recording.summary import Summary
from tests.support.loops import mount, until
from tests.support.recording import PATIENCE_S, Bench, bodies_of, logged, put


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 4 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount("-t", "tmpfs", "-o", "size=4m", "tmpfs", folder)
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


def put_until(frames: Publisher, happened: Callable[[], bool]) -> None:
    """Put incompressible frames until `happened`, then ten more."""

    def put_four() -> None:
        for _ in range(4):
            frames.put(np.random.default_rng(frames.published).bytes(12_800))

    until(happened, each=put_four)
    put(frames, 10)


def check_account(bench: Bench, summary: Summary, frames: Publisher) -> int:
    """Check that summary, last Health and events count every frame missing from the logs; return the number lost."""
    messages = logged(summary)
    recorded = len(bodies_of(messages, FRAME))
    lost = frames.published - recorded
    assert summary.messages == len(messages)
    assert summary.lost.get(FRAME.key, 0) == lost
    health = bench.camera.last_health["recorder"]
    assert (health.state, health.recording.lost) == ("stopped", sum(summary.lost.values()))
    (count,) = (count for count in health.topics if count.topic == FRAME.key)
    assert (count.received, count.missing) == (recorded, lost)
    assert bench.losses()[FRAME.key] == lost
    return lost


def refuse_writes(bench: Bench, descriptor: int) -> None:
    """Replace the log's file by the one open as `descriptor`, which refuses writes; close `descriptor`."""
    os.dup2(descriptor, bench.recorder._series._log._raw.fileno())
    os.close(descriptor)


def write_to_dead_terminal(bench: Bench) -> None:
    """Replace the log's file by a terminal without its other end: a write fails with EIO."""
    master, slave = os.openpty()
    os.close(master)
    refuse_writes(bench, slave)


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        (write_to_dead_terminal, "Input/output error"),
        (lambda bench: refuse_writes(bench, os.open("/dev/full", os.O_WRONLY)), "No space left on device"),
        (lambda bench: shutil.rmtree(bench.folder), "the file was removed"),
    ],
)
def test_a_disk_error_ends_the_recording_but_not_the_process(
    bench: Bench, fault: Callable[[Bench], None], why: str
) -> None:
    bench.start()
    log, frames = bench.recorder._series._log, bench.camera.publisher(FRAME)
    put_until(frames, lambda: log.messages_written > 20)
    fault(bench)
    put_until(frames, lambda: "RECORDING_FAILED" in bench.events())
    time.sleep(0.6)  # longer than two flushes
    assert bench.thread.is_alive()
    assert "MESSAGES_LOST" not in bench.events(), "otherwise each flush reports every topic until the recorder ends"
    summary = bench.stop()
    assert why in summary.failure
    if not bench.folder.exists():
        assert summary.lost[FRAME.key] >= 10
        return
    assert summary.files == (log.part,)
    assert 10 <= check_account(bench, summary, frames) < frames.published - 10


def test_a_nearly_full_disk_leaves_a_complete_log(bench: Bench, small_disk: Path) -> None:
    bench.folder = small_disk / "logs"
    bench.start(limits=LogLimits(min_free_bytes=1_500_000))
    frames = bench.camera.publisher(FRAME)
    put_until(frames, lambda: "RECORDING_FAILED" in bench.events())
    assert bench.thread.is_alive()
    summary = bench.stop()
    assert "free some space" in summary.failure
    reader = LogReader(summary.files[0])
    list(reader)
    assert reader.complete
    assert reader.metadata["recording"]["stopped"] == summary.failure
    assert 10 <= check_account(bench, summary, frames) < frames.published - 10
    assert shutil.disk_usage(small_disk).free > 500_000


@pytest.mark.exclusive
def test_messages_lost_while_the_disk_stalls_are_counted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "QUEUE_MESSAGES", 100)
    monkeypatch.setattr(recorder_module, "_SLOW_NS", 50_000_000)
    monkeypatch.setattr(writer.os, "fsync", lambda descriptor: None)  # fsync fails on a pipe
    bench.start()
    log, frames, resume = bench.recorder._series._log, bench.camera.publisher(FRAME), threading.Event()
    file, (outlet, inlet) = os.dup(log._raw.fileno()), os.pipe()
    os.dup2(inlet, log._raw.fileno())  # a pipe to the file that blocks until `resume` is set
    os.close(inlet)

    def copy() -> None:
        resume.wait(PATIENCE_S)
        while data := os.read(outlet, 1 << 16):
            os.write(file, data)

    copier = threading.Thread(target=copy)
    copier.start()
    put_until(frames, lambda: len(bench.recorder._backlog) >= 100)
    time.sleep(0.1)
    resume.set()
    put_until(frames, lambda: "DISK_SLOW" in bench.events())
    until(lambda: len(bench.recorder._backlog) == 0)
    put(frames, 10)
    summary = bench.stop()
    copier.join()
    os.close(file)
    os.close(outlet)
    assert summary.failure == ""
    assert 10 <= check_account(bench, summary, frames) < frames.published - 100
    assert bodies_of(logged(summary), FRAME)[-1] == b"%s %d" % (FRAME.key.encode(), frames.published - 1)
    reader = LogReader(summary.files[0])
    list(reader)
    assert reader.metadata["recording"][f"lost {FRAME.key}"] == str(summary.lost[FRAME.key])
    assert summary.longest_unflushed_ns > 100_000_000


def slow_disk(monkeypatch: pytest.MonkeyPatch, *, refuses: bool) -> tuple[threading.Event, threading.Event]:
    """Block a log's flush; return two events: the flush has begun, and it may end (with an error if `refuses`)."""
    reached, release, sync = threading.Event(), threading.Event(), os.fsync

    def slow(descriptor: int) -> None:
        reached.set()
        assert release.wait(PATIENCE_S)
        if refuses:
            raise OSError(5, "Input/output error")
        sync(descriptor)

    monkeypatch.setattr(writer.os, "fsync", slow)
    return reached, release


@pytest.mark.parametrize("refused", [False, True])
def test_the_recorder_stays_responsive_while_a_stopped_log_is_written(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, refused: bool
) -> None:
    bench.start()
    put(bench.camera.publisher(FRAME), 10)
    reached, release = slow_disk(monkeypatch, refuses=refused)
    answers: list[Sample] = []
    asking = threading.Thread(
        target=lambda: answers.extend(bench.bus.get(RECORD_KEY.format(name="stop"), timeout_s=PATIENCE_S))
    )
    asking.start()
    assert reached.wait(PATIENCE_S)
    beats: list[int] = []
    bench.bus.subscribe(HEALTH, lambda sample: beats.append(sample.sequence), "recorder")
    until(lambda: len(beats) >= 2)
    put(bench.camera.publisher(STEP), 5)  # not recorded while stopped, and not lost
    assert not answers
    release.set()
    asking.join(PATIENCE_S)
    (answer,) = answers
    request = wire.Request.FromString(answer.payload)
    assert (request.accepted, "Input/output error" in request.reply) == (not refused, refused)
    until(lambda: bool(bench.camera.last_health["recorder"].recording.failure) is refused)
    until(lambda: bench.camera.last_health["recorder"].recording.stopped is not refused)
    monkeypatch.undo()
    summary = bench.stop()
    (log,) = summary.files
    assert str(log) == request.text
    assert log.name.endswith(UNFINISHED) == refused
    assert len(bodies_of(list(LogReader(log)), FRAME)) == 10
    assert refused or STEP.key not in summary.lost


def test_a_recorder_stopped_while_a_log_is_finished_completes_the_log(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.start()
    reached, release = slow_disk(monkeypatch, refuses=False)
    bench.bus.get(RECORD_KEY.format(name="stop"), timeout_s=0)
    assert reached.wait(PATIENCE_S)
    bench.recorder.service.stop("end of the test")
    until(lambda: bench.recorder.service.state == "stopping")
    release.set()
    (log,) = bench.stop().files
    assert not log.name.endswith(UNFINISHED)


def test_a_log_may_be_moved_as_soon_as_it_has_its_name(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "_sync_folder", lambda folder: next(folder.glob("*.mcap")).unlink())
    bench.start()
    assert bench.stop().failure == ""
    assert list(bench.folder.iterdir()) == [], "the log was moved before the recorder was done with it"


def test_a_stop_requested_while_the_recorder_ends_is_answered_with_the_complete_log(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.start()
    recorder, answers = bench.recorder, list[bytes]()
    queries = [Query(RECORD_KEY.format(name="stop"), b"", answers.append)]
    report = recorder._report_losses

    def report_and_ask() -> None:
        report()
        if not recorder.service.running and queries:
            recorder._queries.append(queries.pop())

    monkeypatch.setattr(recorder, "_drain", lambda: None)  # the request arrives after the last drain
    monkeypatch.setattr(recorder, "_report_losses", report_and_ask)
    _, release = slow_disk(monkeypatch, refuses=False)
    threading.Timer(0.2, release.set).start()
    (log,) = bench.stop().files
    assert [wire.Request.FromString(answer).text for answer in answers] == [str(log)]
    assert not log.name.endswith(UNFINISHED)


def test_a_frozen_process_does_not_block_the_recorder(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.start()
    queried, thawed = threading.Event(), threading.Event()

    def get(key: str, *, timeout_s: float) -> list[Sample]:
        queried.set()
        thawed.wait(PATIENCE_S)
        return []

    monkeypatch.setattr(bench.recorder._bus, "get", get)
    bench.service("camera-2").beat()  # a new process: the recorder queries it
    frames = bench.camera.publisher(FRAME)
    put_until(frames, queried.is_set)
    sent = frames.published
    until(lambda: bench.recorder._account.recorded().get(FRAME.key, 0) == sent)
    (part,) = bench.folder.iterdir()
    until(lambda: len(bodies_of(list(LogReader(part)), FRAME)) == sent)
    thawed.set()
    assert check_account(bench, bench.stop(), frames) == 0


def test_each_log_of_a_run_can_be_read_alone(bench: Bench) -> None:
    calibrations, frames = bench.controller.publisher(CALIBRATION), bench.camera.publisher(FRAME)
    put(calibrations, 1)
    lost = ("recorder", CALIBRATION.key, 1)
    bench.hub.lose = lambda role, key, envelope: (role, key, count_of(envelope.sequence)) == lost
    bench.start(
        limits=LogLimits(longest_s=0.2, min_free_bytes=0),
        attachments=[Attachment("a.toml", "application/toml", b"[a]")],
    )
    peers = bench.recorder._peers
    until(lambda: len(peers._states) == 3 and not peers._query_due and peers._answers is None)
    (second,) = put(calibrations, 1)
    put_until(frames, lambda: len(bench.recorder._series.files) == 3)
    summary = bench.stop()
    assert check_account(bench, summary, frames) == 0
    for number, path in enumerate(summary.files):
        reader = LogReader(path)
        messages = list(reader)
        assert reader.complete
        assert (reader.attachments, reader.metadata["lowfc"]) == ({"a.toml": b"[a]"}, {"run": "test"})
        assert messages[0].key == CALIBRATION.key
        # The second calibration was lost, and queried when the second log was begun.
        assert (second in bodies_of(messages, CALIBRATION)) == (number > 0)
    for start_s, time_ns in ((200, 10), (100, 20)):  # of two publishers, the value published last is in force
        peers.store(Sample("lowfc/bench/cover", b"", sequence_of(start_s, 0), time_ns, time_ns))
    assert peers.newest["lowfc/bench/cover"].publish_time_ns == 20


def message(topic: Topic, size: int) -> tuple[Topic, Sample]:
    return topic, Sample(topic.key, bytes(size), 0, 0, 0)


def test_the_backlog_is_bounded_by_number_and_size() -> None:
    backlog = Backlog(max_messages=3, max_bytes=1000)
    for size in (400, 400, 400, 200, 0):
        backlog.put(*message(FRAME, size))
    assert [len(backlog.take()[1].payload) for _ in range(len(backlog))] == [400, 400, 200]
    for _ in range(9):
        backlog.put(*message(STEP, 1))
    assert len(backlog) == 3
    for topic in (HEALTH, EVENT):  # never dropped: rare, and needed to account for the others
        backlog.put(*message(topic, 5000))
    assert len(backlog) == 5
    for _ in range(5):
        backlog.take()
    backlog.put(*message(FRAME, 1000))
    assert len(backlog) == 1


def test_forged_names_and_starts_do_not_fill_the_recorders_memory_or_a_log(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lowfc.programs.core.recording.recorder.MAX_CHANNELS", 100)
    bench.start()
    for number in range(1000):
        body = wire.Health(process=f"forged-{number}").SerializeToString()
        bench.bus.publisher(HEALTH, f"forged-{number}").put(body)
        bench.bus.publisher(COMMAND, f"forged-{number}").put(b"")
    until(lambda: "BAD_MESSAGE" in bench.events())
    first = bench.recorder.service.health().recording.file
    for start_s in range(1, 200):
        bench.bus.publisher(FRAME).put(b"", sequence=sequence_of(start_s, 0))
    until(lambda: bench.recorder.service.health().recording.file != first)
    summary = bench.stop()
    keys = {message.key for log in summary.files for message in LogReader(log)}
    assert sum("forged" in key for key in keys) == 2 * MAX_NAMES
    assert sum("forged" in key for key in bench.recorder._account.recorded()) == 2 * MAX_NAMES
