"""The direct link in parallel with the bus: each message once and in order, despite restarts and stalls."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from lowfc.adapters.bus import direct_link
from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import Run, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus, ZenohPublisher
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.configuration import Network
from lowfc.contract.envelope import Envelope, count_of, sequence_of
from lowfc.contract.messages import COMMAND, FRAME
from tests.support.loops import until

PATIENCE_S = 30.0


class LinkedRun:
    """A run with its buses; `receive` keeps the sequence count, the size and the receiving thread of each message."""

    def __init__(self, base: Path) -> None:
        self.run: Run = open_run("direct-link", base=base)
        self.clock = HostClock(base)
        self.buses: list[ZenohBus] = []
        self.received: list[int] = []
        self.threads: list[str] = []
        self.sizes: list[int] = []

    def bus(self, role: str) -> ZenohBus:
        self.buses.append(ZenohBus(self.run.links, role, self.clock))
        return self.buses[-1]

    def receive(self, sample: Sample) -> None:
        assert sample.key == FRAME.key
        assert sample.publish_time_ns <= sample.receive_time_ns
        self.received.append(count_of(sample.sequence))
        self.threads.append(threading.current_thread().name)
        self.sizes.append(len(sample.payload))

    def publish(self, publisher: ZenohPublisher, messages: int) -> None:
        for _ in range(messages):
            publisher.put(bytes(1000))
            time.sleep(0.001)

    def until_direct_only(self, publisher: ZenohPublisher) -> None:
        """Publish until messages arrive over the direct link only."""
        until(
            lambda: self.threads[-5:] == ["direct-link"] * 5 and len(self.threads) > 20, each=lambda: publisher.put(b"")
        )
        del self.received[:-1], self.threads[:], self.sizes[:]

    def close(self) -> None:
        for bus in self.buses:
            bus.close()


@pytest.fixture
def linked(tmp_path: Path) -> Iterator[LinkedRun]:
    linked_run = LinkedRun(tmp_path)
    yield linked_run
    linked_run.close()


def test_the_direct_subscriber_receives_over_the_direct_link_and_others_over_the_bus(linked: LinkedRun) -> None:
    controller, recorder, camera = linked.bus("controller"), linked.bus("recorder"), linked.bus("camera")
    controller.subscribe(FRAME, linked.receive)
    recorded: list[int] = []
    recorder.subscribe(FRAME, lambda sample: recorded.append(count_of(sample.sequence)))
    frames = camera.publisher(FRAME)
    linked.until_direct_only(frames)
    linked.publish(frames, 100)
    until(lambda: recorded[-1:] == [frames.published - 1] == linked.received[-1:])
    assert linked.received == list(range(linked.received[0], frames.published))
    assert set(linked.threads) == {"direct-link"}
    assert recorded[-100:] == linked.received[-100:]


def test_a_reader_in_the_publishers_process_receives_each_message_by_a_call(linked: LinkedRun) -> None:
    controller, recorder = linked.bus("controller"), linked.bus("recorder")
    controller.subscribe(FRAME, linked.receive)
    recorded: list[int] = []
    recorder.subscribe(FRAME, lambda sample: recorded.append(count_of(sample.sequence)))
    camera = ZenohBus(linked.run.links, "camera", linked.clock, beside=controller)
    frames = camera.publisher(FRAME)
    until(lambda: camera.peers() == 2)
    linked.publish(frames, 100)
    until(lambda: recorded[-1:] == [99])
    camera.close()
    assert linked.received == list(range(100)), "each message should arrive once, although the bus carried it too"
    assert set(linked.threads) == {threading.current_thread().name}
    del linked.threads[:]
    separate = linked.bus("camera").publisher(FRAME)  # as in a separate process
    linked.until_direct_only(separate)


def test_switching_to_the_direct_link_loses_and_repeats_nothing(linked: LinkedRun) -> None:
    camera = linked.bus("camera")
    frames = camera.publisher(FRAME)
    controller = linked.bus("controller")
    controller.subscribe(FRAME, linked.receive)
    until(lambda: controller.peers() and camera.peers())
    linked.publish(frames, 250)
    until(lambda: linked.received[-1:] == [frames.published - 1])
    first = min(linked.received)  # over the socket, it may arrive after later messages that the bus delivered
    assert sorted(linked.received) == list(range(first, frames.published))
    assert [number for number in linked.received if number != first] == list(range(first + 1, frames.published))
    assert "direct-link" in linked.threads


class ReaderOnTwoPaths:
    """A reader to which the test passes messages by socket and by bus.

    Attributes:
        delivered: sequences of the messages that the reader delivered.
        unsubscribed: number of times that the reader unsubscribed from the bus.
    """

    def __init__(self, path: Path, *, shared: bool = False) -> None:
        self.delivered: list[int] = []
        self.unsubscribed = 0
        self.direct = direct_link.DirectReader(
            path,
            FRAME.key,
            lambda sample: self.delivered.append(sample.sequence),
            self._subscribe,
            time.time_ns,
            pytest.fail,
            shared=shared,
        )

    def _subscribe(self, _: Callable[[Sample], None]) -> Callable[[], None]:
        def leave() -> None:
            self.unsubscribed += 1

        return leave

    def by_socket(self, sequence: int, time_ns: int) -> None:
        self.direct.take(Envelope(sequence, time_ns).encode(), b"", 1)

    def by_bus(self, sequence: int, time_ns: int) -> None:
        self.direct._by_bus(Sample(FRAME.key, b"", sequence, time_ns, 1))


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[ReaderOnTwoPaths]:
    on_two_paths = ReaderOnTwoPaths(tmp_path / "socket")
    yield on_two_paths
    on_two_paths.direct.close()


def test_a_message_in_transit_during_the_switch_is_delivered_once(reader: ReaderOnTwoPaths) -> None:
    reader.by_socket(1, 1)
    reader.by_bus(1, 1)
    reader.direct._leave_bus()
    assert reader.unsubscribed == 1
    reader.by_bus(2, 2)
    reader.by_socket(2, 2)
    assert reader.delivered == [1, 2]


def test_a_reader_is_closed_although_a_handler_never_returns(reader: ReaderOnTwoPaths) -> None:
    reader.direct._lock.acquire()  # as held while a handler runs
    closing = threading.Thread(target=reader.direct.close, daemon=True)
    closing.start()
    closing.join(PATIENCE_S)
    assert not closing.is_alive()


@pytest.mark.parametrize("direct_only", [False, True])
def test_messages_that_a_publisher_repeats_or_reorders_are_delivered_as_they_were_published(
    reader: ReaderOnTwoPaths, direct_only: bool
) -> None:
    """The controller must see the fault of a camera that repeats or reorders frames."""
    reader.by_socket(10, 1)
    if direct_only:
        reader.by_bus(10, 1)
        reader.direct._leave_bus()
    for time_ns, sequence in enumerate((12, 11, 11, 3), start=2):
        reader.by_socket(sequence, time_ns)
        if not direct_only:
            reader.by_bus(sequence, time_ns)
    # The same envelope twice: with the socket alone both are delivered; with the bus, the second counts as a copy.
    copies = 2 if direct_only else 1
    for _ in range(copies):
        reader.by_socket(13, 9)
    assert reader.delivered == [10, 12, 11, 11, 3, *[13] * copies]


def test_reader_and_writer_reconnect_after_restarts_and_without_a_writer_the_bus_delivers(
    linked: LinkedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller, camera = linked.bus("controller"), linked.bus("camera")
    controller.subscribe(FRAME, linked.receive)
    frames = camera.publisher(FRAME)
    linked.until_direct_only(frames)
    controller.close()
    linked.publish(frames, 5)
    controller = linked.bus("controller")
    controller.subscribe(FRAME, linked.receive)
    linked.until_direct_only(frames)
    camera.close()
    camera = linked.bus("camera")
    linked.until_direct_only(camera.publisher(FRAME))
    camera.close()
    # A publisher of another library does not send over the direct link.
    monkeypatch.setattr(direct_link.DirectWriter, "send", lambda *_: None)
    frames = linked.bus("camera").publisher(FRAME)
    until(lambda: linked.threads[-1:] not in ([], ["direct-link"]), each=lambda: frames.put(b""))


def test_a_message_too_large_for_the_socket_arrives_over_the_bus(linked: LinkedRun) -> None:
    controller, camera = linked.bus("controller"), linked.bus("camera")
    controller.subscribe(FRAME, linked.receive)
    frames = camera.publisher(FRAME)
    large = 17 << 20
    until(lambda: linked.sizes[-1:] == [large], each=lambda: (frames.put(bytes(large)), time.sleep(0.05)))
    assert linked.threads[-1] != "direct-link"


def test_a_stalled_reader_never_blocks_the_writer(tmp_path: Path) -> None:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(tmp_path / "stalled.in"))
    listener.listen(1)
    writer = direct_link.DirectWriter(tmp_path / "stalled.in")
    for _ in range(2000):  # far more than a socket can buffer: a blocking send would never return
        writer.send(Envelope(1, 2).encode(), bytes(12800))
    accepted, _ = listener.accept()
    accepted.settimeout(PATIENCE_S)
    assert Envelope.decode(accepted.recv(20000)[:16]) == Envelope(1, 2)
    accepted.close()
    writer.send(b"", b"")
    writer.close()
    listener.close()


def test_invalid_messages_are_counted_and_the_next_message_is_delivered(
    linked: LinkedRun, capfd: pytest.CaptureFixture[str]
) -> None:
    controller = linked.bus("controller")
    controller.subscribe(FRAME, linked.receive)
    writer = direct_link.DirectWriter(linked.run.links.direct_link("controller"))
    writer.send(b"short", b"")
    writer.send(b"\xff" * 16, b"from the end of time")
    writer.send(Envelope(7, 0).encode(), b"fine")
    until(lambda: linked.received == [7])
    ((key, (count, _)),) = controller.faults.take_unreadable().items()
    assert (key, count) == (FRAME.key, 2)
    assert "Traceback" not in capfd.readouterr().err
    writer.close()


def test_only_direct_subscribers_have_a_direct_link(linked: LinkedRun) -> None:
    linked.bus("recorder").subscribe(FRAME, linked.receive)
    linked.bus("mirror-other").subscribe(COMMAND, lambda _: None, "dm")
    assert not list(linked.run.path.glob("*.in"))
    linked.bus("controller").subscribe(FRAME, linked.receive)
    linked.bus("mirror-dm").subscribe(COMMAND, lambda _: None, "dm")
    assert sorted(path.name for path in linked.run.path.glob("*.in")) == ["controller.in", "mirror-dm.in"]


class CommandedMirror:
    """A mirror that keeps the commands it receives; a controller and an operator both publish commands."""

    def __init__(self, linked: LinkedRun) -> None:
        self.received: list[Sample] = []
        self.threads: list[str] = []
        linked.bus("mirror-dm").subscribe(COMMAND, self.receive, "dm")
        controller, operator = linked.bus("controller"), linked.bus("operator")
        self.controller, self.operator = controller.publisher(COMMAND, "dm"), operator.publisher(COMMAND, "dm")

    def receive(self, sample: Sample) -> None:
        self.received.append(sample)
        self.threads.append(threading.current_thread().name)

    def until_both_paths_deliver(self) -> None:
        def both() -> bool:
            return "direct-link" in self.threads and any(sample.payload == b"operator" for sample in self.received)

        until(both, each=self.put)

    def put(self) -> None:
        self.controller.put(b"controller")
        self.operator.put(b"operator")


def test_a_mirror_receives_each_command_once_and_those_of_the_controller_over_the_direct_link(
    linked: LinkedRun,
) -> None:
    mirror = CommandedMirror(linked)
    mirror.until_both_paths_deliver()
    received_before = len(mirror.received)
    for _ in range(100):
        mirror.put()
        time.sleep(0.001)
    last = mirror.controller.published - 1, mirror.operator.published - 1
    newest = set(zip((b"controller", b"operator"), last, strict=True))
    until(
        lambda: newest <= {(sample.payload, count_of(sample.sequence)) for sample in mirror.received[received_before:]}
    )
    time.sleep(0.1)  # a copy over the bus would have arrived by then
    samples_and_threads = list(zip(mirror.received, mirror.threads, strict=True))[received_before:]
    for payload, last_count in zip((b"controller", b"operator"), last, strict=True):
        counts = [count_of(sample.sequence) for sample, _ in samples_and_threads if sample.payload == payload]
        assert counts[-100:] == list(range(last_count - 99, last_count + 1))
        assert len(counts) == len(set(counts))
    direct = [name == "direct-link" for sample, name in samples_and_threads if sample.payload == b"controller"]
    assert any(direct)  # not all: for some commands the bus may be faster
    assert all(name != "direct-link" for sample, name in samples_and_threads if sample.payload == b"operator")
    copied = next(sample for sample in reversed(mirror.received) if sample.payload == b"controller")
    mirror.operator.put(b"a copy", publish_time_ns=copied.publish_time_ns, sequence=copied.sequence)
    mirror.operator.put(b"another", sequence=copied.sequence)
    until(lambda: mirror.received[-1].payload == b"another")
    assert all(sample.payload != b"a copy" for sample in mirror.received)


def test_handed_ns_is_before_the_bus_put_if_there_is_a_direct_reader_and_after_it_if_not(linked: LinkedRun) -> None:
    mirror = CommandedMirror(linked)
    mirror.until_both_paths_deliver()
    put_ns: list[int] = []
    timed = SimpleNamespace(put=lambda payload, attachment: put_ns.append(linked.clock.host_ns()))
    for publisher, has_reader in ((mirror.controller, True), (mirror.operator, False)):
        publisher._publisher = timed
        envelope = publisher.put(b"")
        assert envelope.publish_time_ns <= publisher.handed_ns
        assert (publisher.handed_ns <= put_ns[-1]) is has_reader


def test_no_message_is_delivered_twice_after_a_stall_in_which_the_bus_was_ahead(tmp_path: Path) -> None:
    """A socket buffers at most a few thousand commands, fewer than the envelopes that the reader keeps."""
    reader, commands = ReaderOnTwoPaths(tmp_path / "mirror-dm.in", shared=True), 5000
    for count in range(commands):
        reader.by_bus(sequence_of(5, count), count)
    for count in range(commands + 1):
        reader.by_socket(sequence_of(5, count), count)
    reader.direct.close()
    assert reader.delivered == [sequence_of(5, count) for count in range(commands + 1)]


def test_with_a_router_there_is_no_direct_link(linked: LinkedRun) -> None:
    assert linked.run.links.direct_link("mirror-dm") is not None
    with_router = replace(linked.run.links, network=Network(router="tls/localhost:7447", certificates="certs"))
    assert with_router.direct_link("mirror-dm") is None
    assert with_router.direct_link("controller") is None
