"""What every process of every contestant does alike: its place on the host, its times, its start, its problem.

It needs numpy only. The times of a run are files of int64, one for each frame, in memory that all processes share, so
that a process may be killed when the last frame is through.
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

import numpy as np
import numpy.typing as npt

Single = npt.NDArray[np.float32]

SHAPE = (80, 80)
MODES = 20
GRID = (12, 12)
ACTUATORS = GRID[0] * GRID[1]
GAIN, LEAK, LIMIT_NM = 0.3, 0.01, 100.0
DIFFERENT = 16  # frames, sent in turn

_DARK_DN, _PEAK_DN = 100.0, 400.0
_ERROR_NM = 2.0

_PR_SET_TIMERSLACK = 29
_PLAN = "plan.json"
_GO = "go"
_LOOK_S = 0.02
_LAST_COMMAND_S = 0.05

MARKS = ("due", "published", "commanded", "received")
"""Times of each frame, ns: when it was due and sent, and when its command was out and back."""


@dataclass(frozen=True)
class Plan:
    """One run of one contestant.

    Attributes:
        rate_hz: of the frames.
        frames: all that are sent, numbered from 1.
        cpus: processor of each role.
        priority: SCHED_FIFO priority of each role; 0 is the normal class.
        ports: loopback TCP port of each role that listens.
    """

    rate_hz: float
    frames: int
    cpus: dict[str, int]
    priority: dict[str, int]
    ports: dict[str, int] = field(default_factory=dict)

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


class Problem:
    """Frames, and the matrices that make actuators of them.

    Attributes:
        frames: (DIFFERENT, 80, 80) uint16, DN.
        I0: (6400,) float32, DN, dark included.
        R: (20, 6400) float32, nm per DN, scaled so that the noise of a frame is some nm in every mode.
        to_actuators: (144, 20) float32, nm of surface per nm of wavefront.
    """

    def __init__(self, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        pixels = SHAPE[0] * SHAPE[1]
        image = _DARK_DN + _PEAK_DN * rng.random(pixels)
        self.frames = rng.poisson(image, (DIFFERENT, pixels)).astype(np.uint16).reshape(DIFFERENT, *SHAPE)
        self.I0: Single = image.astype(np.float32)
        R = rng.standard_normal((MODES, pixels))
        self.R: Single = (R * _ERROR_NM / np.sqrt((R**2) @ image)[:, None]).astype(np.float32)
        self.to_actuators: Single = (rng.standard_normal((ACTUATORS, MODES)) / MODES).astype(np.float32)


class NumpyStep:
    """Bytes of pixels to bytes of actuators, as one would write it in numpy, into arrays that stay.

    y = R (I - I0); command = (1 - leak) command - gain y, cut to the limit; actuators of the command.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._difference = np.empty(SHAPE[0] * SHAPE[1], np.float32)
        self._error = np.empty(MODES, np.float32)
        self._command = np.zeros(MODES, np.float32)
        self._actuators = np.empty(ACTUATORS, np.float32)

    def command(self, payload: bytes) -> bytes:
        """The answer to a frame."""
        problem, command = self._problem, self._command
        np.subtract(np.frombuffer(payload, np.uint16), problem.I0, out=self._difference)
        np.matmul(problem.R, self._difference, out=self._error)
        command *= np.float32(1 - LEAK)
        self._error *= np.float32(GAIN)
        command -= self._error
        np.clip(command, -LIMIT_NM, LIMIT_NM, out=command)
        np.matmul(problem.to_actuators, command, out=self._actuators)
        return self._actuators.tobytes()
