"""The bus between real processes: start orders, deaths, secrets, freezes."""

import itertools
import json
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from lowfc.adapters.bus.bus import Query, Sample
from lowfc.adapters.bus.mailbox import Mailbox
from lowfc.adapters.bus.run import Run, new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus, session_config
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import CALIBRATION, COMMAND, FRAME, HEALTH, REQUEST_KEY, TRUTH, Topic

pytestmark = pytest.mark.exclusive

ROLES = ("camera", "controller", "mirror-dm")
PATIENCE_S = 30.0

# A process of a run that does what its standard input says, one line at a time, and answers each with a line of JSON.
# It publishes its topic all the time and remembers, of every key, how many messages it got and the last one.
TOY = """
import json, sys, threading, time
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import COMMAND, FRAME, MIRROR_STATE

TOPICS = {"camera": (FRAME, ""), "controller": (COMMAND, "dm"), "mirror-dm": (MIRROR_STATE, "dm")}


def talk(publisher, body, stop):
    while not stop.wait(0.01):
        publisher.put(body)


for line in sys.stdin:
    word, *rest = line.split()
    if word == "open":
        run_id, role = rest
        heard = {}

        def hear(sample):
            count, _, _ = heard.get(sample.key, (0, 0, ""))
            heard[sample.key] = count + 1, sample.sequence >> 32, sample.payload.decode()

        bus = ZenohBus(open_run(run_id).links, role, HostClock())
        for topic, _ in TOPICS.values():
            bus.subscribe(topic, hear)
        stop = threading.Event()
        publisher = bus.publisher(*TOPICS[role])
        talker = threading.Thread(target=talk, args=(publisher, run_id.encode(), stop))
        talker.start()
    elif word == "close":
        stop.set()
        talker.join()
        bus.close()
    print(json.dumps(heard), flush=True)
"""
KEYS = {"camera": FRAME.key, "controller": COMMAND.at("dm"), "mirror-dm": "lowfc/mirror/dm/state"}


