"""Chaos cases of the bus and the operator: junk, forged messages and malformed requests from within the run."""

import itertools
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager

import numpy as np

from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Client
from lowfc.contract.envelope import sequence_of
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import COMMAND, FRAME, REQUEST_KEY, TOPICS, Role, Topic, image, wire
from lowfc.programs.reliability.chaos.bench import CaseFailedError, ChaosBench
from lowfc.programs.reliability.chaos.case import LOST, case
from lowfc.programs.reliability.chaos.evidence import FORGED_S

FLOOD_HZ = 2000
FLOOD_S = 2.0
FORGED_MESSAGES = 200
OPERATORS = 8
REQUESTS = 25
_POLL_S = 0.01
_NAMES = ("status", "open", "close", "gain", "leak", "limit", "offset", "channel", "play", "load", "law", "nonsense")
_MAY_SUCCEED = ("status", "open", "close", "offset", "play", "law", "channel")
"""Requests that random bytes may form validly: in their place, a name that does not exist is used."""


class Intruder(AbstractContextManager["Intruder"]):
    """A hostile connection with the run's secret."""

    def __init__(self, bench: ChaosBench) -> None:
        self.rng = np.random.default_rng(bench.rng.getrandbits(32))
        self._bus = ZenohBus(bench.run.links, Role.OPERATOR, HostClock())
        self._clock = HostClock()
        self._publishers = {
            topic: self._bus.publisher(topic, bench.config.mirror.name if topic.key.startswith("lowfc/mirror") else "x")
            for topic in TOPICS
        }
        self._counts = dict.fromkeys(TOPICS, 0)
        deadline_s = time.monotonic() + 2
        while self._bus.peers() < 3 and time.monotonic() < deadline_s:
            time.sleep(_POLL_S)

    def __exit__(self, *_: object) -> None:
        self._bus.close()

    def send(self, topic: Topic, payload: bytes) -> None:
        """Publish a message whose sequence claims a publisher that started at `FORGED_S`."""
        self._publishers[topic].put(payload, self._clock.host_ns(), sequence_of(FORGED_S, self._counts[topic]))
        self._counts[topic] += 1

    def ask(self, name: str, payload: bytes, timeout_s: float) -> int:
        """Send a request to the controller; return the number of answers."""
        return len(self._bus.get(REQUEST_KEY.format(name=name), payload, timeout_s))


@case("junk", "2,000 messages of random bytes a second, over all topics", allowed=LOST, prints_tracebacks=True)
def _flood(bench: ChaosBench) -> None:
    with Intruder(bench) as intruder:
        begun_s = time.monotonic()
        for number in itertools.count():
            elapsed_s = time.monotonic() - begun_s
            if elapsed_s >= FLOOD_S:
                break
            if number >= elapsed_s * FLOOD_HZ:
                time.sleep(_POLL_S)
            intruder.send(TOPICS[number % len(TOPICS)], intruder.rng.bytes(int(intruder.rng.integers(0, 2000))))


def _commands(bench: ChaosBench, rng: np.random.Generator) -> Iterator[wire.MirrorCommand]:
    """Commands with random shapes: finite, not finite, too large, and of another size."""
    rows, columns = bench.config.mirror.rows, bench.config.mirror.columns
    for number in range(FORGED_MESSAGES):
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


@case(
    "forged-commands",
    "commands with random content from a process with the run's secret",
    expected=("COMMAND_REFUSED command refused: NOT_FINITE", "LIMIT_HIT"),
    allowed=LOST,
)
def _forged_commands(bench: ChaosBench) -> None:
    with Intruder(bench) as intruder:
        for command in _commands(bench, intruder.rng):
            command.frame_sequence = bench.newest_frame
            intruder.send(COMMAND, command.SerializeToString())
            time.sleep(_POLL_S)


@case("forged-frames", "frames with past sequence numbers", allowed=LOST)
def _forged_frames(bench: ChaosBench) -> None:
    with Intruder(bench) as intruder:
        for _ in range(FORGED_MESSAGES):
            pixels = intruder.rng.integers(0, 40_000, (80, 80)).astype(np.uint16)
            intruder.send(FRAME, image(pixels, HostClock().host_ns(), "forged").SerializeToString())
            time.sleep(_POLL_S)


@case("malformed-requests", "requests of random bytes")
def _malformed_requests(bench: ChaosBench) -> None:
    """Every request must be answered."""
    with Intruder(bench) as intruder:
        for number in range(200):
            name = _NAMES[number % len(_NAMES)]
            if name in _MAY_SUCCEED:
                name += "-not"
            body = intruder.rng.bytes(int(intruder.rng.integers(1, 3000)))
            if not intruder.ask(name, body, 2.0):
                raise CaseFailedError(f"request {number}, {name!r} of {len(body)} random bytes, was not answered")


@case("huge-requests", "requests of up to 64 MB", allowed=LOST)
def _huge_requests(bench: ChaosBench) -> None:
    """The requests may be refused, or lost by the bus; the loop must continue."""
    with Intruder(bench) as intruder:
        for megabytes in (1, 8, 32, 64):
            message = wire.Request(name="channel", text="huge", actuators=bytes(megabytes * 1_000_000))
            intruder.ask("channel", message.SerializeToString(), 10.0)


@case("concurrent-requests", "eight operators at once")
def _concurrent_requests(bench: ChaosBench) -> None:
    """Each operator has its own connection; every request must be answered."""

    def operate(number: int) -> str:
        """Make the requests of one operator; return why they failed, or an empty text."""
        bus = ZenohBus(bench.run.links, Role.OPERATOR, HostClock())
        try:
            client = Client(bench.run.run_id, bus=bus)
            time.sleep(0.5)
            for turn in range(REQUESTS):
                if turn % 3 == 0:
                    client.status()
                else:
                    client.note(f"operator {number}, {turn}")
        except LowfcError as fault:
            return str(fault)
        finally:
            bus.close()
        return ""

    with ThreadPoolExecutor(OPERATORS) as operators:
        failed = list(filter(None, operators.map(operate, range(OPERATORS))))
    if failed:
        raise CaseFailedError(f"{len(failed)} of {OPERATORS} operators failed: {failed[0]}")
