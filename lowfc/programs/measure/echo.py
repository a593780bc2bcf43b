"""A bare zenoh echo, what a loop's latency is set against: a frame out, a command back, and nothing done in between.

Two processes with one plain zenoh session each, over the same links, with the same settings of session, publishers and
scheduling as the loop's. The one that answers then times the control step and the host's timer alone, for it stands
where the controller does.
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
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.adapters.files.whole_file import being_written
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.join import prepare
from lowfc.adapters.process.realtime import let_send
from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.arrays import Long
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import Envelope
from lowfc.contract.errors import BusError
from lowfc.contract.messages import COMMAND, FRAME, Role
from lowfc.programs.measure.frame_source import FRAMES_FILE, Payloads
from lowfc.programs.measure.latency.figures import WARM_UP_S

ECHO_FILE = "echo.npz"
"""In the run's directory: round_trip_ns of every frame after the warm-up, -1 where none came back."""
ALONE_FILE = "alone.npz"
"""In the run's directory: timer_ns, step_ns and hot_step_ns, see `Alone`; hot is one step after the other."""

_READY_S = 30.0
_LOOK_S = 0.02
_SETTLE_S = 0.1
_HOT_S = 0.3
_LOST = -1

Seconds = Annotated[float, typer.Option(help="For how long.")]

app = new_app("A bare zenoh echo.")


@app.command()
def ask(run: RunId = DEFAULT_RUN, config: ConfigFile = None, seconds: Seconds = 10.0) -> None:
    """Send frames at the camera's place, and time each until its answer is there."""
    settings = configuration(config)
    joined = _joined(settings, run, Role.CAMERA, settings.realtime.camera_cpus)
    payloads = Payloads(np.load(joined.path / FRAMES_FILE))
    round_trip_ns = _ask(settings, joined, payloads, seconds)
    with being_written(joined.path / ECHO_FILE) as part, part.open("wb") as file:
        np.savez(file, round_trip_ns=round_trip_ns)


@app.command()
def answer(run: RunId = DEFAULT_RUN, config: ConfigFile = None, seconds: Seconds = 10.0) -> None:
    """Answer frames at the controller's place until an empty one; then time what it does alone."""
    from lowfc.adapters.files import calibration_file
    from lowfc.programs.measure.control_step import ControlStep, time_alone

    settings = configuration(config)
    calibration = calibration_file.load(open_run(run, (settings.mirror.name,)).path / "calibration.fits")
    joined = _joined(settings, run, Role.CONTROLLER, settings.realtime.controller_cpus)
    payloads = Payloads(np.load(joined.path / FRAMES_FILE))
    clock = HostClock()
    step = ControlStep(settings, calibration, clock.host_ns())
    _answer(settings, joined, step(payloads.at(0, clock.host_ns())))
    hot = time_alone(step, payloads, clock, _HOT_S, None)
    alone = time_alone(step, payloads, clock, seconds, settings.period_ns)
    with being_written(joined.path / ALONE_FILE) as part, part.open("wb") as file:
        np.savez(file, timer_ns=alone.timer_ns, step_ns=alone.step_ns, hot_step_ns=hot.step_ns)


def _ask(config: Configuration, run: Run, payloads: Payloads, seconds: float) -> Long:
    """Send frames for a time, after the warm-up's, then an empty one; round trips, -1 for an answer lost."""
    clock = HostClock()
    put_ns: list[int] = []
    round_trip_ns: list[int] = []

    def received(sample: zenoh.Sample) -> None:
        now_ns = clock.host_ns()
        assert sample.attachment is not None  # noqa: S101  # our own
        index, sent_ns = Envelope.decode_checked(sample.attachment.to_bytes())
        sample.payload.to_bytes()
        round_trip_ns[index] = now_ns - sent_ns

    session = _session(run, Role.CAMERA)
    try:
        publisher = declare_publisher(session, FRAME, FRAME.key)
        subscriber = session.declare_subscriber(COMMAND.at(config.mirror.name), Callback(received, indirect=False))
        deadline_s = time.monotonic() + _READY_S
        while not publisher.matching_status.matching:  # type: ignore[attr-defined]  # not a bool
            if time.monotonic() > deadline_s:
                raise BusError(f"nobody answers the bare echo after {_READY_S:g} s")
            time.sleep(_LOOK_S)
        time.sleep(_SETTLE_S)  # the other one's publisher is there, too
        due_ns = clock.host_ns()
        end_ns = due_ns + round((WARM_UP_S + seconds) * 1e9)
        while due_ns < end_ns:
            payload = payloads.at(len(put_ns), due_ns)
            clock.sleep_until_ns(due_ns)
            round_trip_ns.append(_LOST)
            put_ns.append(clock.host_ns())
            publisher.put(payload, attachment=Envelope(len(put_ns) - 1, put_ns[-1]).encode())
            let_send()
            due_ns += config.period_ns
        time.sleep(_SETTLE_S)
        session.put(FRAME.key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    finally:
        session.close()  # type: ignore[no-untyped-call]
    warm = np.array(put_ns) >= put_ns[0] + round(WARM_UP_S * 1e9)
    return np.array(round_trip_ns, np.int64)[warm]


def _answer(config: Configuration, run: Run, command: bytes) -> None:
    done = threading.Event()
    session = _session(run, Role.CONTROLLER)
    publisher = declare_publisher(session, COMMAND, COMMAND.at(config.mirror.name))

    def received(sample: zenoh.Sample) -> None:
        if sample.payload.to_bytes():
            publisher.put(command, attachment=sample.attachment)
        else:
            done.set()

    subscriber = session.declare_subscriber(FRAME.key, Callback(received, indirect=False))
    done.wait()
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    session.close()  # type: ignore[no-untyped-call]


def _joined(config: Configuration, run_id: str, role: str, cpus: list[int]) -> Run:
    """The run, its links only those of the two, for a process that is set up as the role's in the loop."""
    prepare(config, cpus)
    run = open_run(run_id, (config.mirror.name,))
    ports = {str(role): run.links.ports[role] for role in (Role.CAMERA, Role.CONTROLLER)}
    return dataclasses.replace(run, links=dataclasses.replace(run.links, ports=ports))


def _session(run: Run, role: Role) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(run.links, role))))


if __name__ == "__main__":
    run_app(app)
