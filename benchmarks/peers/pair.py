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
from lowfc.adapters.mailbox import Mailbox
from lowfc.adapters.zenoh_bus import receive_in_one_thread
from lowfc.programs.rehearsal import Rehearsal

_STEPS: dict[str, type[NumpyStep] | type[LowfcStep]] = {"numpy": NumpyStep, "lowfc": LowfcStep}
_LONGEST_PAUSE_S = 0.1
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
    stage = Stage(step, part.plan.rate_hz) if isinstance(step, LowfcStep) and _is_lowfc(part) else None

    def answer(number: int, sent_ns: int, payload: bytes) -> None:
        taken_ns = now_ns()
        command = step.command(payload, number, taken_ns - sent_ns)
        commanded[number] = link.put(number, taken_ns, command) or now_ns()
        if link.tell is not None:
            link.tell(number, taken_ns, command)
        if stage is not None:
            stage.played(payload, taken_ns)

    link = _join(part, answer if stage is None else stage.alone(answer))
    part.ready()
    if stage is not None:
        stage.rehearse()
    threading.Event().wait()


class Stage:
    """Where a step is done, and rehearsed before the next frame, as lowfc's controller does."""

    def __init__(self, step: LowfcStep, rate_hz: float) -> None:
        self._step = step
        self._rehearsal = Rehearsal(round(1e9 / rate_hz))
        self._turn = threading.Lock()
        self._pause = Mailbox()
        self._payload = b""

    def alone(self, answer: Message) -> Message:
        """The same, but never while there is a rehearsal."""

        def answered(number: int, sent_ns: int, payload: bytes) -> None:
            with self._turn:
                answer(number, sent_ns, payload)

        return answered

    def played(self, payload: bytes, now_ns: int) -> None:
        """A frame was answered."""
        self._payload = payload
        self._rehearsal.came(now_ns)
        self._pause.wake()

    def rehearse(self) -> None:
        """Without end."""
        while True:
            rest_ns = self._rehearsal.rest_ns(time.monotonic_ns())
            self._pause.take(_LONGEST_PAUSE_S if rest_ns is None else rest_ns * 1e-9)
            with self._turn:
                if self._rehearsal.begins(time.monotonic_ns()):
                    self._step.rehearse(self._payload)


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
    if _is_lowfc(part):  # as its processes are set up, whatever that is
        realtime.set_up(part.priority or None, {part.cpu}, lock_memory=True, stay_awake=False)
    else:
        part.settle()


def _is_lowfc(part: Part) -> bool:
    return part.plan.options.get("transport") == "lowfc"


_ROLES = {"source": source, "controller": controller, "onlooker": onlooker, "timer": timer}


if __name__ == "__main__":
    role, folder = sys.argv[1:]
    own = Part(role, Path(folder))
    _settle(own)
    _ROLES[role](own)
