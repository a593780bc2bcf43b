"""The bench of one chaos case: the real processes, what is done to them, and what is left of it."""

import contextlib
import itertools
import json
import os
import random
import signal
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from google.protobuf.message import DecodeError
from rich.console import Console

from lowfc.adapters.bus import Sample
from lowfc.adapters.child import Child
from lowfc.adapters.clock import HostClock
from lowfc.adapters.run import Run, mirror_role, new_run_id, open_run
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.client import Client
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import HEALTH, STEP, TRUTH, Role, wire
from lowfc.programs.processes import program, start_all
from lowfc.programs.sim_loop import children_of, prepare

_POLL_S = 0.02
_QUIET_FRAMES = 250
_LAST_HEALTH_S = 0.2
SETTLED_FRAMES = 500
"""After a fault: two seconds, of which the last is judged."""
PATIENCE_S = 5.0
"""How long a process may take to end when it is told to."""
START_S = 240.0
WAIT_S = 60.0


class CaseFailedError(LowfcError):
    """What a case waits for does not come."""


@dataclass(slots=True)
class Ended:
    """How a process ended: exit status, negative for a signal, after so long; whether the case meant it to."""

    name: str
    status: int
    after_s: float
    meant: bool


@dataclass(slots=True)
class Left:
    """What is left of a case.

    Attributes:
        folder: with the logs and what the processes said.
        config: of the run.
        marks: when it was quiet and when the fault was, by the host's clock, ns.
        ended: every process.
        alive: processes of the case that live on after its end.
        killed_ns: when each recorder was killed.
        mode: of the loop, at the end.
        lost: what the last recorder says that it lost, by key.
        failure: why it stopped recording, if it did.
        residuals_nm: true residuals of the last second, rms, as they were heard.
        figures: what the case measured.
        notes: what went wrong while it ran.
    """

    folder: Path
    config: Configuration
    marks: dict[str, int] = field(default_factory=dict)
    ended: list[Ended] = field(default_factory=list)
    alive: list[str] = field(default_factory=list)
    killed_ns: list[int] = field(default_factory=list)
    mode: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    failure: str = ""
    residuals_nm: deque[float] = field(default_factory=lambda: deque(maxlen=_QUIET_FRAMES))
    figures: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class ChaosBench:
    """A simulated loop to which things are done."""

    def __init__(self, config: Configuration, folder: Path, rng: random.Random, faults: list[dict[str, Any]]) -> None:
        """Prepare a run in a folder of its own; `faults` befall the camera's frames."""
        self.config = config
        self.folder = folder
        self.rng = rng
        self.left = Left(folder, config)
        self.steps = 0
        self.newest_frame = 0
        self.health: dict[str, wire.Health] = {}
        self.numbers = itertools.count(1)
        self._good = 0
        self._run = open_run(new_run_id(), (config.mirror.name,), listeners=(Role.LAUNCHER,))
        prepare(config, self._run, Console(stderr=True, quiet=True))
        self.children = {child.name: child for child in children_of(config, self._run, None, record=True)}
        if faults:
            file = folder / "faults.json"
            file.write_text(json.dumps(faults))
            self.children[Role.CAMERA].command += ["--faults", str(file)]
        for child in self.children.values():
            child.said = folder / f"{child.name}.stderr"
        self._started: list[Child] = []
        self._ended: list[Child] = []
        self.bus: ZenohBus | None = None

    @property
    def run(self) -> Run:
        """The run."""
        return self._run

    @property
    def mirror(self) -> str:
        """Role of the mirror's process."""
        return mirror_role(self.config.mirror.name)

    def begin(self) -> None:
        """Start the processes, and wait for the loop to run quietly."""
        start_all(list(self.children.values()))
        self._started += self.children.values()
        self.bus = ZenohBus(self._run.links, Role.LAUNCHER, HostClock())
        self.bus.subscribe(HEALTH, self._hear)
        self.bus.subscribe(STEP, self._step)
        self.bus.subscribe(TRUTH, self._truth)
        self.wait(lambda: self.steps > 0, "the first frame", START_S)
        self.settled(_QUIET_FRAMES)
        self.mark("quiet")

    def client(self) -> Client:
        """An operator, on this process's connection."""
        return Client(self._run.run_id, bus=self.bus)

    def mark(self, name: str) -> None:
        """Note when something was."""
        self.left.marks[name] = HostClock().host_ns()

    def frames(self, count: int) -> None:
        """Wait until the controller has made so many more steps."""
        wanted = self.steps + count
        self.wait(lambda: self.steps >= wanted, f"{count} steps")

    def settled(self, frames: int = SETTLED_FRAMES) -> None:
        """Wait until so many frames have been used since the loop was closed."""
        self._good = 0
        self.wait(lambda: self._good >= frames, f"{frames} good frames with the loop closed")

    def wait(self, condition: Callable[[], bool], what: str, timeout_s: float = WAIT_S) -> None:
        """Wait for something.

        Raises:
            CaseFailedError: it did not come.
        """
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() >= deadline_s:
                raise CaseFailedError(f"waited {timeout_s:g} s in vain for {what}")
            time.sleep(_POLL_S)

    def pause(self, shortest_s: float, longest_s: float) -> None:
        """Wait for a random time."""
        time.sleep(self.rng.uniform(shortest_s, longest_s))

    def add(self, name: str, words: list[str]) -> Child:
        """Start one more of our own programs."""
        child = program(name, words, self.folder / f"{name}.stderr")
        self.children[name] = child
        child.start()
        self._started.append(child)
        return child

    def kill(self, name: str) -> None:
        """Kill -9."""
        child = self.children[name]
        assert child.process is not None  # noqa: S101  # it was started
        if name == Role.RECORDER:
            self.left.killed_ns.append(HostClock().host_ns())
        child.process.kill()
        child.process.wait()
        self._note_end(child, 0.0, meant=True)

    def freeze(self, name: str, shortest_s: float, longest_s: float) -> None:
        """SIGSTOP, a random time, SIGCONT."""
        self.signal(name, signal.SIGSTOP)
        try:
            self.pause(shortest_s, longest_s)
        finally:
            self.signal(name, signal.SIGCONT)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process."""
        process = self.children[name].process
        assert process is not None  # noqa: S101  # it was started
        process.send_signal(number)

    def restart(self, name: str, changed: Callable[[list[str]], list[str]] = lambda words: words) -> Child:
        """Start a process that has ended anew, with its command line or a changed one."""
        before = self.children[name]
        child = Child(name, changed([*before.command]), self.folder / f"{name}-{next(self.numbers)}.stderr")
        self.children[name] = child
        self.health.pop(name, None)
        child.start()
        self._started.append(child)
        return child

    def ends(self, name: str, timeout_s: float = WAIT_S) -> int:
        """Wait until a process ends by itself, as the case means it to; return its exit status."""
        child, begun_s = self.children[name], time.monotonic()
        self.wait(lambda: child.status is not None, f"the end of {name}", timeout_s)
        status = child.status or 0
        self._note_end(child, time.monotonic() - begun_s, meant=True)
        return status

    def heard(self, name: str) -> bool:
        """Whether a process that was started anew has said that it is ready."""
        return name in self.health and self.health[name].state in ("ready", "running")

    def end(self) -> Left:
        """Stop everything; what is left can be judged."""
        self.mark("end")
        noted = {id(child) for child in self._ended}
        try:
            order = (Role.CAMERA, Role.CONTROLLER, self.mirror, Role.VIEWER, Role.RECORDER)
            rank = {str(name): number for number, name in enumerate(order)}
            for child in sorted(self._started, key=lambda one: rank.get(one.name, -1)):
                if id(child) not in noted:
                    begun_s, meant = time.monotonic(), child.status is None
                    child.stop(PATIENCE_S)
                    self._note_end(child, time.monotonic() - begun_s, meant=meant)
            for child in self._started:
                child.stop(PATIENCE_S)  # closes what it said to
            time.sleep(_LAST_HEALTH_S)
            last = self.health.get(Role.RECORDER, wire.Health())
            self.left.lost = {count.topic: count.missing for count in last.topics if count.missing}
            self.left.failure = last.recording.failure
        finally:
            if self.bus is not None:
                self.bus.close()
            self.left.alive = _alive({child.process.pid for child in self._started if child.process is not None})
            self._run.remove()
        return self.left

    def _note_end(self, child: Child, after_s: float, *, meant: bool) -> None:
        status = child.status
        self.left.ended.append(Ended(child.name, 0 if status is None else status, after_s, meant))
        self._ended.append(child)

    def _hear(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError):  # some cases send junk
            health = wire.Health.FromString(sample.payload)
            self.health[health.process] = health

    def _step(self, sample: Sample) -> None:
        try:
            step = wire.ControlStep.FromString(sample.payload)
        except DecodeError:
            return
        self.steps += 1
        self.newest_frame = step.frame_sequence
        self.left.mode = step.mode
        if step.mode != wire.LOOP_MODE_CLOSED:
            self._good = 0
        elif step.error_nm:
            self._good += 1

    def _truth(self, sample: Sample) -> None:
        with contextlib.suppress(DecodeError):
            self.left.residuals_nm.append(wire.Truth.FromString(sample.payload).residual_rms_nm)


def _alive(sessions: set[int]) -> list[str]:
    """Processes of these sessions that are there still; each child has a session of its own."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and int(entry.name) != os.getpid():
            try:
                text = (entry / "stat").read_text()
            except OSError:
                continue
            name, _, rest = text.partition("(")[2].rpartition(")")
            fields = rest.split()
            if int(fields[3]) in sessions:
                found.append(f"{name} ({entry.name}, {fields[0]})")
    return found
