"""Behaviour common to the memory bus and the zenoh bus; zenoh's links, passwords, slow readers and session ends."""

import itertools
import json
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import zenoh

from lowfc.adapters.bus.bus import Bus, Faults, Query, Sample
from lowfc.adapters.bus.mailbox import Mailbox
from lowfc.adapters.bus.run import Run, new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import CLOSE_S, ZenohBus
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.envelope import Envelope, count_of, start_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import CALIBRATION, COMMAND, FRAME, HEALTH, REQUEST_KEY, TRUTH, Topic
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.loops import socket_options, until

PATIENCE_S = 30.0
Join = Callable[..., ZenohBus]


@pytest.fixture(autouse=True)
def _runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="bus-") as path:  # a path short enough for Unix sockets
        monkeypatch.setenv("XDG_RUNTIME_DIR", path)
        monkeypatch.setenv("ZENOH_RUNTIME", "")  # so that pytest removes the value that a monitor sets
        monkeypatch.delenv("ZENOH_RUNTIME")
        yield


@pytest.fixture
def join(run: Run) -> Iterator[Join]:
    buses: list[ZenohBus] = []

    def new_bus(role: str, **options: bool) -> ZenohBus:
        buses.append(ZenohBus(run.links, role, HostClock(), **options))
        return buses[-1]

    yield new_bus
    for bus in buses:
        bus.close()


@pytest.fixture(params=["memory", "zenoh"])
def pair(request: pytest.FixtureRequest, join: Join) -> tuple[Bus, Bus]:
    """Buses of a controller and an operator, linked."""
    if request.param == "memory":
        hub, clock = MemoryHub(), FakeClock()
        return MemoryBus(hub, "controller", clock), MemoryBus(hub, "operator", clock)
    buses = join("controller"), join("operator")
    until(lambda: all(bus.peers() for bus in buses))
    return buses


def test_a_put_reaches_every_subscriber_of_its_key(pair: tuple[Bus, Bus]) -> None:
    controller, operator = pair
    all_mirrors, dm, tip, frames = ([] for _ in range(4))
    for received, topic, *name in ((all_mirrors, COMMAND), (dm, COMMAND, "dm"), (tip, COMMAND, "tip"), (frames, FRAME)):
        controller.subscribe(topic, received.append, *name)
    publisher = operator.publisher(COMMAND, "dm")
    until(lambda: all_mirrors and dm, each=lambda: publisher.put(b"body", publish_time_ns=3))
    first = all_mirrors[0]
    assert (first.key, first.payload, first.publish_time_ns) == (COMMAND.at("dm"), b"body", 3)
    assert not tip
    assert not frames


def test_closing_a_link_does_not_block_its_process(join: Join) -> None:
    buses = [join(role) for role in ("controller", "camera")]
    until(lambda: all(bus.peers() for bus in buses))
    until(lambda: not any(socket_options(socket.SOL_SOCKET, socket.SO_LINGER)))  # with it, a close waits up to 10 s


def test_a_query_returns_the_last_message_with_its_envelope(pair: tuple[Bus, Bus]) -> None:
    controller, operator = pair
    calibrations, frames = controller.publisher(CALIBRATION), controller.publisher(FRAME)
    assert operator.get(CALIBRATION.key, timeout_s=0.1) == []
    calibrations.put(b"old")
    body = bytes(range(256)) * 12_000  # 3 MB, as a large calibration
    envelope = calibrations.put(body)
    frames.put(b"frame")
    until(lambda: operator.get(CALIBRATION.key))
    (answer,) = operator.get(CALIBRATION.key, timeout_s=PATIENCE_S)
    assert (answer.key, answer.payload) == (CALIBRATION.key, body)
    assert (answer.sequence, answer.publish_time_ns) == (envelope.sequence, envelope.publish_time_ns)
    assert calibrations.last == (body, envelope)
    assert operator.get(FRAME.key, timeout_s=0.1) == []
    operator.publisher(HEALTH, "operator").put(b"operator")
    controller.publisher(HEALTH, "controller").put(b"controller")
    until(lambda: {health.payload for health in operator.get(HEALTH.at("*"))} == {b"controller", b"operator"})


