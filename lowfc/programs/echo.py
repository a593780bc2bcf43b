"""A bare zenoh echo, what a loop's latency is set against: a frame out, a command back, and nothing done in between.

Two processes with one plain zenoh session each, over the same links, with the same settings of session, publishers and
scheduling as the loop's. The one that answers then times the control step and the host's timer alone, for it stands
where the controller does.
"""

import dataclasses
import json
import threading
import time
from contextlib import closing
from typing import Annotated

import numpy as np
import numpy.typing as npt
import typer
import zenoh
from zenoh.handlers import Callback

from lowfc.adapters.clock import HostClock
from lowfc.adapters.join import prepare
from lowfc.adapters.realtime import let_send
from lowfc.adapters.run import Run, open_run
from lowfc.adapters.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.adapters.whole_file import being_written
from lowfc.adapters.zenoh_bus import declare_publisher, session_config
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import Envelope
from lowfc.contract.errors import BusError
from lowfc.contract.messages import COMMAND, FRAME, Role
from lowfc.programs.frame_source import ANSWER_S, FRAMES_FILE, Payloads
from lowfc.programs.latency.figures import WARM_UP_S

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
FreeRunning = Annotated[bool, typer.Option("--free-running", help="Without a schedule: the next as soon as possible.")]

app = new_app("A bare zenoh echo.\n\nExample: python -m lowfc.programs.echo ask --run bench --seconds 5")


@app.command()
def ask(
    run: RunId = DEFAULT_RUN, config: ConfigFile = None, seconds: Seconds = 10.0, free_running: FreeRunning = False
) -> None:
    """Send frames at the camera's place, and time each until its answer is there.

    Example: python -m lowfc.programs.echo ask --run bench --seconds 5
    """
    settings = configuration(config)
    joined = _joined(settings, run, Role.CAMERA, settings.realtime.camera_cpus)
    payloads = Payloads(np.load(joined.path / FRAMES_FILE))
    with closing(Asker(settings, joined)) as asker:
        asker.meet()
        asker.run(payloads, seconds, free_running=free_running)
        round_trip_ns = asker.finish()
    with being_written(joined.path / ECHO_FILE) as part, part.open("wb") as file:
        np.savez(file, round_trip_ns=round_trip_ns)


@app.command()
def answer(
    run: RunId = DEFAULT_RUN, config: ConfigFile = None, seconds: Seconds = 10.0, free_running: FreeRunning = False
) -> None:
    """Answer frames at the controller's place until told that there are no more; then time what it does alone.

    Example: python -m lowfc.programs.echo answer --run bench --seconds 5
    """
    from lowfc.adapters import calibration_file
    from lowfc.programs.control_step import ControlStep, time_alone

    settings = configuration(config)
    calibration = calibration_file.load(open_run(run, (settings.mirror.name,)).path / "calibration.fits")
    joined = _joined(settings, run, Role.CONTROLLER, settings.realtime.controller_cpus)
    payloads = Payloads(np.load(joined.path / FRAMES_FILE))
    clock = HostClock()
    step = ControlStep(settings, calibration, clock.host_ns())
    _answer(settings, joined, step(payloads.at(0, clock.host_ns())))
    hot = time_alone(step, payloads, clock, _HOT_S, None)
    alone = hot if free_running else time_alone(step, payloads, clock, seconds, settings.period_ns)
    with being_written(joined.path / ALONE_FILE) as part, part.open("wb") as file:
        np.savez(file, timer_ns=alone.timer_ns, step_ns=alone.step_ns, hot_step_ns=hot.step_ns)


class Asker:
    """Sends frames, hears the answers."""

    def __init__(self, config: Configuration, run: Run) -> None:
        """Open the session."""
        self._period_ns = config.period_ns
        self._clock = HostClock()
        self._put_ns: list[int] = []
        self._round_trip_ns: list[int] = []
        self._answered = threading.Event()
        self._session = _session(run, Role.CAMERA)
        self._publisher = declare_publisher(self._session, FRAME, FRAME.key)
        key = COMMAND.at(config.mirror.name)
        self._subscriber = self._session.declare_subscriber(key, Callback(self._hear, indirect=False))

    def meet(self) -> None:
        """Wait for who answers.

        Raises:
            BusError: nobody came.
        """
        deadline_s = time.monotonic() + _READY_S
        while not self._publisher.matching_status.matching:  # type: ignore[attr-defined]  # not a bool
            if time.monotonic() > deadline_s:
                raise BusError(f"nobody answers the bare echo after {_READY_S:g} s")
            time.sleep(_LOOK_S)
        time.sleep(_SETTLE_S)  # its publisher is there, too

    def run(self, payloads: Payloads, seconds: float, *, free_running: bool) -> None:
        """Send frames for a time, after the warm-up's."""
        clock = self._clock
        due_ns = clock.host_ns()
        end_ns = due_ns + round((WARM_UP_S + seconds) * 1e9)
        while due_ns < end_ns:
            payload = payloads.at(len(self._put_ns), due_ns)
            self._answered.clear()
            clock.sleep_until_ns(due_ns)
            self._round_trip_ns.append(_LOST)
            put_ns = clock.host_ns()
            self._put_ns.append(put_ns)
            self._publisher.put(payload, attachment=Envelope(len(self._put_ns) - 1, put_ns).encode())
            let_send()
            if free_running:
                self._answered.wait(ANSWER_S)
                due_ns = clock.host_ns()
            else:
                due_ns += self._period_ns

    def finish(self) -> npt.NDArray[np.int64]:
        """Tell the other one that this was all; return the round trips after the warm-up, -1 for an answer lost."""
        time.sleep(_SETTLE_S)
        self._session.put(FRAME.key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        put_ns, round_trip_ns = np.array(self._put_ns, np.int64), np.array(self._round_trip_ns, np.int64)
        return np.asarray(round_trip_ns[put_ns >= put_ns[0] + round(WARM_UP_S * 1e9)])

    def close(self) -> None:
        """End the session."""
        self._session.close()  # type: ignore[no-untyped-call]

    def _hear(self, sample: zenoh.Sample) -> None:
        now_ns = self._clock.host_ns()
        assert sample.attachment is not None  # noqa: S101  # our own
        index, put_ns = Envelope.unpack(sample.attachment.to_bytes())
        sample.payload.to_bytes()
        self._round_trip_ns[index] = now_ns - put_ns
        self._answered.set()


def _answer(config: Configuration, run: Run, command: bytes) -> None:
    """Answer every frame with these bytes until an empty one comes."""
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
    prepare(config, role, cpus)
    run = open_run(run_id, (config.mirror.name,))
    ports = {str(role): run.links.ports[role] for role in (Role.CAMERA, Role.CONTROLLER)}
    return dataclasses.replace(run, links=dataclasses.replace(run.links, ports=ports))


def _session(run: Run, role: Role) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(run.links, role))))


def main() -> None:
    """Entry point."""
    run_app(app)


if __name__ == "__main__":
    main()
