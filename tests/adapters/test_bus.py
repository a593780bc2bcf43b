"""The bus: what the bus in memory and zenoh's have in common, then links, secrets, freezes and ends of sessions."""

import itertools
import json
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from lowfc.adapters.bus.bus import Bus, Query, Sample
from lowfc.adapters.bus.mailbox import Mailbox
from lowfc.adapters.bus.run import Run, new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.envelope import Envelope, count_of, start_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import CALIBRATION, COMMAND, FRAME, HEALTH, REQUEST_KEY, TRUTH, Topic
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.loops import until

PATIENCE_S = 30.0
Join = Callable[..., ZenohBus]


@pytest.fixture(autouse=True)
def _runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="bus-") as path:  # short enough for the sockets in it
        monkeypatch.setenv("XDG_RUNTIME_DIR", path)
        monkeypatch.setenv("ZENOH_RUNTIME", "")  # what a bus puts there is gone after the test
        monkeypatch.delenv("ZENOH_RUNTIME")
        yield


@pytest.fixture
def run() -> Run:
    return open_run(new_run_id())


@pytest.fixture
def join() -> Iterator[Join]:
    buses: list[ZenohBus] = []

    def begin(run: Run, role: str, **how: bool) -> ZenohBus:
        buses.append(ZenohBus(run.links, role, HostClock(), **how))
        return buses[-1]

    yield begin
    for bus in buses:
        bus.close()


@pytest.fixture(params=["memory", "zenoh"])
def pair(request: pytest.FixtureRequest, run: Run, join: Join) -> tuple[Bus, Bus]:
    """Buses of a controller and an operator, linked."""
    if request.param == "memory":
        hub, clock = MemoryHub(), FakeClock()
        return MemoryBus(hub, "controller", clock), MemoryBus(hub, "operator", clock)
    buses = join(run, "controller"), join(run, "operator")
    until(lambda: all(bus.peers() for bus in buses))
    return buses


def test_a_put_reaches_every_subscriber_of_its_key(pair: tuple[Bus, Bus]) -> None:
    controller, operator = pair
    everybody, dm, tip, frames = ([] for _ in range(4))
    for heard, topic, *name in ((everybody, COMMAND), (dm, COMMAND, "dm"), (tip, COMMAND, "tip"), (frames, FRAME)):
        controller.subscribe(topic, heard.append, *name)
    publisher = operator.publisher(COMMAND, "dm")

    def put() -> bool:
        publisher.put(b"body", publish_time_ns=3)
        return bool(everybody and dm)

    until(put)
    assert (everybody[0].key, everybody[0].payload, everybody[0].publish_time_ns) == (COMMAND.at("dm"), b"body", 3)
    assert not tip
    assert not frames


def test_a_late_joiner_gets_the_last_message_with_its_envelope(pair: tuple[Bus, Bus]) -> None:
    controller, late = pair
    calibrations, frames = controller.publisher(CALIBRATION), controller.publisher(FRAME)
    assert late.get(CALIBRATION.key, timeout_s=0.1) == []
    calibrations.put(b"old")
    body = bytes(range(256)) * 12_000  # 3 MB, as a large calibration
    envelope = calibrations.put(body)
    frames.put(b"frame")
    until(lambda: bool(late.get(CALIBRATION.key)))
    (answer,) = late.get(CALIBRATION.key, timeout_s=PATIENCE_S)
    assert (answer.key, answer.payload) == (CALIBRATION.key, body)
    assert (answer.sequence, answer.publish_time_ns) == (envelope.sequence, envelope.publish_time_ns)
    assert calibrations.last == (body, envelope)
    assert late.get(FRAME.key, timeout_s=0.1) == []
    late.publisher(HEALTH, "operator").put(b"operator")
    controller.publisher(HEALTH, "controller").put(b"controller")
    until(lambda: {one.payload for one in late.get(HEALTH.at("*"))} == {b"controller", b"operator"})


def test_a_question_is_answered_later_from_another_thread(pair: tuple[Bus, Bus]) -> None:
    controller, operator = pair
    waiting: list[Query] = []
    controller.queryable(REQUEST_KEY.format(name="*"), waiting.append)
    answers: list[Sample] = []

    def ask() -> None:
        while not answers:  # until the link is up, nobody is asked
            answers.extend(operator.get("lowfc/request/gain", b"0.5", timeout_s=PATIENCE_S))

    asker = threading.Thread(target=ask)
    asker.start()
    until(lambda: bool(waiting))
    assert (waiting[0].name, waiting[0].payload) == ("gain", b"0.5")
    waiting[0].reply(b"done")
    asker.join(PATIENCE_S)
    assert [(answer.key, answer.payload) for answer in answers] == [("lowfc/request/gain", b"done")]