def test_a_query_may_be_answered_later_from_another_thread(pair: tuple[Bus, Bus]) -> None:
    controller, operator = pair
    waiting: list[Query] = []
    controller.queryable(REQUEST_KEY.format(name="*"), waiting.append)
    answers: list[Sample] = []

    def ask() -> None:
        while not answers:  # a query sent before the link is up reaches nobody
            answers.extend(operator.get("lowfc/request/gain", b"0.5", timeout_s=PATIENCE_S))

    asker = threading.Thread(target=ask)
    asker.start()
    until(lambda: waiting)
    assert (waiting[0].name, waiting[0].payload) == ("gain", b"0.5")
    waiting[0].reply(b"done")
    asker.join(PATIENCE_S)
    assert [(answer.key, answer.payload) for answer in answers] == [("lowfc/request/gain", b"done")]


def test_the_error_of_a_handler_is_printed_once_and_affects_no_other_handler(
    pair: tuple[Bus, Bus], capfd: pytest.CaptureFixture[str]
) -> None:
    controller, operator = pair
    box, fail = Mailbox(), Mock(side_effect=RuntimeError("handler broke"))
    controller.subscribe(COMMAND, fail)
    controller.subscribe(COMMAND, box.put)
    controller.queryable("lowfc/request/*", fail)
    publisher = operator.publisher(COMMAND, "dm")
    until(lambda: box.received >= 3, each=lambda: publisher.put(b""))  # the link is up, so the query arrives too
    assert operator.get("lowfc/request/open", timeout_s=0.5) == []
    assert controller.faults.counts["controller: handler of lowfc/mirror/*/command"] >= 3
    assert controller.faults.counts["controller: queryable of lowfc/request/open"] == 1
    assert capfd.readouterr().err.count("RuntimeError: handler broke") == 2


def test_sequences_count_from_zero_and_never_repeat(join: Join) -> None:
    starts = []
    for _ in range(3):  # restarted within one second
        bus = join("camera")
        publisher = bus.publisher(FRAME)
        sequences = [publisher.put(b"").sequence for _ in range(3)]
        assert [count_of(sequence) for sequence in sequences] == [0, 1, 2]
        starts += [start_of(sequences[0])]
        bus.close()
    assert starts == sorted(set(starts))


def test_sequences_of_the_memory_bus_never_repeat() -> None:
    hub, clock = MemoryHub(), FakeClock()
    camera = MemoryBus(hub, "camera", clock)
    first = camera.publisher(FRAME).put(b"").sequence
    camera.close()
    assert start_of(MemoryBus(hub, "camera", clock).publisher(FRAME).put(b"").sequence) == start_of(first) + 1
    with pytest.raises(BusError, match="closed"):
        camera.publisher(FRAME).put(b"")


def test_sessions_without_the_password_receive_and_send_nothing(run: Run, join: Join, tmp_path: Path) -> None:
    camera = join("camera")
    configs = [session_config(run.links, "operator")]
    del configs[0]["transport"]["auth"]
    for user in ("lowfc", "intruder"):
        (tmp_path / "credentials").write_text(f"{user}:wrong\n")
        configs.append(session_config(replace(run.links, user=user, secret_file=tmp_path / "credentials"), "operator"))
    overheard: list[zenoh.Sample] = []
    received, forgeries, frames = Mailbox(), Mailbox(), camera.publisher(FRAME)
    camera.subscribe(COMMAND, forgeries.put)
    with ExitStack() as stack:
        sessions = [zenoh.open(zenoh.Config.from_json5(json.dumps(config))) for config in configs]
        intruders = [stack.enter_context(session) for session in sessions]
        for intruder in intruders:
            intruder.declare_subscriber(FRAME.key, overheard.append)
        join("viewer").subscribe(FRAME, received.put)  # after the intruders, with the right password

        def exchange() -> None:
            frames.put(b"frame")
            for intruder in intruders:
                intruder.put(COMMAND.at("dm"), b"command", attachment=Envelope(1, 1).encode())

        until(lambda: received.received > 20, each=exchange)
    assert (overheard, forgeries.received) == ([], 0)


def test_messages_without_a_valid_envelope_are_counted_and_print_no_traceback(
    run: Run, join: Join, capfd: pytest.CaptureFixture[str]
) -> None:
    controller = join("controller")
    box = Mailbox()
    controller.subscribe(FRAME, box.put)
    ring = controller.ring(HEALTH, 10)
    with zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(run.links, "camera")))) as stranger:
        for attachment in (None, b"xyz", b"\xff" * 16):

            def put(attachment: bytes | None = attachment) -> bool:
                stranger.put(FRAME.key, b"bare", attachment=attachment)
                stranger.put(HEALTH.at("camera"), b"bare", attachment=attachment)
                assert ring.drain() == []
                return set(controller.faults.unreadable) == {FRAME.key, HEALTH.at("*")}

            until(put)
            assert all("envelope" in str(why) for _, why in controller.faults.take_unreadable().values())
    assert box.received == 0
    assert not controller.faults.counts
    assert "Traceback" not in capfd.readouterr().err