class Toy:
    """One such process."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", TOY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def do(self, command: str) -> dict[str, tuple[int, int, str]]:
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture(autouse=True)
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="bus-") as path:  # short enough for the sockets in it
        monkeypatch.setenv("XDG_RUNTIME_DIR", path)
        monkeypatch.setenv("ZENOH_RUNTIME", "")  # what a bus puts there is gone after the test
        monkeypatch.delenv("ZENOH_RUNTIME")
        yield


@pytest.fixture
def run() -> Run:
    return open_run(new_run_id())


@pytest.fixture
def start() -> Iterator[Callable[[], Toy]]:
    toys: list[Toy] = []

    def begin() -> Toy:
        toys.append(Toy())
        return toys[-1]

    yield begin
    for toy in toys:
        toy.kill()


@pytest.fixture
def join() -> Iterator[Callable[[Run, str], ZenohBus]]:
    buses: list[ZenohBus] = []

    def begin(run: Run, role: str, **how: bool) -> ZenohBus:
        buses.append(ZenohBus(run.links, role, HostClock(), **how))
        return buses[-1]

    yield begin
    for bus in buses:
        bus.close()


def all_hear_all(toys: dict[str, Toy]) -> bool:
    return all(set(toy.do("heard")) == set(KEYS.values()) for toy in toys.values())


def test_any_start_order_connects_everybody(start: Callable[[], Toy]) -> None:
    toys = {role: start() for role in ROLES}
    for order in itertools.permutations(ROLES):
        run = open_run(new_run_id())
        for role in order:
            toys[role].do(f"open {run.run_id} {role}")
        until(lambda: all_hear_all(toys))
        for role in order:
            toys[role].do("close")


@pytest.mark.parametrize("victim", ROLES)
def test_a_killed_process_comes_back(victim: str, run: Run, start: Callable[[], Toy]) -> None:
    toys = {role: start() for role in ROLES}
    for role, toy in toys.items():
        toy.do(f"open {run.run_id} {role}")
    until(lambda: all_hear_all(toys))
    witness = toys[next(role for role in ROLES if role != victim)]
    before = witness.do("heard")[KEYS[victim]]
    toys[victim].kill()
    toys[victim] = start()
    toys[victim].do(f"open {run.run_id} {victim}")
    until(lambda: all_hear_all(toys))
    until(lambda: witness.do("heard")[KEYS[victim]][1] > before[1])  # a larger start, be it within the same second


def test_two_runs_do_not_mix(start: Callable[[], Toy]) -> None:
    runs = [open_run(new_run_id()) for _ in range(2)]
    toys = {(run.run_id, role): start() for run in runs for role in ROLES[:2]}
    for (run_id, role), toy in toys.items():
        toy.do(f"open {run_id} {role}")
    wanted = {KEYS[role] for role in ROLES[:2]}
    until(lambda: all(set(toy.do("heard")) == wanted for toy in toys.values()))
    for (run_id, _), toy in toys.items():
        assert {body for _, _, body in toy.do("heard").values()} == {run_id}


@pytest.mark.parametrize("secret", ["lowfc:wrong\n", "intruder:wrong\n"])
def test_a_wrong_password_is_refused(
    secret: str, run: Run, join: Callable[[Run, str], ZenohBus], tmp_path: Path
) -> None:
    camera = join(run, "camera")
    forged = tmp_path / "forged"
    forged.mkdir()
    (forged / "credentials").write_text(secret)
    links = replace(run.links, user=secret.partition(":")[0], secret_file=forged / "credentials")
    intruder = join(replace(run, links=links), "recorder")
    overheard, forgeries = Mailbox(), Mailbox()
    intruder.subscribe(FRAME, overheard.put)
    camera.subscribe(COMMAND, forgeries.put)
    frames, commands = camera.publisher(FRAME), intruder.publisher(COMMAND, "dm")
    friend = join(run, "viewer")  # joins after the intruder, by the same ways, with the right one
    heard = Mailbox()
    friend.subscribe(FRAME, heard.put)

    def talk() -> bool:
        frames.put(b"frame")
        commands.put(b"command")
        return heard.received > 20

    until(talk)
    assert (intruder.peers(), overheard.received, forgeries.received) == (0, 0, 0)


def test_a_program_without_a_password_is_refused(run: Run, join: Callable[[Run, str], ZenohBus]) -> None:
    camera, friend = join(run, "camera"), join(run, "viewer")
    config = session_config(run.links, "operator")
    del config["transport"]["auth"]
    overheard: list[zenoh.Sample] = []
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as intruder:
        intruder.declare_subscriber("**", overheard.append)
        heard, frames = Mailbox(), camera.publisher(FRAME)
        friend.subscribe(FRAME, heard.put)

        def talk() -> bool:
            frames.put(b"frame")
            return heard.received > 20

        until(talk)
    assert not overheard


def test_a_late_joiner_gets_the_last_message_with_its_envelope(run: Run, join: Callable[[Run, str], ZenohBus]) -> None:
    controller = join(run, "controller")
    calibrations = controller.publisher(CALIBRATION)
    calibrations.put(b"old")
    body = bytes(range(256)) * 12_000  # 3 MB, as a large calibration
    envelope = calibrations.put(body)
    late = join(run, "operator")
    until(lambda: bool(late.get(CALIBRATION.key)))
    (answer,) = late.get(CALIBRATION.key, timeout_s=PATIENCE_S)
    assert answer.payload == body
    assert (answer.key, answer.sequence, answer.publish_time_ns) == (
        CALIBRATION.key,
        envelope.sequence,
        envelope.publish_time_ns,
    )
    assert calibrations.last == (body, envelope)


def test_get_collects_one_answer_of_each_process(run: Run, join: Callable[[Run, str], ZenohBus]) -> None:
    for role in ROLES:
        join(run, role).publisher(HEALTH, role).put(role.encode())
    asker = join(run, "operator")
    until(lambda: asker.peers() == len(ROLES))
    until(lambda: {answer.payload.decode() for answer in asker.get(HEALTH.at("*"))} == set(ROLES))
    assert asker.get("lowfc/nobody") == []


def test_a_question_is_answered_later_from_another_thread(run: Run, join: Callable[[Run, str], ZenohBus]) -> None:
    controller, operator = join(run, "controller"), join(run, "operator")
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


def test_faults_of_handlers_are_counted_and_shown_once(
    run: Run, join: Callable[[Run, str], ZenohBus], capfd: pytest.CaptureFixture[str]
) -> None:
    controller, operator = join(run, "controller"), join(run, "operator")
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
    assert operator.get("lowfc/request/open", timeout_s=PATIENCE_S) == []
    assert controller.faults.counts["controller: handler of lowfc/mirror/*/command"] >= 3
    assert controller.faults.counts["controller: queryable of lowfc/request/open"] == 1
    assert capfd.readouterr().err.count("RuntimeError: handler broke") == 2


@pytest.mark.parametrize("attachment", [None, b"xyz", b"\xff" * 16])
def test_a_message_without_a_readable_envelope_is_counted_and_no_traceback(
    run: Run, join: Callable[[Run, str], ZenohBus], capfd: pytest.CaptureFixture[str], attachment: bytes | None
) -> None:
    controller = join(run, "controller")
    box = Mailbox()
    controller.subscribe(FRAME, box.put)
    ring = controller.ring(HEALTH, 10)
    with zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(run.links, "camera")))) as stranger:

        def put() -> bool:
            stranger.put(FRAME.key, b"bare", attachment=attachment)
            stranger.put(HEALTH.at("camera"), b"bare", attachment=attachment)
            assert ring.drain() == []
            return set(controller.faults.unreadable) == {FRAME.key, HEALTH.at("*")}

        until(put)
    assert box.received == 0
    assert all("envelope" in str(why) for _, why in controller.faults.unreadable.values())
    assert not controller.faults.counts
    assert "Traceback" not in capfd.readouterr().err


def test_a_ring_that_is_closed_has_no_subscriber(run: Run, join: Callable[[Run, str], ZenohBus]) -> None:
    operator, camera = join(run, "operator"), join(run, "camera")
    frames = camera.publisher(FRAME)
    ring = operator.ring(FRAME, 4)
    until(lambda: frames._publisher.matching_status.matching)
    ring.close()
    until(lambda: not frames._publisher.matching_status.matching)
    ring.close()


def test_a_frozen_subscriber_costs_the_others_nothing(
    run: Run, start: Callable[[], Toy], join: Callable[[Run, str], ZenohBus]
) -> None:
    camera, controller = join(run, "camera"), join(run, "controller")
    box = Mailbox()
    controller.subscribe(FRAME, box.put)
    toy = start()
    toy.do(f"open {run.run_id} mirror-dm")
    frames = camera.publisher(FRAME)

    def put() -> bool:
        frames.put(b"first")
        return bool(box.take(0.01)) and FRAME.key in toy.do("heard")

    until(put)
    toy.process.send_signal(signal.SIGSTOP)
    body = b"x" * 12_800
    for _ in range(1500):  # 19 MB, more than the link can hold
        frames.put(body)
        assert box.take(PATIENCE_S)
    assert camera.peers() == 2  # a put that waits would have closed the link
    toy.process.send_signal(signal.SIGCONT)
    known = toy.do("heard")[FRAME.key]

    def again() -> bool:
        frames.put(b"last")
        return toy.do("heard")[FRAME.key][2] == "last"

    until(again)
    count, start_s, _ = toy.do("heard")[FRAME.key]
    assert known[0] < count < frames.published
    assert start_s == start_of(box.last_sequence)


def test_a_role_can_be_taken_once(run: Run, join: Callable[[Run, str], ZenohBus]) -> None:
    join(run, "camera")
    with pytest.raises(BusError, match=rf"camera of run '{run.run_id}' .* 127.0.0.1:{run.links.ports['camera']}"):
        join(run, "camera")
    join(run, "operator")
    join(run, "operator")  # who does not listen may be there twice


def test_sequences_count_from_zero_and_never_repeat(run: Run, join: Callable[[Run, str], ZenohBus]) -> None:
    starts = []
    for _ in range(3):  # restarted within one second
        bus = join(run, "camera")
        publisher = bus.publisher(FRAME)
        sequences = [publisher.put(b"").sequence for _ in range(3)]
        assert [count_of(sequence) for sequence in sequences] == [0, 1, 2]
        starts += [start_of(sequences[0])]
        bus.close()
    assert starts == sorted(set(starts))


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
    operator = session_config(run.links, "operator")
    assert operator["listen"]["endpoints"] == []
    assert set(operator["connect"]["endpoints"]) == set(endpoints.values())
    viewer = session_config(run.links, "viewer", looks_on=True)
    assert viewer["listen"]["endpoints"] == []
    assert set(viewer["connect"]["endpoints"]) == set(sockets.values())


def test_where_a_socket_has_too_long_a_name_a_port_serves_those_who_look_on(tmp_path: Path) -> None:
    base = tmp_path / ("long" * 25)
    base.mkdir(mode=0o700)
    links = open_run(new_run_id(), base=base).links
    endpoints = {f"tcp/127.0.0.1:{port}" for port in links.ports.values()}
    assert len(session_config(links, "camera")["listen"]["endpoints"]) == 1
    assert set(session_config(links, "viewer", looks_on=True)["connect"]["endpoints"]) == endpoints


def test_who_looks_on_gets_every_row_and_no_more_pictures_than_it_draws(
    run: Run, join: Callable[..., ZenohBus]
) -> None:
    camera, viewer, recorder = join(run, "camera"), join(run, "viewer", looks_on=True), join(run, "recorder")
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
    for _ in range(500):
        frames.put(b"picture")
        last = truths.put(b"row")
        time.sleep(0.002)

    def got_the_last() -> bool:
        look()
        return seen[TRUTH][-1].sequence == last.sequence and recorded.received >= heard + 500

    until(got_the_last)
    assert len(seen[TRUTH]) - first[TRUTH] >= 500
    assert 5 < len(seen[FRAME]) - first[FRAME] < 250


SLOW_READER = """
import sys, time
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


def test_a_session_that_ends_leaves_no_half_message_with_a_slow_reader(
    run: Run, join: Callable[[Run, str], ZenohBus]
) -> None:
    bus = join(run, "camera")
    frames = bus.publisher(FRAME)
    reader = subprocess.Popen(
        [sys.executable, "-c", SLOW_READER, run.run_id], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )

    def look() -> list[int]:
        reader.stdin.write("\n")
        reader.stdin.flush()
        return [int(word) for word in reader.stdout.readline().split()]

    try:
        number = itertools.count()

        def heard() -> bool:
            frames.put(b"%08d" % next(number) * 1600)
            return look()[0] > 0

        until(heard)
        reader.send_signal(signal.SIGSTOP)
        for _ in range(1000):  # more than the socket takes
            frames.put(b"%08d" % next(number) * 1600)
        threading.Timer(0.5, reader.send_signal, [signal.SIGCONT]).start()
        bus.close()
        received, whole, _ = look()
        assert received == whole
        assert whole > 15  # what the queue and the socket held
    finally:
        reader.kill()
        reader.communicate()
