"""The processes of a contestant in plain Python: python -m benchmarks.peers.pair ROLE FOLDER.

The source is the mirror as well: it notes when a command is back.
"""

import sys
import threading
import time
from pathlib import Path

from benchmarks.peers.lowfc_step import LowfcStep
from benchmarks.peers.problem import DIFFERENT, NumpyStep, Problem
from benchmarks.peers.process import Part
from benchmarks.peers.transports import TRANSPORTS, Link, Message, watch
from lowfc.adapters import realtime
from lowfc.adapters.zenoh_bus import receive_in_one_thread

_STEPS = {"numpy": NumpyStep, "lowfc": LowfcStep}
_GROWTH_BYTES = 64  # numbers in a protobuf message grow longer


def source(part: Part) -> None:
    """Send the frames, and note when commands come back."""
    received, published, now_ns = part.marks("received"), part.marks("published"), time.monotonic_ns

    def back(number: int, _time_ns: int, _payload: bytes) -> None:
        received[number] = now_ns()

    step = _step(part)
    payloads = [step.payload(pixels, time.time_ns()) for pixels in Problem().frames]
    link = _join(part, back)
    for number in part.frames():
        published[number] = sent_ns = now_ns()
        payload = payloads[number % DIFFERENT]
        link.put(number, sent_ns, payload)
        if link.tell is not None:
            link.tell(number, sent_ns, payload)


def controller(part: Part) -> None:
    """Answer frames until told to stop."""
    commanded, now_ns = part.marks("commanded"), time.monotonic_ns
    step = _step(part)

    def answer(number: int, sent_ns: int, payload: bytes) -> None:
        taken_ns = now_ns()
        command = step.command(payload, number, taken_ns - sent_ns)
        link.put(number, taken_ns, command)
        commanded[number] = now_ns()
        if link.tell is not None:
            link.tell(number, taken_ns, command)

    link = _join(part, answer)
    part.ready()
    threading.Event().wait()


def onlooker(part: Part) -> None:
    """Everybody else: keep note of the frames that come by zenoh."""
    observed = part.marks("observed")
    frames = watch(part)
    next(frames)
    part.ready()
    for number in frames:
        observed[number] = time.monotonic_ns()


def timer(part: Part) -> None:
    """No loop at all: what a sleep until a given time costs on this host, the same way as the frames are paced."""
    published, commanded = part.marks("published"), part.marks("commanded")
    due = part.marks("due")
    for number in part.frames():
        commanded[number] = time.monotonic_ns()
        published[number] = due[number]


def _join(part: Part, take: Message) -> Link:
    step = _step(part)
    frame = step.payload(Problem().frames[0], time.time_ns())
    command = step.command(frame, 1, 0)
    return TRANSPORTS[part.plan.options["transport"]](part, len(frame), len(command) + _GROWTH_BYTES, take)


def _step(part: Part) -> NumpyStep | LowfcStep:
    return _STEPS[part.plan.options["step"]](Problem())


def _settle(part: Part) -> None:
    if part.role != "source":  # as a process of lowfc's that waits for what it receives
        receive_in_one_thread()
    if part.plan.options.get("transport") == "lowfc":  # as its processes are set up, whatever that is
        realtime.set_up(part.priority or None, {part.cpu}, lock_memory=True, stay_awake=False)
    else:
        part.settle()


_ROLES = {"source": source, "controller": controller, "onlooker": onlooker, "timer": timer}


if __name__ == "__main__":
    role, folder = sys.argv[1:]
    own = Part(role, Path(folder))
    _settle(own)
    _ROLES[role](own)
