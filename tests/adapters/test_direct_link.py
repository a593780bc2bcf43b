"""The direct link beside the real bus: every message once and in order, whoever comes, goes, stalls or is too large."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

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


class Ends:
    """A run with a camera and a controller that notes what it gets, from which thread."""

    def __init__(self, base: Path) -> None:
        self.run: Run = open_run("direct-link", base=base)
        self.clock = HostClock(base)
        self.buses: list[ZenohBus] = []
        self.got: list[int] = []
        self.threads: list[str] = []
        self.sizes: list[int] = []

    def bus(self, role: str) -> ZenohBus:
        self.buses.append(ZenohBus(self.run.links, role, self.clock))
        return self.buses[-1]

    def hear(self, sample: Sample) -> None:
        assert sample.key == FRAME.key
        assert sample.publish_time_ns <= sample.receive_time_ns
        self.got.append(count_of(sample.sequence))
        self.threads.append(threading.current_thread().name)
        self.sizes.append(len(sample.payload))

    def publish(self, publisher: ZenohPublisher, messages: int, pause_s: float = 0.001) -> None:
        for _ in range(messages):
            publisher.put(bytes(1000))
            time.sleep(pause_s)

    def meet(self, publisher: ZenohPublisher) -> None:
        """Publish until the direct link is the only one."""

        def only() -> bool:
            publisher.put(b"")
            return self.threads[-5:] == ["direct-link"] * 5 and len(self.threads) > 20

        until(only)
        del self.got[:-1], self.threads[:], self.sizes[:]

    def close(self) -> None:
        for bus in self.buses:
            bus.close()


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[Ends]:
    made = Ends(tmp_path)
    yield made
    made.close()


def test_the_reader_gets_everything_by_the_short_way_and_others_by_the_bus(ends: Ends) -> None:
    controller, recorder, camera = ends.bus("controller"), ends.bus("recorder"), ends.bus("camera")
    controller.subscribe(FRAME, ends.hear)
    recorded: list[int] = []
    recorder.subscribe(FRAME, lambda sample: recorded.append(count_of(sample.sequence)))
    frames = camera.publisher(FRAME)
    ends.meet(frames)
    ends.publish(frames, 100)
    until(lambda: recorded[-1:] == [frames.published - 1] == ends.got[-1:])
    assert ends.got == list(range(ends.got[0], frames.published))
    assert set(ends.threads) == {"direct-link"}
    assert recorded[-100:] == ends.got[-100:]


def test_a_reader_of_the_same_process_gets_each_message_by_a_call(ends: Ends) -> None:
    controller, recorder = ends.bus("controller"), ends.bus("recorder")
    controller.subscribe(FRAME, ends.hear)
    recorded: list[int] = []
    recorder.subscribe(FRAME, lambda sample: recorded.append(count_of(sample.sequence)))
    camera = ZenohBus(ends.run.links, "camera", ends.clock, beside=controller)
    frames = camera.publisher(FRAME)
    until(lambda: camera.peers() == 2)
    ends.publish(frames, 100)
    until(lambda: recorded[-1:] == [99])
    camera.close()
    assert ends.got == list(range(100)), "none twice, though the bus had them too"
    assert set(ends.threads) == {threading.current_thread().name}
    del ends.threads[:]
    again = ends.bus("camera").publisher(FRAME)  # in a process of its own
    ends.meet(again)


def test_the_switch_loses_and_repeats_nothing(ends: Ends) -> None:
    camera = ends.bus("camera")
    frames = camera.publisher(FRAME)
    controller = ends.bus("controller")
    controller.subscribe(FRAME, ends.hear)
    until(lambda: controller.peers() and camera.peers())
    ends.publish(frames, 250)
    until(lambda: ends.got[-1:] == [frames.published - 1])
    assert ends.got == sorted(set(ends.got))
    assert ends.got == list(range(ends.got[0], frames.published))
    assert "direct-link" in ends.threads


def test_a_message_under_way_while_the_bus_is_left_comes_once(tmp_path: Path) -> None:
    got: list[int] = []
    left: list[bool] = []
    reader = direct_link.DirectReader(
        tmp_path / "socket",
        FRAME.key,
        lambda sample: got.append(sample.sequence),
        lambda handler: lambda: left.append(True),
        time.time_ns,
        pytest.fail,
    )
    one, other = (Sample(FRAME.key, b"", sequence, 1, 1) for sequence in (1, 2))
    reader._by_socket(one)
    reader._by_bus(one)
    reader._leave()
    assert left == [True]
    reader._by_bus(other)
    reader._by_socket(other)
    reader.close()
    assert got == [1, 2]


def test_a_restarted_reader_and_writer_find_each_other_again_and_without_its_writer_it_hears_the_bus(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller, camera = ends.bus("controller"), ends.bus("camera")
    controller.subscribe(FRAME, ends.hear)
    frames = camera.publisher(FRAME)
    ends.meet(frames)
    controller.close()
    ends.publish(frames, 5)
    controller = ends.bus("controller")
    controller.subscribe(FRAME, ends.hear)
    ends.meet(frames)
    camera.close()
    camera = ends.bus("camera")
    ends.meet(camera.publisher(FRAME))
    camera.close()
    monkeypatch.setattr(direct_link.DirectWriter, "send", lambda *_: None)  # as one in another language
    frames = ends.bus("camera").publisher(FRAME)

    def heard() -> bool:
        frames.put(b"")
        return ends.threads[-1:] not in ([], ["direct-link"])

    until(heard)


def test_a_message_that_a_socket_does_not_take_comes_by_the_bus(ends: Ends) -> None:
    controller, camera = ends.bus("controller"), ends.bus("camera")
    controller.subscribe(FRAME, ends.hear)
    frames = camera.publisher(FRAME)
    large = 17 << 20

    def heard() -> bool:
        frames.put(bytes(large))
        time.sleep(0.05)
        return ends.sizes[-1:] == [large]

    until(heard)
    assert ends.threads[-1] != "direct-link"


def test_a_reader_that_stalls_never_holds_the_writer(tmp_path: Path) -> None:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(tmp_path / "stalled.in"))
    listener.listen(1)
    writer = direct_link.DirectWriter(tmp_path / "stalled.in")
    for _ in range(2000):  # far more than a socket holds: a send that waited would wait for ever
        writer.send(Envelope(1, 2).encode(), bytes(12800))
    taken, _ = listener.accept()
    taken.settimeout(PATIENCE_S)
    assert Envelope.decode(taken.recv(20000)[:16]) == Envelope(1, 2)
    taken.close()
    writer.send(b"", b"")
    writer.close()
    listener.close()


def test_a_message_that_makes_no_sense_is_counted_and_the_next_is_heard(
    ends: Ends, capfd: pytest.CaptureFixture[str]
) -> None:
    controller = ends.bus("controller")
    controller.subscribe(FRAME, ends.hear)
    path = ends.run.links.direct_link("controller")
    assert path is not None
    writer = direct_link.DirectWriter(path)
    writer.send(b"short", b"")
    writer.send(b"\xff" * 16, b"from the end of time")
    writer.send(Envelope(7, 0).encode(), b"fine")
    until(lambda: ends.got == [7])
    (found,) = controller.faults.take_unreadable().items()
    assert (found[0], found[1][0]) == (FRAME.key, 2)
    assert "Traceback" not in capfd.readouterr().err
    writer.close()


def test_only_who_waits_for_a_topic_has_a_short_way(ends: Ends) -> None:
    ends.bus("recorder").subscribe(FRAME, ends.hear)
    ends.bus("mirror-other").subscribe(COMMAND, lambda _: None, "dm")
    assert not list(ends.run.path.glob("*.in"))
    ends.bus("controller").subscribe(FRAME, ends.hear)
    ends.bus("mirror-dm").subscribe(COMMAND, lambda _: None, "dm")
    assert sorted(path.name for path in ends.run.path.glob("*.in")) == ["controller.in", "mirror-dm.in"]


class Commanded:
    """A mirror that notes its commands, beside the controller and an operator who both command it."""

    def __init__(self, ends: Ends) -> None:
        self.ends = ends
        self.got: list[Sample] = []
        self.threads: list[str] = []
        ends.bus("mirror-dm").subscribe(COMMAND, self.hear, "dm")
        controller, operator = ends.bus("controller"), ends.bus("operator")
        self.controller, self.operator = controller.publisher(COMMAND, "dm"), operator.publisher(COMMAND, "dm")
        self.links = controller, operator

    def hear(self, sample: Sample) -> None:
        self.got.append(sample)
        self.threads.append(threading.current_thread().name)

    def until_both_ways(self) -> None:
        def both() -> bool:
            self.controller.put(b"controller")
            self.operator.put(b"operator")
            time.sleep(0.01)
            return "direct-link" in self.threads and any(one.payload == b"operator" for one in self.got)

        until(both)


def test_a_mirror_gets_each_command_once_and_the_controllers_by_the_short_way(ends: Ends) -> None:
    mirror = Commanded(ends)
    mirror.until_both_ways()
    begun = len(mirror.got)
    for _ in range(100):
        mirror.controller.put(b"controller")
        mirror.operator.put(b"operator")
        time.sleep(0.001)
    last = mirror.controller.published - 1, mirror.operator.published - 1

    def all_came() -> bool:
        return {(one.payload, count_of(one.sequence)) for one in mirror.got[-20:]} >= {
            (b"controller", last[0]),
            (b"operator", last[1]),
        }

    until(all_came)
    time.sleep(0.1)  # in which a copy by the bus would come
    by_whom = list(zip(mirror.got, mirror.threads, strict=True))[begun:]
    for payload, last_count in zip((b"controller", b"operator"), last, strict=True):
        counts = [count_of(one.sequence) for one, _ in by_whom if one.payload == payload]
        assert counts[-100:] == list(range(last_count - 99, last_count + 1))
        assert len(counts) == len(set(counts))
    ways = [name == "direct-link" for one, name in by_whom if one.payload == b"controller"]
    assert sum(ways) > 0.5 * len(ways)  # the bus can be quicker now and then
    assert all(name != "direct-link" for one, name in by_whom if one.payload == b"operator")
    newest = next(one for one in reversed(mirror.got) if one.payload == b"controller")
    mirror.operator.put(b"a copy", publish_time_ns=newest.publish_time_ns, sequence=newest.sequence)
    mirror.operator.put(b"another", sequence=newest.sequence)
    until(lambda: mirror.got[-1].payload == b"another")
    assert all(one.payload != b"a copy" for one in mirror.got)


def test_handed_is_before_the_bus_where_there_is_a_reader_and_after_it_where_there_is_none(ends: Ends) -> None:
    mirror = Commanded(ends)
    mirror.until_both_ways()
    put_ns: list[int] = []

    class Noting:
        def put(self, payload: bytes, attachment: bytes) -> None:
            put_ns.append(ends.clock.host_ns())

    for publisher, is_read in ((mirror.controller, True), (mirror.operator, False)):
        publisher._publisher = Noting()  # type: ignore[assignment]
        envelope = publisher.put(b"")
        assert envelope.publish_time_ns <= publisher.handed_ns
        assert (publisher.handed_ns <= put_ns[-1]) is is_read


def test_after_a_stall_in_which_the_bus_was_quicker_nothing_comes_twice(tmp_path: Path) -> None:
    """A few thousand commands are the most that wait in a socket."""
    got: list[int] = []
    by_bus: list[direct_link.Handler] = []

    def subscribe(handler: direct_link.Handler) -> Callable[[], None]:
        by_bus.append(handler)
        return by_bus.clear

    path, number = tmp_path / "mirror-dm.in", 5000
    reader = direct_link.DirectReader(
        path, "k", lambda sample: got.append(sample.publish_time_ns), subscribe, lambda: 0, pytest.fail, shared=True
    )
    for count in range(number):
        by_bus[0](Sample("k", b"", sequence_of(5, count), count, 0))
    for count in range(number + 1):
        reader.take(Envelope(sequence_of(5, count), count).encode(), b"")
    reader.close()
    assert got == list(range(number + 1))


def test_by_a_router_there_is_no_short_way_round_its_access_control(ends: Ends) -> None:
    assert ends.run.links.direct_link("mirror-dm") is not None
    across = replace(ends.run.links, network=Network(router="tls/localhost:7447", certificates="certs"))
    assert across.direct_link("mirror-dm") is None
    assert across.direct_link("controller") is None
