"""The bench of one chaos case: the real processes, ways to disturb them, and the outcome."""

import contextlib
import itertools
import json
import os
import random
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
from google.protobuf.message import DecodeError
from rich.console import Console

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.run import mirror_role, new_run_id, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.child import Child
from lowfc.adapters.process.clock import HostClock
from lowfc.client import Client
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import HEALTH, STEP, TRUTH, Role, topic_of, wire
from lowfc.programs.launch.processes import program
from lowfc.programs.launch.sim_loop import children_of, prepare

_POLL_S = 0.02
_QUIET_FRAMES = 250  # closed-loop frames before a fault: one second at the default rate
_LAST_HEALTH_S = 0.2  # time for the last Health of the ended processes to arrive
SETTLED_FRAMES = 500
"""Closed-loop frames to wait for after a fault: two seconds at the default rate; the last second is judged."""
PATIENCE_S = 5.0
"""Time that a process may take to exit after the signal to stop."""
START_S = 240.0
"""Longest wait for the first frame."""
WAIT_S = 60.0
"""Longest wait for another condition, unless stated otherwise."""


class CaseFailedError(LowfcError):
    """A case failed, or a wait timed out."""


@dataclass(slots=True)
class ProcessEnd:
    """End of a process.

    Attributes:
        name: name of the process.
        status: exit status; negative for a signal.
        after_s: time from the signal to stop, or from the start of the wait for the end, until the end; 0 after a kill.
        requested: whether the case or the end of the bench stopped it, or the case waited for its end.
    """

    name: str
    status: int
    after_s: float
    requested: bool


