"""The control loop in plain Python and zenoh, compared with lowfc's; for the arguments see `benchmarks.peers.shared`.

The source is also the mirror: it records when each command arrives.
"""

import json
import struct
import sys
import threading
import time
from collections.abc import Callable

import numpy as np
import zenoh
from zenoh.handlers import Callback

from benchmarks.peers.shared import NumpyStep, RoleProcess, RunData
from lowfc.adapters.bus.run import Links
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.contract.messages import COMMAND, FRAME, Role

PORTS = "ports.json"
"""File with the loopback TCP port of each role that listens."""

_NUMBER = struct.Struct("<QQ")  # as long as lowfc's envelope
_ROLES = {"source": Role.CAMERA, "controller": Role.CONTROLLER}

MessageFunction = Callable[[int, bytes], None]
"""Receives or sends a message: frame number, payload."""


def join(role_process: RoleProcess, receive: MessageFunction) -> MessageFunction:
    """Join a run with a session set up as lowfc's; returns the function that sends."""
    ports = json.loads((role_process.folder / PORTS).read_text())
    links = Links("peers", ports, "lowfc", role_process.folder / "credentials")
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(links, _ROLES[role_process.role]))))
    keys = FRAME.key, COMMAND.at("dm")
    sent, received = keys if role_process.role == "source" else keys[::-1]

    def on_sample(sample: zenoh.Sample) -> None:
        attachment = sample.attachment
        receive(_NUMBER.unpack(b"" if attachment is None else attachment.to_bytes())[0], sample.payload.to_bytes())

    session.declare_subscriber(received, Callback(on_sample, indirect=False))
    publisher = session.declare_publisher(
        sent, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=False
    )

    def put(number: int, payload: bytes, _kept: zenoh.Session = session) -> None:  # keeps the session open
        publisher.put(payload, attachment=_NUMBER.pack(number, 0))

    return put


def source(role_process: RoleProcess) -> None:
    """Send the frames, and record when their commands arrive."""
    received, published = role_process.time_stamps("received"), role_process.time_stamps("published")
    last, now_ns = role_process.last_actuators(), time.monotonic_ns

    def record_command(number: int, payload: bytes) -> None:
        received[number] = now_ns()
        last[:] = np.frombuffer(payload, np.float32)

    payloads = [pixels.tobytes() for pixels in RunData(role_process.folder).frames]
    put = join(role_process, record_command)
    for number in role_process.frame_numbers():
        published[number] = now_ns()
        put(number, payloads[number % len(payloads)])


def controller(role_process: RoleProcess) -> None:
    """Answer frames until the process is killed."""
    commanded, step = role_process.time_stamps("commanded"), NumpyStep(RunData(role_process.folder))

    def answer(number: int, payload: bytes) -> None:
        put(number, step.command(payload))
        commanded[number] = time.monotonic_ns()

    put = join(role_process, answer)
    role_process.ready()
    threading.Event().wait()


if __name__ == "__main__":
    own = RoleProcess(sys.argv[1:])
    own.set_up_realtime()
    {"source": source, "controller": controller}[own.role](own)
