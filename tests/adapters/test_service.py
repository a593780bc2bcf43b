"""Behaviour of every process: health, events, unreadable messages, and how a signal ends it."""

import os
import signal
import subprocess
import sys
import termios
import time
from unittest.mock import Mock

import pytest

from lowfc import __version__
from lowfc.adapters.process.realtime import Granted
from lowfc.adapters.process.service import HEALTH_PERIOD_NS, MAX_PRINTED, PRINTED_PERIOD_NS, WAITING_NS
from lowfc.contract.envelope import count_of
from lowfc.contract.messages import COMMAND, EVENT, FRAME, HEALTH, from_timestamp, wire
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener

PATIENCE_S = 30.0


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def listener(clock: FakeClock) -> Listener:
    return Listener(clock, HEALTH)


def test_health_is_published_when_due_with_all_fields(listener: Listener, clock: FakeClock) -> None:
    def fill(health: wire.Health) -> None:
        health.commands_late = 3

    camera = listener.service("camera", granted=Granted(("one BLAS thread",), ()), fill=fill)
    frames = camera.publisher(FRAME)
    camera.beat()
    camera.beat()
    assert len(listener.messages(HEALTH)) == 1
    for _ in range(5):
        frames.put(b"")
        camera.work += 1
    clock.advance(HEALTH_PERIOD_NS)
    camera.beat()
    first, second = listener.messages(HEALTH)
    assert (first.state, first.rate_hz) == ("starting", 0.0)
    assert (second.process, second.run_id, second.pid, second.version) == ("camera", "test", os.getpid(), __version__)
    assert (second.commands_late, second.uptime_ns) == (3, HEALTH_PERIOD_NS)
    assert second.realtime_granted == ["one BLAS thread"]
    assert from_timestamp(second.timestamp) == clock.now_ns()
    assert 1 << 20 < second.memory_bytes < 1 << 36
    assert {count.topic: count.published for count in second.topics} == {
        "lowfc/event": 1,
        "lowfc/health/camera": 2,
        "lowfc/camera/frame": 5,
    }


@pytest.mark.parametrize("rate_hz", [0.5, 5.0, 1000.0])
def test_the_time_before_the_first_work_is_not_in_the_rate(
    listener: Listener, clock: FakeClock, rate_hz: float
) -> None:
    camera = listener.service("camera")
    for number in range(40):
        clock.advance(HEALTH_PERIOD_NS if number else 10_250_000_000)  # a long start-up
        camera.work = max(0, 1 + int((number - 8.25) * 0.5 * rate_hz)) if number > 8 else 0  # after 8.25 periods
        camera.beat()
    rates = [health.rate_hz for health in listener.messages(HEALTH) if health.rate_hz]
    assert rates
    assert all(0.75 * rate_hz <= rate <= 1.34 * rate_hz for rate in rates), rates


@pytest.mark.parametrize("rate_hz", [0.1, 0.7, 1.6, 5.0, 1000.0])
def test_the_rate_of_slow_work_is_measured_over_several_units_of_work(
    listener: Listener, clock: FakeClock, rate_hz: float
) -> None:
    """The rate also holds when a change of state publishes the Health; it becomes 0 when the work has ended."""
    camera = listener.service("camera")
    for number in range(300):
        camera.work = int(number * 0.5 * rate_hz)
        if number % 10 == 3:
            camera.state = "running"
        camera.beat()
        clock.advance(HEALTH_PERIOD_NS)
    rates = [health.rate_hz for health in listener.messages(HEALTH)]
    assert all(0.75 * rate_hz < rate < 1.3 * rate_hz for rate in rates[100:])
    for _ in range(1 + int(8 / rate_hz)):
        clock.advance(HEALTH_PERIOD_NS)
        camera.beat()
    assert listener.messages(HEALTH)[-1].rate_hz == 0


@pytest.mark.parametrize(("ahead_ms", "reported"), [(-99, False), (100, False), (101, True), (-250, True)])
def test_a_wrong_clock_is_reported_at_the_start(
    listener: Listener, clock: FakeClock, monkeypatch: pytest.MonkeyPatch, ahead_ms: int, reported: bool
) -> None:
    monkeypatch.setattr(clock, "ahead_ns", lambda: ahead_ms * 1_000_000)
    listener.service("camera")
    events = listener.event_texts(f"CLOCK_OFF the clock of all runs is {ahead_ms:+d} ms from the wall clock")
    assert len(events) == len(listener.event_texts("CLOCK_OFF")) == reported


def test_health_has_the_counts_of_a_mailbox(listener: Listener) -> None:
    camera, controller = listener.service("camera"), listener.service("controller")
    box = controller.mailbox(FRAME)
    frames = camera.publisher(FRAME)
    listener.hub.lose = lambda role, key, envelope: key == FRAME.key and count_of(envelope.sequence) == 1
    for _ in range(4):
        last = frames.put(b"").sequence
    box.take(0.0)
    (count,) = (count for count in controller.health().topics if count.topic == FRAME.key)
    assert (count.received, count.skipped, count.missing, count.last_sequence) == (3, 2, 1, last)


