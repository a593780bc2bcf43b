"""The processes of a contestant in plain Python: python -m benchmarks.peers.plain ROLE FOLDER.

The source is the mirror as well: it notes when a command is back. Frames and commands go by a ring in shared memory or
by zenoh.
"""

import ctypes
import json
import mmap
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import zenoh
from zenoh.handlers import Callback

from benchmarks.peers.shared import DIFFERENT, NumpyStep, Part, Problem
from lowfc.adapters.bus.run import Links
from lowfc.adapters.bus.zenoh_bus import session_config
from lowfc.contract.messages import COMMAND, FRAME, Role

_NUMBER = struct.Struct("<QQ")  # as long as what lowfc sends with every message
_ROLES = {"source": Role.CAMERA, "controller": Role.CONTROLLER}
_SLOTS = 8
_SEMAPHORE_OFFSET = 64  # before it the newest number, in a line of its own
_BODY_OFFSET = 128

Message = Callable[[int, bytes], None]
"""Takes or sends a message: number, payload."""


class Ring:
    """The newest of a few slots in shared memory, and a semaphore: one process puts, one takes the newest.

    A slot's number is written after its content and looked at again after the content was copied, so that nobody takes
    half of one message and half of another. That holds on processors that keep the order of stores (x86). A message is
    lost where the taker is more than one behind.
    """

    def __init__(self, path: Path, message_bytes: int, *, make: bool) -> None:
        """Open the ring in a file of a memory file system; one side makes it, before the other opens it."""
        self._bytes = message_bytes
        self._stride = 8 + (message_bytes + 7) // 8 * 8
        if make:
            path.write_bytes(bytes(_BODY_OFFSET + _SLOTS * self._stride))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), 0)
        self._words = memoryview(self._memory).cast("Q")
        self._taken = 0
        self._place = ctypes.c_void_p(ctypes.addressof(ctypes.c_char.from_buffer(self._memory, _SEMAPHORE_OFFSET)))
        waiting, posting = (
            ctypes.CDLL(None),
            ctypes.PyDLL(None),
        )  # posting keeps the interpreter's lock: it is soon done
        self._wait, self._post = waiting.sem_wait, posting.sem_post
        if make and waiting.sem_init(self._place, 1, 0) != 0:
            raise OSError("this host has no semaphores in shared memory")

    def put(self, number: int, payload: bytes) -> None:
        """Leave a message and wake who waits for it; numbers grow, from 1."""
        start = _BODY_OFFSET + number % _SLOTS * self._stride
        words, word = self._words, start // 8
        words[word] = 0
        self._memory[start + 8 : start + 8 + self._bytes] = payload
        words[word] = words[0] = number
        self._post(self._place)

    def take(self) -> tuple[int, bytes]:
        """Wait for a message newer than the last taken; its number and payload."""
        while True:
            number = self._words[0]
            if number == self._taken:
                self._wait(self._place)
                continue
            start = _BODY_OFFSET + number % _SLOTS * self._stride
            payload = self._memory[start + 8 : start + 8 + self._bytes]
            if self._words[start // 8] == number:  # else it was overwritten while it was copied: there is a newer one
                self._taken = number
                return number, payload


def by_ring(part: Part, frame_bytes: int, command_bytes: int, take: Message) -> Message:
    """Join a run by shared memory; the source makes both rings. `take` is called on a thread of its own."""
    make = part.role == "source"
    frames = Ring(part.folder / "frames", frame_bytes, make=make)
    commands = Ring(part.folder / "commands", command_bytes, make=make)
    sent, taken = (frames, commands) if make else (commands, frames)

    def run() -> None:
        while True:
            take(*taken.take())

    threading.Thread(target=run, daemon=True).start()
    return sent.put


def by_zenoh(part: Part, _frame_bytes: int, _command_bytes: int, take: Message) -> Message:
    """Join a run by zenoh as it comes, with a callback, in sessions set up as lowfc's are."""
    ports = {str(_ROLES[role]): port for role, port in part.plan.ports.items()}
    links = Links("contest", ports, "contest", part.folder / "credentials")
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(links, _ROLES[part.role]))))
    sent, taken = FRAME.key, COMMAND.at("dm")
    if part.role != "source":
        sent, taken = taken, sent

    def received(sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        take(_NUMBER.unpack(b"" if attachment is None else attachment.to_bytes())[0], sample.payload.to_bytes())

    session.declare_subscriber(taken, Callback(received, indirect=False))
    publisher = session.declare_publisher(
        sent, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=False
    )

    def put(number: int, payload: bytes, _kept: zenoh.Session = session) -> None:
        publisher.put(payload, attachment=_NUMBER.pack(number, 0))

    return put


TRANSPORTS = {"ring": by_ring, "zenoh": by_zenoh}


def source(part: Part) -> None:
    """Send the frames, and note when commands come back."""
    received, published, now_ns = part.marks("received"), part.marks("published"), time.monotonic_ns

    def back(number: int, _payload: bytes) -> None:
        received[number] = now_ns()

    payloads = [pixels.tobytes() for pixels in Problem().frames]
    put = _join(part, back)
    for number in part.frames():
        published[number] = now_ns()
        put(number, payloads[number % DIFFERENT])


def controller(part: Part) -> None:
    """Answer frames until it is killed."""
    commanded, step = part.marks("commanded"), NumpyStep(Problem())

    def answer(number: int, payload: bytes) -> None:
        put(number, step.command(payload))
        commanded[number] = time.monotonic_ns()

    put = _join(part, answer)
    part.ready()
    threading.Event().wait()


def timer(part: Part) -> None:
    """No loop at all: what a sleep until a given time costs on this host, the same way as the frames are paced."""
    published, commanded, due = part.marks("published"), part.marks("commanded"), part.marks("due")
    for number in part.frames():
        commanded[number] = time.monotonic_ns()
        published[number] = due[number]


def _join(part: Part, take: Message) -> Message:
    frame = Problem().frames[0].tobytes()
    return TRANSPORTS[part.plan.transport](part, len(frame), len(NumpyStep(Problem()).command(frame)), take)


if __name__ == "__main__":
    role, folder = sys.argv[1:]
    own = Part(role, Path(folder))
    own.settle()
    {"source": source, "controller": controller, "timer": timer}[role](own)