def test_a_closed_ring_has_no_subscriber(join: Join) -> None:
    operator, camera = join("operator"), join("camera")
    frames = camera.publisher(FRAME)
    ring = operator.ring(FRAME, 4)
    until(lambda: frames._publisher.matching_status.matching)
    ring.close()
    until(lambda: not frames._publisher.matching_status.matching)
    ring.close()


def test_a_listening_role_runs_only_once(run: Run, join: Join) -> None:
    join("camera")
    with pytest.raises(BusError, match=rf"camera of run '{run.run_id}' .* 127.0.0.1:{run.links.ports['camera']}"):
        join("camera")
    join("operator")
    join("operator")  # a role that does not listen may run twice


def test_each_role_listens_on_its_port_and_socket_and_connects_to_all_others(run: Run) -> None:
    endpoints = {role: f"tcp/127.0.0.1:{port}" for role, port in run.links.ports.items()}
    sockets = {role: f"unixsock-stream/{run.path}/{role}.sock" for role in endpoints}
    for role, own in endpoints.items():
        config = session_config(run.links, role)
        assert config["listen"]["endpoints"] == [own, sockets[role]]
        assert set(config["connect"]["endpoints"]) == set(endpoints.values()) - {own}
        assert not config["scouting"]["multicast"]["enabled"]
        assert not config["scouting"]["gossip"]["enabled"]
        assert not config["transport"]["shared_memory"]["enabled"]
    for role, monitor, expected in (("operator", False, endpoints), ("viewer", True, sockets)):
        config = session_config(run.links, role, monitor=monitor)
        assert config["listen"]["endpoints"] == []
        assert set(config["connect"]["endpoints"]) == set(expected.values())


def test_monitors_connect_by_port_if_the_socket_path_is_too_long(tmp_path: Path) -> None:
    base = tmp_path / ("long" * 25)
    base.mkdir(mode=0o700)
    links = open_run(new_run_id(), base=base).links
    endpoints = {f"tcp/127.0.0.1:{port}" for port in links.ports.values()}
    assert len(session_config(links, "camera")["listen"]["endpoints"]) == 1
    assert set(session_config(links, "viewer", monitor=True)["connect"]["endpoints"]) == endpoints


@pytest.mark.exclusive
def test_a_monitor_receives_every_truth_message_but_frames_only_at_display_rate(join: Join) -> None:
    camera, viewer, recorder = join("camera"), join("viewer", monitor=True), join("recorder")
    frames, truths = camera.publisher(FRAME), camera.publisher(TRUTH)
    frame_ring, truth_ring, recorded = viewer.ring(FRAME, 5000), viewer.ring(TRUTH, 5000), Mailbox()
    recorder.subscribe(FRAME, recorded.put)
    drained: dict[Topic, list[Sample]] = {FRAME: [], TRUTH: []}

    def drain() -> None:
        drained[FRAME] += frame_ring.drain()
        drained[TRUTH] += truth_ring.drain()

    def put() -> Envelope:
        frames.put(b"frame")
        return truths.put(b"truth")

    until(lambda: drained[FRAME] and drained[TRUTH] and recorded.received, each=lambda: (put(), drain()))
    drained_before = {topic: len(samples) for topic, samples in drained.items()}
    recorded_before = recorded.received
    for _ in range(250):
        last = put()
        time.sleep(0.002)
    all_recorded = recorded_before + 250
    until(lambda: drained[TRUTH][-1].sequence == last.sequence and recorded.received >= all_recorded, each=drain)
    assert len(drained[TRUTH]) - drained_before[TRUTH] >= 250
    assert 5 < len(drained[FRAME]) - drained_before[FRAME] < 125


# A recorder that drains its ring on request, and prints how many messages it received so far, how many of these are
# complete, and the number in the last complete message.
RECORDER = """
import sys
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.messages import FRAME, HEALTH

received = []
bus = ZenohBus(open_run(sys.argv[1]).links, "recorder", HostClock())
ring = bus.ring(FRAME, 4096)
bus.publisher(HEALTH, "recorder").put(b"")
while sys.stdin.readline():
    received += [sample.payload for sample in ring.drain()]
    complete = [payload for payload in received if payload == payload[:8] * 1600]
    print(len(received), len(complete), int(complete[-1][:8]) if complete else -1, flush=True)
"""


