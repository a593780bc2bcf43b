"""What every process of every contestant does alike: its place on the host, its times, its start; needs numpy only.

The times of a run are files of int64, one for each frame, in memory that all processes share, so that a process may be
killed when the last frame is through.
"""

import ctypes
import gc
import json
import mmap
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

_PR_SET_TIMERSLACK = 29
_PLAN = "plan.json"
_GO = "go"
_LOOK_S = 0.02
_LAST_COMMAND_S = 0.05

MARKS = ("due", "published", "commanded", "received", "observed")
"""By frame: when it was due and sent, when its command was out and back, and whether an onlooker got it; ns."""


@dataclass(frozen=True)
class Plan:
    """One run of one contestant.

    Attributes:
        rate_hz: of the frames.
        frames: all that are sent, numbered from 1.
        cpus: processor of each role.
        priority: SCHED_FIFO priority of each role; 0 is the normal class.
        ports: loopback TCP port of each role that listens.
        options: of the contestant.
    """

    rate_hz: float
    frames: int
    cpus: dict[str, int]
    priority: dict[str, int]
    ports: dict[str, int] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Lay out a run in its folder."""
        (folder / _PLAN).write_text(json.dumps(asdict(self)))
        for name in MARKS:
            (folder / name).write_bytes(bytes(8 * (self.frames + 1)))


class Part:
    """A role of a run, in its own process."""

    def __init__(self, role: str, folder: Path) -> None:
        self.role = role
        self.folder = folder
        self.plan = Plan(**json.loads((folder / _PLAN).read_text()))

    @property
    def cpu(self) -> int:
        """Where this process runs."""
        return self.plan.cpus[self.role]

    @property
    def priority(self) -> int:
        """Its SCHED_FIFO priority, or 0."""
        return self.plan.priority[self.role]

    def settle(self) -> None:
        """One processor, the class asked for, sleeps without slack, no garbage collection; for threads to come too."""
        os.sched_setaffinity(0, {self.cpu})
        policy = os.SCHED_FIFO if self.priority else os.SCHED_OTHER
        os.sched_setscheduler(0, policy, os.sched_param(self.priority))
        self.quiet()

    @staticmethod
    def quiet() -> None:
        """Sleeps without slack, no garbage collection."""
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
        gc.freeze()
        gc.disable()

    def marks(self, name: str) -> memoryview:
        """Times of all frames of one kind, to be written at a frame's number; 0 where there is none."""
        with (self.folder / name).open("r+b") as file:
            return memoryview(mmap.mmap(file.fileno(), 0)).cast("q")

    def ready(self) -> None:
        """Say that this process has all it needs."""
        ready_file(self.folder, self.role).touch()

    def frames(self) -> Iterator[int]:
        """Be ready, wait for the start, then yield each frame's number when it is due: absolute times, none left out.

        After the last there is a moment for its command.
        """
        self.ready()
        while not (self.folder / _GO).exists():
            time.sleep(_LOOK_S)
        due = self.marks("due")
        begun_ns, now_ns = time.monotonic_ns(), time.monotonic_ns
        for number in range(1, self.plan.frames + 1):
            due[number] = due_ns = begun_ns + round(number * 1e9 / self.plan.rate_hz)
            while (left_ns := due_ns - now_ns()) > 0:
                time.sleep(left_ns * 1e-9)
            yield number
        time.sleep(_LAST_COMMAND_S)


def ready_file(folder: Path, role: str) -> Path:
    """The file that is there once a role is ready."""
    return folder / f"ready-{role}"


def go(folder: Path) -> None:
    """Start a run."""
    (folder / _GO).touch()