def test_a_broken_handler_harms_nobody_else_and_is_shown_once(
    pair: tuple[Bus, Bus], capfd: pytest.CaptureFixture[str]
) -> None:
    controller, operator = pair
    box = Mailbox()

    def fail(_: object) -> None:
        raise RuntimeError("handler broke")

    controller.subscribe(COMMAND, fail)
    controller.subscribe(COMMAND, box.put)
    controller.queryable("lowfc/request/*", fail)
    publisher = operator.publisher(COMMAND, "dm")

    def put() -> bool:
        publisher.put(b"")
        return box.received >= 3

    until(put)  # so the question finds its way too
    assert operator.get("lowfc/request/open", timeout_s=0.5) == []
    assert controller.faults.counts["controller: handler of lowfc/mirror/*/command"] >= 3
    assert controller.faults.counts["controller: queryable of lowfc/request/open"] == 1
    assert capfd.readouterr().err.count("RuntimeError: handler broke") == 2


def test_sequences_count_from_zero_and_never_repeat(run: Run, join: Join) -> None:
    starts = []
    for _ in range(3):  # restarted within one second
        bus = join(run, "camera")
        publisher = bus.publisher(FRAME)
        sequences = [publisher.put(b"").sequence for _ in range(3)]
        assert [count_of(sequence) for sequence in sequences] == [0, 1, 2]
        starts += [start_of(sequences[0])]
        bus.close()
    assert starts == sorted(set(starts))


def test_sequences_of_the_bus_in_memory_never_repeat_either() -> None:
    hub, clock = MemoryHub(), FakeClock()
    camera = MemoryBus(hub, "camera", clock)
    first = camera.publisher(FRAME).put(b"").sequence
    camera.close()
    assert start_of(MemoryBus(hub, "camera", clock).publisher(FRAME).put(b"").sequence) == start_of(first) + 1
    with pytest.raises(BusError, match="closed"):
        camera.publisher(FRAME).put(b"")


def test_without_the_password_nobody_is_let_in(run: Run, join: Join, tmp_path: Path) -> None:
    camera = join(run, "camera")
    configs = [session_config(run.links, "operator")]
    del configs[0]["transport"]["auth"]
    for user in ("lowfc", "intruder"):
        (tmp_path / "credentials").write_text(f"{user}:wrong\n")
        configs.append(session_config(replace(run.links, user=user, secret_file=tmp_path / "credentials"), "operator"))
    overheard: list[zenoh.Sample] = []
    heard, forgeries, frames = Mailbox(), Mailbox(), camera.publisher(FRAME)
    camera.subscribe(COMMAND, forgeries.put)
    with ExitStack() as stack:
        sessions = [zenoh.open(zenoh.Config.from_json5(json.dumps(config))) for config in configs]
        intruders = [stack.enter_context(session) for session in sessions]
        for intruder in intruders:
            intruder.declare_subscriber(FRAME.key, overheard.append)
        join(run, "viewer").subscribe(FRAME, heard.put)  # after the intruders, with the right password

        def talk() -> bool:
            frames.put(b"frame")
            for intruder in intruders:
                intruder.put(COMMAND.at("dm"), b"command", attachment=Envelope(1, 1).encode())
            return heard.received > 20

        until(talk)
    assert (overheard, forgeries.received) == ([], 0)


def test_messages_without_a_readable_envelope_are_counted_and_no_traceback(
    run: Run, join: Join, capfd: pytest.CaptureFixture[str]
) -> None:
    controller = join(run, "controller")
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


def test_a_ring_that_is_closed_has_no_subscriber(run: Run, join: Join) -> None:
    operator, camera = join(run, "operator"), join(run, "camera")
    frames = camera.publisher(FRAME)
    ring = operator.ring(FRAME, 4)
    until(lambda: frames._publisher.matching_status.matching)
    ring.close()
    until(lambda: not frames._publisher.matching_status.matching)
    ring.close()


def test_a_role_can_be_taken_once(run: Run, join: Join) -> None:
    join(run, "camera")
    with pytest.raises(BusError, match=rf"camera of run '{run.run_id}' .* 127.0.0.1:{run.links.ports['camera']}"):
        join(run, "camera")
    join(run, "operator")
    join(run, "operator")  # who does not listen may be there twice


def test_everybody_listens_on_its_own_port_and_socket_and_connects_to_all_others(run: Run) -> None:
    endpoints = {role: f"tcp/127.0.0.1:{port}" for role, port in run.links.ports.items()}
    sockets = {role: f"unixsock-stream/{run.path}/{role}.sock" for role in endpoints}
    for role, own in endpoints.items():
        config = session_config(run.links, role)
        assert config["listen"]["endpoints"] == [own, sockets[role]]
        assert set(config["connect"]["endpoints"]) == set(endpoints.values()) - {own}
        assert not config["scouting"]["multicast"]["enabled"]
        assert not config["scouting"]["gossip"]["enabled"]
        assert not config["transport"]["shared_memory"]["enabled"]
    for role, monitor, wanted in (("operator", False, endpoints), ("viewer", True, sockets)):
        config = session_config(run.links, role, monitor=monitor)
        assert config["listen"]["endpoints"] == []
        assert set(config["connect"]["endpoints"]) == set(wanted.values())