def test_real_time_measures_are_requested_once_when_the_process_is_ready(listener: Listener) -> None:
    at_ready = Mock(return_value=Granted(("huge pages",), (("big caches", "slow"),)))
    camera = listener.service("camera", granted=Granted(("one BLAS thread",), ()), at_ready=at_ready)
    for state in ("ready", "running", "ready"):
        camera.state = state
    assert [health.realtime_granted for health in listener.messages(HEALTH)] == [["one BLAS thread", "huge pages"]] * 3
    assert [log.message.split()[0] for log in listener.messages(EVENT)] == ["STARTED"]
    at_ready.assert_called_once_with()


def test_events_are_published_and_warnings_printed(
    listener: Listener, clock: FakeClock, capsys: pytest.CaptureFixture[str]
) -> None:
    controller = listener.service("controller", granted=Granted((), (("SCHED_FIFO", "a longer tail"),)))
    controller.event("FRAMES_BACK", silent_ms=12.4)
    assert [(log.name, log.message.split()[0], log.level) for log in listener.messages(EVENT)] == [
        ("controller", "STARTED", 2),
        ("controller", "REALTIME_REFUSED", 3),
        ("controller", "FRAMES_BACK", 2),
    ]
    assert listener.messages(EVENT)[-1].message == "FRAMES_BACK frames are back, the first exposed 12 ms after the last"
    assert from_timestamp(listener.messages(EVENT)[-1].timestamp) == clock.now_ns()
    printed = capsys.readouterr().err
    assert printed == "controller: REALTIME_REFUSED the host refused SCHED_FIFO: a longer tail\n"
    (_, terminal), stderr = os.openpty(), os.dup(2)
    termios.tcflow(terminal, termios.TCOOFF)  # stops its output, as Ctrl-S does
    os.dup2(terminal, 2)
    controller.event("CLOCK_OFF", ahead_ms=200)
    os.dup2(stderr, 2)
    assert not capsys.readouterr().err, "a write would halt the process"


def test_all_warnings_of_a_flood_are_in_the_log_but_only_the_first_are_printed(
    listener: Listener, clock: FakeClock, capsys: pytest.CaptureFixture[str]
) -> None:
    controller = listener.service("controller")
    for number in range(2 * MAX_PRINTED):
        controller.event("FRAMES_MISSING", count=1, number=number)
    controller.event("CLOCK_OFF", ahead_ms=200)
    clock.advance(PRINTED_PERIOD_NS)
    controller.event("FRAMES_MISSING", count=1, number=99)
    assert len(listener.event_texts("FRAMES_MISSING")) == 2 * MAX_PRINTED + 1
    printed = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in printed] == [
        *["FRAMES_MISSING"] * (MAX_PRINTED + 1),
        "CLOCK_OFF",
        "FRAMES_MISSING",
    ]
    assert printed[MAX_PRINTED] == "controller: FRAMES_MISSING recurs: more within 10 s are in the log only"
    assert "before frame 99" in printed[-1]


def test_processes_are_connected_when_each_has_received_the_others_health(listener: Listener) -> None:
    camera, controller = listener.service("camera"), listener.service("controller")
    assert camera.wait_for(["controller", "mirror-dm"], 0.0) == ("controller", "mirror-dm")
    camera.state = controller.state = "ready"  # controller received camera's Health before publishing its own
    assert camera.wait_for(["controller"], 0.0) == ()
    # The camera's Health was published before it received the controller's.
    assert controller.wait_for(["camera"], 0.0) == ("camera",)
    camera.beat()
    assert controller.wait_for(["camera"], 0.0) == ()
    mirror = listener.service("mirror-dm")
    mirror.beat()  # it exists, but is not ready
    assert camera.wait_for(["mirror-dm"], 0.0) == ("mirror-dm",)
    assert camera.last_health["mirror-dm"].state == "starting"


def test_a_newcomer_gets_a_health_before_the_next_is_due(listener: Listener) -> None:
    camera = listener.service("camera")
    camera.beat()
    camera.beat()
    assert len(listener.messages(HEALTH)) == 1
    controller = listener.service("controller")
    controller.beat()
    camera.beat()
    assert list(listener.messages(HEALTH)[-1].peers_alive) == ["controller"]
    controller.state = "ready"  # the controller's second Health, so that it is no newcomer
    camera.beat()
    assert [health.process for health in listener.messages(HEALTH)] == ["camera", "controller", "camera", "controller"]
    assert [camera.has_newcomers(), camera.has_newcomers()] == [True, False]
    listener.service("controller").beat()  # restarted with its former process id, as in a container
    assert camera.has_newcomers()
    before = len(listener.messages(HEALTH))
    for number in (1, 2, 1):  # two viewers, in turns
        listener.bus.publisher(HEALTH, "viewer").put(wire.Health(pid=number).SerializeToString())
        camera.beat()
    assert [health.process for health in listener.messages(HEALTH)[before:]] == ["", "camera", "", ""]  # "": a viewer