class Reader:
    """A recorder in a separate process, connected to the camera."""

    def __init__(self, run: Run, camera: ZenohBus) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", RECORDER, run.run_id], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.camera = camera
        self.frames = camera.publisher(FRAME)
        self.numbers = itertools.count()

    def put(self) -> int:
        number = next(self.numbers)
        self.frames.put(b"%08d" % number * 1600)
        return number

    def drain(self) -> list[int]:
        """Let the recorder drain its ring; return the three numbers that it prints."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return [int(word) for word in self.process.stdout.readline().split()]


@pytest.fixture
def reader(run: Run, join: Join) -> Iterator[Reader]:
    recorder = Reader(run, join("camera"))
    until(lambda: recorder.drain()[0] > 0, each=recorder.put)
    yield recorder
    recorder.process.kill()
    recorder.process.communicate()


def test_a_suspended_subscriber_does_not_delay_the_others(reader: Reader, join: Join) -> None:
    box = Mailbox()
    join("controller").subscribe(FRAME, box.put)
    until(lambda: box.take(0.01), each=reader.put)
    reader.process.send_signal(signal.SIGSTOP)
    for _ in range(1500):  # 19 MB, more than the link can buffer; if put blocked, zenoh would close the link
        reader.put()
        assert box.take(PATIENCE_S)
    reader.process.send_signal(signal.SIGCONT)
    last = reader.put()
    until(lambda: reader.drain()[2] > last, each=reader.put)
    received, complete, _ = reader.drain()
    assert received == complete < reader.frames.published


def test_closing_a_session_leaves_a_slow_reader_only_complete_messages(reader: Reader) -> None:
    reader.process.send_signal(signal.SIGSTOP)
    for _ in range(1000):  # more than the socket can buffer
        reader.put()
    threading.Timer(0.2, reader.process.send_signal, [signal.SIGCONT]).start()
    reader.camera.close()
    received, complete, _ = reader.drain()
    assert received == complete
    assert complete > 15  # the queue and the socket hold more than 15 messages


def test_a_session_ends_although_a_handler_never_returns(join: Join, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lowfc.adapters.bus.zenoh_bus.CLOSE_S", 0.1)
    free = threading.Event()
    handler = Mock(side_effect=lambda _: free.wait())
    mirror, frames = join("mirror-dm"), join("camera").publisher(FRAME)
    mirror.subscribe(FRAME, handler)
    until(lambda: handler.called, each=lambda: frames.put(b"frame"))
    timer = threading.Timer(PATIENCE_S, free.set)
    timer.start()
    mirror.close()
    timer.cancel()
    assert not free.is_set()
    free.set()


def test_a_session_ends_soon_while_another_process_is_suspended(run: Run) -> None:
    """The host accepts connections for a suspended camera; `lowfc ctl safe` must end soon nevertheless."""
    with socket.create_server(("127.0.0.1", run.links.ports["camera"])):
        operator = ZenohBus(run.links, "operator", HostClock())
        begun_s = time.monotonic()
        operator.close()
    assert time.monotonic() - begun_s < CLOSE_S, "the session should have closed before the timeout of `close`"


def test_each_use_of_a_key_on_a_closed_bus_raises_a_bus_error(run: Run) -> None:
    bus = ZenohBus(run.links, "controller", HostClock())
    bus.close()
    for use in (
        lambda: bus.publisher(COMMAND, "dm"),
        lambda: bus.subscribe(FRAME, Mailbox().put),  # the controller receives frames over a direct link too
        lambda: bus.subscribe(HEALTH, Mailbox().put),
        lambda: bus.ring(HEALTH, 1),
        lambda: bus.queryable(REQUEST_KEY.format(name="*"), Mailbox().put),
        lambda: bus.get(FRAME.key),
    ):
        with pytest.raises(BusError, match=r"^lowfc/\S+ cannot be used: session closed"):
            use()


def test_a_handlers_error_is_counted_even_if_standard_error_cannot_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Mock(write=Mock(side_effect=OSError("disk full"))))
    faults = Faults()
    faults.add("camera: handler of", "lowfc/frame", RuntimeError("broken"))
    assert faults.counts == {"camera: handler of lowfc/frame": 1}
