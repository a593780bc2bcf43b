"""Chaos cases: what must not be believed, by who has the run's secret: junk, forged messages, nonsense asked."""

import itertools
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np

from lowfc.adapters.clock import HostClock
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.client import Client
from lowfc.contract.envelope import sequence_of
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import COMMAND, FRAME, REQUEST_KEY, TOPICS, Role, image, wire
from lowfc.programs.chaos.bench import CaseFailedError, ChaosBench
from lowfc.programs.chaos.evidence import FORGED_S

FLOOD_HZ = 2000
FLOOD_S = 2.0
FORGED = 200
ASKERS = 8
ASKED = 25
_TURN_S = 0.01
_NAMES = ("status", "open", "close", "gain", "leak", "limit", "offset", "channel", "play", "load", "law", "nonsense")


class Intruder:
    """A connection that has the run's secret and means no good."""

    def __init__(self, bench: ChaosBench) -> None:
        self._bus = ZenohBus(bench.run.links, Role.OPERATOR, HostClock())
        self._clock = HostClock()
        self._publishers = {
            topic: self._bus.publisher(topic, bench.config.mirror.name if topic.key.startswith("lowfc/mirror") else "x")
            for topic in TOPICS
        }
        self._counts = dict.fromkeys(TOPICS, 0)
        deadline_s = time.monotonic() + 2
        while self._bus.peers() < 3 and time.monotonic() < deadline_s:
            time.sleep(_TURN_S)

    def __enter__(self) -> "Intruder":
        return self

    def __exit__(self, *fault: object) -> None:
        self._bus.close()

    def send(self, topic: object, payload: bytes) -> None:
        """Put a message with a number of long ago."""
        for one, publisher in self._publishers.items():
            if one is topic:
                publisher.put(payload, self._clock.host_ns(), sequence_of(FORGED_S, self._counts[one]))
                self._counts[one] += 1

    def ask(self, name: str, payload: bytes, patience_s: float) -> int:
        """Ask the controller; return how many answers came."""
        return len(self._bus.get(REQUEST_KEY.format(name=name), payload, patience_s))


def flood(bench: ChaosBench) -> None:
    """Random bytes on every topic."""
    rng = np.random.default_rng(bench.rng.getrandbits(32))
    with Intruder(bench) as intruder:
        begun_s = time.monotonic()
        for number in itertools.count():
            elapsed_s = time.monotonic() - begun_s
            if elapsed_s >= FLOOD_S:
                break
            if number >= elapsed_s * FLOOD_HZ:
                time.sleep(_TURN_S)
            intruder.send(TOPICS[number % len(TOPICS)], rng.bytes(int(rng.integers(0, 2000))))
    bench.settled()


def _commands(bench: ChaosBench, rng: np.random.Generator) -> Iterator[wire.MirrorCommand]:
    """Commands of anything at all, in good form, under the newest frame."""
    rows, columns = bench.config.mirror.rows, bench.config.mirror.columns
    for number in range(FORGED):
        amplitude = float(rng.choice([1.0, 1e2, 1e4, 1e38]))
        shape = (rng.uniform(-1, 1, (rows, columns)) * amplitude).astype(np.float32)
        match number % 10:
            case 0:
                shape.flat[int(rng.integers(shape.size))] = np.nan
            case 1:
                shape.flat[int(rng.integers(shape.size))] = np.inf
            case 2:
                shape = shape[1:]
        command = wire.MirrorCommand(channel="lowfc", valid_for_ns=2**63, rows=len(shape), columns=columns)
        command.timestamp.GetCurrentTime()
        command.actuators = shape.tobytes()
        yield command


def forged_commands(bench: ChaosBench) -> None:
    """Commands of anything at all, among those of the controller."""
    rng = np.random.default_rng(bench.rng.getrandbits(32))
    with Intruder(bench) as intruder:
        for command in _commands(bench, rng):
            command.frame_sequence = bench.newest_frame
            intruder.send(COMMAND, command.SerializeToString())
            time.sleep(_TURN_S)
    bench.settled()


def forged_frames(bench: ChaosBench) -> None:
    """Whole images with numbers of the past."""
    rng = np.random.default_rng(bench.rng.getrandbits(32))
    with Intruder(bench) as intruder:
        for _ in range(FORGED):
            pixels = rng.integers(0, 40_000, (80, 80)).astype(np.uint16)
            intruder.send(FRAME, image(pixels, HostClock().host_ns(), "forged").SerializeToString())
            time.sleep(_TURN_S)
    bench.settled()


def malformed_requests(bench: ChaosBench) -> None:
    """Random bytes as requests; each is answered."""
    rng = np.random.default_rng(bench.rng.getrandbits(32))
    with Intruder(bench) as intruder:
        for number in range(200):
            name = _NAMES[number % len(_NAMES)]
            if name in ("status", "open", "close", "offset", "play", "law", "channel"):
                name += "-not"  # chance must not ask for what is granted
            body = rng.bytes(int(rng.integers(1, 3000)))
            if not intruder.ask(name, body, 2.0):
                raise CaseFailedError(f"request {number}, {name!r} of {len(body)} random bytes, was not answered")
    bench.settled()


def huge_requests(bench: ChaosBench) -> None:
    """Requests of up to 64 MB: refused, or lost by the bus; the loop goes on."""
    with Intruder(bench) as intruder:
        for megabytes in (1, 8, 32, 64):
            message = wire.Request(name="channel", text="huge", actuators=bytes(megabytes * 1_000_000))
            intruder.ask("channel", message.SerializeToString(), 10.0)
    bench.settled()


def concurrent_requests(bench: ChaosBench) -> None:
    """Eight operators, each with a connection of its own, at once: every request is answered."""
    failed: list[str] = []

    def operate(number: int) -> None:
        bus = ZenohBus(bench.run.links, Role.OPERATOR, HostClock())
        try:
            client = Client(bench.run.run_id, bus=bus)
            time.sleep(0.5)
            for turn in range(ASKED):
                asked: Callable[[], object] = (
                    client.status if turn % 3 == 0 else lambda: client.note(f"operator {number}, {turn}")  # noqa: B023
                )
                asked()
        except LowfcError as fault:
            failed.append(str(fault))
        finally:
            bus.close()

    operators = [threading.Thread(target=operate, args=(number,)) for number in range(ASKERS)]
    for operator in operators:
        operator.start()
    for operator in operators:
        operator.join()
    if failed:
        raise CaseFailedError(f"{len(failed)} of {ASKERS} operators failed: {failed[0]}")
    bench.settled()