def test_a_flood_of_bad_messages_gives_one_event_and_the_last_health_has_all_counts(listener: Listener) -> None:
    mirror = listener.service("mirror-dm")
    for number in range(500):
        mirror.unreadable("lowfc/mirror/dm/command", f"reason {number}")
    mirror.beat()
    mirror.unreadable("lowfc/mirror/dm/command", "too short")
    mirror.beat()  # no Health is due
    mirror.stop("enough")
    mirror.finish()
    assert listener.event_texts("BAD_MESSAGE") == [
        "BAD_MESSAGE 500 messages on lowfc/mirror/dm/command could not be read; the last: reason 499",
        "BAD_MESSAGE 1 message on lowfc/mirror/dm/command could not be read; the last: too short",
    ]
    assert not mirror.running
    assert listener.messages(EVENT)[-1].message == "STOPPED mirror-dm stopped: enough"
    assert listener.messages(HEALTH)[-1].state == "stopped"
    assert {count.topic: count.published for count in listener.messages(HEALTH)[-1].topics} == {
        "lowfc/event": len(listener.messages(EVENT)),
        "lowfc/health/mirror-dm": len(listener.messages(HEALTH)),
    }


def test_an_unreadable_message_gives_an_event_without_traceback_or_stop(
    listener: Listener, capsys: pytest.CaptureFixture[str]
) -> None:
    mirror = listener.service("mirror-dm")
    read: list[int] = []
    decode = wire.MirrorCommand.FromString
    mirror.dispatch(COMMAND, lambda sample: read.append(len(decode(sample.payload).actuators)), "dm", period_ns=10**6)
    listener.bus.publisher(HEALTH, "stranger").put(b"\xff")
    commands = listener.bus.publisher(COMMAND, "dm")
    commands.put(b"\xff")
    commands.put(wire.MirrorCommand(actuators=b"1234").SerializeToString())
    mirror.beat()
    assert (mirror.running, read) == (True, [4])
    assert listener.event_texts("BAD_MESSAGE 1 message on lowfc/mirror/dm/command")
    assert listener.event_texts("BAD_MESSAGE 1 message on lowfc/health/*")
    assert not mirror.bus.faults.counts
    assert "Traceback" not in capsys.readouterr().err


LOOP = """
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener
from lowfc.contract.messages import FRAME

service = Listener(FakeClock()).service("camera")
box = service.mailbox(FRAME)
service.catch_signals()
print("up", flush=True)
while service.running:
    box.take(60.0)
print(service.why, flush=True)
if {stuck}:
    while True:
        box.take(60.0)
"""


@pytest.mark.parametrize(("name", "stuck", "status"), [("SIGTERM", False, 0), ("SIGINT", True, 128 + signal.SIGINT)])
def test_a_signal_ends_the_loop_and_a_second_interrupt_ends_the_process(name: str, stuck: bool, status: int) -> None:
    arguments = [sys.executable, "-c", LOOP.format(stuck=stuck)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "up\n"
        begun_s = time.monotonic()
        process.send_signal(signal.Signals[name])
        assert process.stdout.readline() == name + "\n"
        assert time.monotonic() - begun_s < PATIENCE_S, "the signal ended the wait"
        if stuck:
            process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == status


def test_a_process_prints_once_that_it_is_ready_and_once_what_it_waits_for(
    listener: Listener, clock: FakeClock, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = listener.service("camera", announces=True)
    controller = listener.service("controller", announces=True)
    controller.awaited = lambda: "a camera"
    quiet = listener.service("mirror-dm")
    camera.wait_for(["controller", "recorder"], 0.0)
    for process in (camera, controller, quiet):
        process.state = "ready"
    for _ in range(4):
        clock.advance(WAITING_NS)
        for process in (camera, controller, quiet):
            process.state = "running"
            process.beat()
    printed = capsys.readouterr().err.splitlines()
    assert printed[:2] == ["camera: ready (run test)", "controller: ready (run test)"]
    assert printed[2:] == ["camera: waiting for recorder (run test)", "controller: waiting for a camera (run test)"]
    camera.work = 1
    controller.stop("SIGINT")
    for process in (camera, controller, quiet):
        process.finish()
    assert capsys.readouterr().err.splitlines() == [
        "camera: stopped after 1 frame: finished (run test)",
        "controller: stopped after 0 frames: SIGINT (run test)",
    ]