@dataclass(slots=True)
class Outcome:
    """Outcome of a case.

    Attributes:
        folder: folder with the logs and the standard error of the processes.
        config: configuration of the loop.
        settled_ns: time at which the loop had settled, host clock; 0 if it did not settle.
        end_ns: time at which the stop of the processes began, host clock.
        ended: processes that ended.
        alive: processes that still exist after the end of the bench.
        killed_ns: times at which a recorder was killed, host clock.
        mode: loop mode of the last step.
        lost: number of messages that the last recorder reports as missing, by key.
        failure: why the recording failed; empty if it did not.
        residuals_nm: true residuals of the last 250 frames, nm rms over the pupil.
        measurements: values measured by the case, for `--json`.
        notes: errors while the case ran.
    """

    folder: Path
    config: Configuration
    settled_ns: int = 0
    end_ns: int = 0
    ended: list[ProcessEnd] = field(default_factory=list)
    alive: list[str] = field(default_factory=list)
    killed_ns: list[int] = field(default_factory=list)
    mode: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    failure: str = ""
    residuals_nm: deque[float] = field(default_factory=lambda: deque(maxlen=_QUIET_FRAMES))
    measurements: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class ChaosBench:
    """A simulated loop with injected faults; `children`: newest process of each name; `health`: its last Health."""

    def __init__(self, config: Configuration, folder: Path, rng: random.Random, fault: dict[str, Any] | None) -> None:
        """Open a run whose logs go to `folder`; `fault`, if any, is injected into the camera's frames."""
        self.config = config
        self.folder = folder
        self.rng = rng
        self.outcome = Outcome(folder, config)
        self.mirror = mirror_role(config.mirror.name)
        self.newest_frame = 0
        self.health: dict[str, wire.Health] = {}
        self._steps = self._closed_frames = 0
        self._numbers = itertools.count(1)
        self.run = open_run(new_run_id(), (config.mirror.name,), listeners=(Role.LAUNCHER,))
        self.children = {child.name: child for child in children_of(config, self.run, None, record=True)}
        if fault is not None:
            file = folder / "fault.json"
            file.write_text(json.dumps(fault))
            self.children[Role.CAMERA].command += ["--fault", str(file)]
        for child in self.children.values():
            child.stderr_path = folder / f"{child.name}.stderr"
        self._started: list[Child] = []
        self._recorded_ends: set[int] = set()
        self.bus: ZenohBus | None = None

    def begin(self) -> None:
        """Write the run's files, start the processes, and wait until the loop has settled."""
        prepare(self.config, self.run, Console(stderr=True, quiet=True))
        self._started += self.children.values()
        for child in self._started:
            child.start()
        self.bus = ZenohBus(self.run.links, Role.LAUNCHER, HostClock())
        for topic in (HEALTH, STEP, TRUTH):
            self.bus.subscribe(topic, self._receive)
        self.wait(lambda: self._steps > 0, "the first frame", START_S)
        self.await_settled(_QUIET_FRAMES)
        self.outcome.settled_ns = HostClock().host_ns()

    def client(self) -> Client:
        """A client in the role of an operator, on this process's connection."""
        return Client(self.run.run_id, bus=self.bus)

    def await_steps(self, count: int) -> None:
        """Wait for this many more steps of the controller."""
        last = self._steps + count
        self.wait(lambda: self._steps >= last, f"{count} steps")

    def await_settled(self, frames: int = SETTLED_FRAMES) -> None:
        """Wait for this many used frames with the loop closed; the count restarts when the loop is not closed."""
        self._closed_frames = 0
        timeout_s = WAIT_S + frames / self.config.camera.rate_hz
        self.wait(lambda: self._closed_frames >= frames, f"{frames} good frames with the loop closed", timeout_s)

    def wait(self, condition: Callable[[], bool], awaited: str, timeout_s: float = WAIT_S) -> None:
        """Wait for a condition; CaseFailedError after the timeout."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() >= deadline_s:
                raise CaseFailedError(f"waited {timeout_s:g} s in vain for {awaited}")
            time.sleep(_POLL_S)

    def pause(self, shortest_s: float, longest_s: float) -> None:
        """Wait for a random time in this range."""
        time.sleep(self.rng.uniform(shortest_s, longest_s))

    def process(self, role: Role) -> str:
        """Name of the process with a role; for the viewer, this call also starts one that writes to a file."""
        if role is Role.VIEWER:
            arguments = ["-m", "lowfc", "view", "--run", self.run.run_id, "--save", str(self.folder / "view.rrd")]
            self._start(program(role, arguments, self.folder / f"{role}.stderr"), ready=True)
        return self.mirror if role is Role.MIRROR else str(role)

    def kill(self, name: str) -> None:
        """Kill a process (kill -9)."""
        child = self.children[name]
        if name == Role.RECORDER:
            self.outcome.killed_ns.append(HostClock().host_ns())
        self.signal(name, signal.SIGKILL)
        self.wait(lambda: child.status is not None, f"the end of {name}")
        self._record_end(child, 0.0, requested=True)

    @contextlib.contextmanager
    def suspended(self, name: str) -> Iterator[None]:
        """Suspend a process (SIGSTOP) within the context; continue it (SIGCONT) at the end of the context."""
        self.signal(name, signal.SIGSTOP)
        try:
            yield
        finally:
            self.signal(name, signal.SIGCONT)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process."""
        process = self.children[name].process
        assert process is not None  # noqa: S101  # it was started
        process.send_signal(number)

    def restart(self, name: str, command: list[str] | None = None, *, ready: bool = True) -> None:
        """Start an ended process again, with the same or another command line; if `ready`, wait until it is ready."""
        stderr = self.folder / f"{name}-{next(self._numbers)}.stderr"
        self._start(Child(name, command or self.children[name].command, stderr), ready=ready)

    def await_end(self, name: str, status: int) -> str:
        """Wait until a process has ended with the expected exit status; return the end of its stderr."""
        child, begun_s = self.children[name], time.monotonic()
        self.wait(lambda: child.status is not None, f"the end of {name}")
        self._record_end(child, time.monotonic() - begun_s, requested=True)
        if child.status != status:
            raise CaseFailedError(f"{name} should have ended with exit status {status}, got {child.status}")
        return child.stderr_tail()

    def end(self, timeout_s: float = PATIENCE_S) -> None:
        """Stop all processes; afterwards the outcome is complete."""
        self.outcome.end_ns = HostClock().host_ns()
        try:
            order = (Role.CAMERA, Role.CONTROLLER, self.mirror, Role.VIEWER, Role.RECORDER)
            rank = {str(name): number for number, name in enumerate(order)}
            for child in sorted(self._started, key=lambda child: rank[child.name]):
                begun_s, running = time.monotonic(), child.status is None
                child.stop(timeout_s)
                self._record_end(child, time.monotonic() - begun_s, requested=running)
            time.sleep(_LAST_HEALTH_S)
            last = self.health.get(Role.RECORDER, wire.Health())
            self.outcome.lost = {count.topic: count.missing for count in last.topics if count.missing}
            self.outcome.failure = last.recording.failure
        finally:
            if self.bus is not None:
                self.bus.close()
            self.outcome.alive = _alive({child.process.pid for child in self._started if child.process is not None})
            self.run.remove()

    def _start(self, child: Child, *, ready: bool) -> None:
        name = child.name
        self.children[name] = child
        self.health.pop(name, None)
        child.start()
        self._started.append(child)
        if ready:
            self.wait(lambda: name in self.health and self.health[name].state in ("ready", "running"), f"a new {name}")

    def _record_end(self, child: Child, after_s: float, *, requested: bool) -> None:
        if id(child) not in self._recorded_ends:
            self._recorded_ends.add(id(child))
            self.outcome.ended.append(ProcessEnd(child.name, child.status or 0, after_s, requested))

    def _receive(self, sample: Sample) -> None:
        """Store a Health or a true residual, or count a step."""
        topic = topic_of(sample.key)
        with contextlib.suppress(DecodeError):  # some cases send invalid messages
            message: Any = topic.message.FromString(sample.payload)
            if topic is HEALTH:
                self.health[message.process] = message
            elif topic is TRUTH:
                self.outcome.residuals_nm.append(message.residual_rms_nm)
            else:
                self._steps += 1
                self.newest_frame, self.outcome.mode = message.frame_sequence, message.mode
                if message.mode != wire.LOOP_MODE_CLOSED:
                    self._closed_frames = 0
                elif message.error_nm:
                    self._closed_frames += 1


def _alive(sessions: set[int]) -> list[str]:
    """Processes of these sessions that still exist; each child has its own session."""
    alive = []
    for process in psutil.process_iter(["name", "status"]):
        with contextlib.suppress(ProcessLookupError):
            if process.pid != os.getpid() and os.getsid(process.pid) in sessions:
                alive.append(f"{process.info['name']} ({process.pid}, {process.info['status']})")
    return alive
