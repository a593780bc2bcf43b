"""A bare zenoh echo, the reference for a loop's latency: a frame out, a command back, no work in between.

Two processes, each with a plain zenoh session, use the loop's links and its settings of session, publishers and
scheduling. The process that answers is set up like the controller; after the echo it times the control step and the
host's timer.
"""

import dataclasses
import json
import threading
import time
from typing import Annotated

import numpy as np
import typer
import zenoh
from zenoh.handlers import Callback

from lowfc.adapters.bus.run import Run, open_run
from lowfc.adapters.bus.zenoh_bus import declare_publisher
from lowfc.adapters.bus.zenoh_session import keep_thread_state, session_config
from lowfc.adapters.files.whole_file import being_written
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.join import prepare, prepare_ready
from lowfc.adapters.process.realtime import yield_to_sender
from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.arrays import Long
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import Envelope
from lowfc.contract.errors import BusError
from lowfc.contract.messages import COMMAND, FRAME, Role
from lowfc.programs.measure.frame_source import FRAMES_FILE, Payloads
from lowfc.programs.measure.latency.frame_statistics import WARM_UP_S

ECHO_FILE = "echo.npz"
"""File in the run's directory: round_trip_ns of every frame after the warm-up, -1 without an answer."""
ALONE_FILE = "alone.npz"
"""File in the run's directory: timer_ns and step_ns as from `time_alone`, and hot_step_ns of steps back to back."""

_READY_S = 30.0  # longest wait for the answering process
_POLL_S = 0.02
_SETTLE_S = 0.1
_HOT_S = 0.3  # time for which steps are run back to back
_LOST = -1  # round trip of a frame without an answer

Seconds = Annotated[float, typer.Option(help="Duration, seconds.")]

app = new_app("A bare zenoh echo.")


@app.command()
def ask(run: RunId = DEFAULT_RUN, config: ConfigFile = None, seconds: Seconds = 10.0) -> None:
    """Send frames in place of the camera, and time each round trip."""
    settings = configuration(config)
    joined = _join(settings, run, Role.CAMERA, settings.realtime.camera_cpus)
    payloads = Payloads(np.load(joined.path / FRAMES_FILE))
    round_trip_ns = _ask(settings, joined, payloads, seconds)
    with being_written(joined.path / ECHO_FILE) as part, part.open("wb") as file:
        np.savez(file, round_trip_ns=round_trip_ns)


@app.command()
def answer(run: RunId = DEFAULT_RUN, config: ConfigFile = None, seconds: Seconds = 10.0) -> None:
    """Answer frames in place of the controller until an empty frame; then time control step and timer alone."""
    from lowfc.adapters.files import calibration_file
    from lowfc.programs.measure.control_step import ControlStep, time_alone

    settings = configuration(config)
    calibration = calibration_file.load(open_run(run, (settings.mirror.name,)).path / "calibration.fits")
    joined = _join(settings, run, Role.CONTROLLER, settings.realtime.controller_cpus)
    payloads = Payloads(np.load(joined.path / FRAMES_FILE))
    clock = HostClock()
    step = ControlStep(settings, calibration, clock.host_ns())
    _answer(settings, joined, step(payloads.at(0, clock.host_ns())))
    _, hot_ns = time_alone(step, payloads, clock, _HOT_S, None)
    timer_ns, step_ns = time_alone(step, payloads, clock, seconds, settings.period_ns)
    with being_written(joined.path / ALONE_FILE) as part, part.open("wb") as file:
        np.savez(file, timer_ns=timer_ns, step_ns=step_ns, hot_step_ns=hot_ns)


def _ask(config: Configuration, run: Run, payloads: Payloads, seconds: float) -> Long:
    """Round trip of each frame, ns, for `seconds` after the warm-up; -1 if lost. An empty frame ends the echo."""
    clock = HostClock()
    sent_ns: list[int] = []
    round_trip_ns: list[int] = []

    def received(sample: zenoh.Sample) -> None:
        now_ns = clock.host_ns()
        keep_thread_state()
        assert sample.attachment is not None  # noqa: S101  # sent by `answer`
        index, time_ns = Envelope.decode_checked(sample.attachment.to_bytes())
        sample.payload.to_bytes()  # read as the mirror reads a command
        round_trip_ns[index] = now_ns - time_ns

    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(run.links, Role.CAMERA))))
    try:
        publisher = declare_publisher(session, FRAME, FRAME.key)
        prepare_ready(config)
        subscriber = session.declare_subscriber(COMMAND.at(config.mirror.name), Callback(received, indirect=False))
        deadline_s = time.monotonic() + _READY_S
        while not publisher.matching_status.matching:  # type: ignore[attr-defined]  # not a bool
            if time.monotonic() > deadline_s:
                raise BusError(f"the answering process of the bare echo was not ready within {_READY_S:g} s")
            time.sleep(_POLL_S)
        time.sleep(_SETTLE_S)  # for the publisher of the other process to connect
        due_ns = clock.host_ns()
        end_ns = due_ns + round((WARM_UP_S + seconds) * 1e9)
        while due_ns < end_ns:
            payload = payloads.at(len(sent_ns), due_ns)
            clock.sleep_until_ns(due_ns)
            round_trip_ns.append(_LOST)
            sent_ns.append(clock.host_ns())
            publisher.put(payload, attachment=Envelope(len(sent_ns) - 1, sent_ns[-1]).encode())
            yield_to_sender()
            due_ns += config.period_ns
        time.sleep(_SETTLE_S)
        session.put(FRAME.key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    finally:
        session.close()  # type: ignore[no-untyped-call]
    after_warm_up = np.array(sent_ns) >= sent_ns[0] + round(WARM_UP_S * 1e9)
    return np.array(round_trip_ns, np.int64)[after_warm_up]


def _answer(config: Configuration, run: Run, command: bytes) -> None:
    """Answer every frame with this command until an empty frame arrives."""
    ended = threading.Event()
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(run.links, Role.CONTROLLER))))
    publisher = declare_publisher(session, COMMAND, COMMAND.at(config.mirror.name))

    def received(sample: zenoh.Sample) -> None:
        keep_thread_state()
        if sample.payload.to_bytes():
            publisher.put(command, attachment=sample.attachment)
        else:
            ended.set()

    prepare_ready(config)
    subscriber = session.declare_subscriber(FRAME.key, Callback(received, indirect=False))
    ended.wait()
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    session.close()  # type: ignore[no-untyped-call]


def _join(config: Configuration, run_id: str, role: str, cpus: list[int]) -> Run:
    """Set this process up like the loop's process of this role; return the run with the links of the two roles only."""
    prepare(config, role, cpus)
    run = open_run(run_id, (config.mirror.name,))
    ports = {str(role): run.links.ports[role] for role in (Role.CAMERA, Role.CONTROLLER)}
    return dataclasses.replace(run, links=dataclasses.replace(run.links, ports=ports))


if __name__ == "__main__":
    run_app(app)