def test_where_a_socket_has_too_long_a_name_a_port_serves_monitors(tmp_path: Path) -> None:
    base = tmp_path / ("long" * 25)
    base.mkdir(mode=0o700)
    links = open_run(new_run_id(), base=base).links
    endpoints = {f"tcp/127.0.0.1:{port}" for port in links.ports.values()}
    assert len(session_config(links, "camera")["listen"]["endpoints"]) == 1
    assert set(session_config(links, "viewer", monitor=True)["connect"]["endpoints"]) == endpoints


@pytest.mark.exclusive
def test_a_monitor_gets_every_row_and_no_more_pictures_than_it_draws(run: Run, join: Join) -> None:
    camera, viewer, recorder = join(run, "camera"), join(run, "viewer", monitor=True), join(run, "recorder")
    frames, truths = camera.publisher(FRAME), camera.publisher(TRUTH)
    kept, rows, recorded = viewer.ring(FRAME, 5000), viewer.ring(TRUTH, 5000), Mailbox()
    recorder.subscribe(FRAME, recorded.put)
    seen: dict[Topic, list[Sample]] = {FRAME: [], TRUTH: []}

    def look() -> None:
        seen[FRAME] += kept.drain()
        seen[TRUTH] += rows.drain()

    def met() -> bool:
        frames.put(b"picture")
        truths.put(b"row")
        look()
        return bool(seen[FRAME] and seen[TRUTH] and recorded.received)

    until(met)
    first = {topic: len(samples) for topic, samples in seen.items()}
    heard = recorded.received
    for _ in range(250):
        frames.put(b"picture")
        last = truths.put(b"row")
        time.sleep(0.002)

    def got_the_last() -> bool:
        look()
        return seen[TRUTH][-1].sequence == last.sequence and recorded.received >= heard + 250

    until(got_the_last)
    assert len(seen[TRUTH]) - first[TRUTH] >= 250
    assert 5 < len(seen[FRAME]) - first[FRAME] < 125


# A recorder that receives on request: number of messages, how many of them are whole, and which was the last.
READER = """
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
    whole = [payload for payload in received if payload == payload[:8] * 1600]
    print(len(received), len(whole), int(whole[-1][:8]) if whole else -1, flush=True)
"""


class Reader:
    """A recorder in a process of its own, which the camera's frames have reached."""

    def __init__(self, run: Run, camera: ZenohBus) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", READER, run.run_id], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.camera = camera
        self.frames = camera.publisher(FRAME)
        self.number = itertools.count()

    def put(self) -> int:
        number = next(self.number)
        self.frames.put(b"%08d" % number * 1600)
        return number

    def look(self) -> list[int]:
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return [int(word) for word in self.process.stdout.readline().split()]

    def reached(self) -> bool:
        self.put()
        return self.look()[0] > 0


@pytest.fixture
def reader(run: Run, join: Join) -> Iterator[Reader]:
    made = Reader(run, join(run, "camera"))
    until(made.reached)
    yield made
    made.process.kill()
    made.process.communicate()


def test_a_frozen_subscriber_costs_the_others_nothing(reader: Reader, run: Run, join: Join) -> None:
    box = Mailbox()
    join(run, "controller").subscribe(FRAME, box.put)

    def received() -> bool:
        reader.put()
        return bool(box.take(0.01))

    until(received)
    reader.process.send_signal(signal.SIGSTOP)
    for _ in range(1500):  # 19 MB, more than the link can hold; a put that waits would close it
        reader.put()
        assert box.take(PATIENCE_S)
    reader.process.send_signal(signal.SIGCONT)
    last = reader.put()

    def caught_up() -> bool:
        reader.put()
        return reader.look()[2] > last

    until(caught_up)
    received_number, whole, _ = reader.look()
    assert received_number == whole < reader.frames.published


def test_a_session_that_ends_leaves_no_half_message_with_a_slow_reader(reader: Reader) -> None:
    reader.process.send_signal(signal.SIGSTOP)
    for _ in range(1000):  # more than the socket takes
        reader.put()
    threading.Timer(0.2, reader.process.send_signal, [signal.SIGCONT]).start()
    reader.camera.close()
    received, whole, _ = reader.look()
    assert received == whole
    assert whole > 15  # what the queue and the socket held
