"""How a frame gets to the controller and a command back: by a ring, by zenoh, by both, or by lowfc's bus and mailbox.

Each function joins a run; `take` gets what comes, on a thread of the transport's.
"""

import json
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import zenoh
from zenoh.handlers import Callback, RingChannel

from benchmarks.peers.process import Part
from benchmarks.peers.ring import Ring
from lowfc.adapters.bus import Sample
from lowfc.adapters.clock import HostClock
from lowfc.adapters.handover import Handover
from lowfc.adapters.realtime import let_send
from lowfc.adapters.run import Links, mirror_role
from lowfc.adapters.zenoh_bus import ZenohBus, session_config
from lowfc.contract.messages import COMMAND, FRAME, Role

_ENVELOPE = struct.Struct("<QQ")  # number and time, as long as what lowfc sends with every message
_MIRROR = "dm"
_ROLES = {"source": Role.CAMERA, "controller": Role.CONTROLLER, "onlooker": Role.VIEWER}
_LOOK_S = 0.02
_KEPT = 4096

Message = Callable[[int, int, bytes], None]
"""Takes or sends a message: number, time it was sent (CLOCK_MONOTONIC, ns), payload."""


@dataclass(frozen=True)
class Link:
    """What a transport gives: `put` sends to the other end of the loop, `tell` then to everybody else.

    `put` returns when the other end could have it (CLOCK_MONOTONIC, ns), or None where that is when it returns. `kept`
    must live as long as the link does.
    """

    put: Callable[[int, int, bytes], int | None]
    tell: Callable[[int, int, bytes], object] | None = None
    kept: object = None


def ring(part: Part, frame_bytes: int, command_bytes: int, take: Message) -> Link:
    """By shared memory alone; the source makes both rings."""
    make, wake = part.role == "source", part.plan.options["wake"]
    frames = Ring(part.folder / "frames", frame_bytes, wake, make=make)
    commands = Ring(part.folder / "commands", command_bytes, wake, make=make)
    sent, taken = (frames, commands) if make else (commands, frames)

    def run() -> None:
        while True:
            take(*taken.take())

    threading.Thread(target=run, daemon=True).start()
    return Link(sent.put)


def bare_zenoh(part: Part, _frame_bytes: int, _command_bytes: int, take: Message | None) -> Link:
    """By zenoh as it comes, with a callback, in sessions set up as lowfc's are; `take` is None for who only sends."""
    session = _session(part)
    sent, taken = FRAME.key, COMMAND.at(_MIRROR)
    if part.role != "source":
        sent, taken = taken, sent
    if take is not None:

        def received(sample: zenoh.Sample) -> None:
            take(*_envelope(sample), sample.payload.to_bytes())

        session.declare_subscriber(taken, Callback(received, indirect=False))
    publisher = session.declare_publisher(
        sent, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=False
    )

    def put(number: int, time_ns: int, payload: bytes) -> None:
        publisher.put(payload, attachment=_ENVELOPE.pack(number, time_ns))

    return Link(put, kept=session)


def both(part: Part, frame_bytes: int, command_bytes: int, take: Message) -> Link:
    """By the ring to the other end of the loop, and by zenoh to everybody else, a moment later: a prototype."""
    to_everybody = bare_zenoh(part, frame_bytes, command_bytes, None)
    return Link(ring(part, frame_bytes, command_bytes, take).put, to_everybody.put, to_everybody)


def lowfc_bus(part: Part, _frame_bytes: int, _command_bytes: int, take: Message) -> Link:
    """By lowfc's bus, as its loop is built: frames handed over on its own thread; the source is the mirror as well."""
    clock = HostClock()
    bus = ZenohBus(_links(part), _ROLES[part.role], clock)

    def pass_on(sample: Sample) -> None:
        take(sample.sequence, sample.publish_time_ns - clock.offset_ns, sample.payload)

    kept: tuple[ZenohBus, ...]
    if part.role == "source":
        mirror = ZenohBus(_links(part), mirror_role(_MIRROR), clock)
        mirror.subscribe(COMMAND, pass_on, _MIRROR)
        kept, publisher = (bus, mirror), bus.publisher(FRAME)
    else:
        bus.subscribe(FRAME, Handover(FRAME.key, pass_on, clock.host_ns).put)
        kept, publisher = (bus,), bus.publisher(COMMAND, _MIRROR)

    def put(number: int, time_ns: int, payload: bytes) -> int:
        publisher.put(payload, time_ns + clock.offset_ns, number)
        return publisher.handed_ns - clock.offset_ns

    def afterwards(_number: int, _time_ns: int, _payload: bytes) -> None:
        let_send()

    return Link(put, afterwards, kept)


def watch(part: Part) -> Iterator[int]:
    """Look on by zenoh, as a recorder does, now and then and without end; yields the number of every frame that came.

    The first is 0: from then on none is missed.
    """
    session = _session(part)
    subscriber = session.declare_subscriber(FRAME.key, RingChannel(_KEPT))
    yield 0
    while True:
        time.sleep(_LOOK_S)
        while (sample := subscriber.try_recv()) is not None:
            yield _envelope(sample)[0]


TRANSPORTS = {"ring": ring, "zenoh": bare_zenoh, "both": both, "lowfc": lowfc_bus}


def _session(part: Part) -> zenoh.Session:
    links = _links(part)
    return zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(links, _ROLES[part.role]))))


def _links(part: Part) -> Links:
    """Only who takes part: a session keeps looking for whoever is named and not there."""
    ports = {str(_ROLES[role]): port for role, port in part.plan.ports.items()}
    return Links("contest", ports, "contest", part.folder / "credentials")


def _envelope(sample: zenoh.Sample) -> tuple[int, int]:
    attachment = sample.attachment
    number, time_ns = _ENVELOPE.unpack(b"" if attachment is None else attachment.to_bytes())
    return number, time_ns
