"""Shared by the processes of all compared loops: scheduling, time stamps, start, frames and matrices.

A process is started with the arguments ROLE FOLDER RATE_HZ FRAMES PROCESSOR PRIORITY; priority 0 is normal scheduling.
The files of the folder are mapped into memory: they keep what a process wrote when it is killed after the last frame.
This module needs numpy only.
"""

import ctypes
import gc
import mmap
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

Single = npt.NDArray[np.float32]

SIDE, MODES, MIRROR_SIDE = 80, 20, 34
PIXELS, ACTUATORS = SIDE**2, MIRROR_SIDE**2
GAIN, LEAK, LIMIT_NM = 0.3, 0.01, 100.0

TIME_STAMPS = ("due", "published", "commanded", "received")
"""Files of int64 times in ns for each frame: scheduled, sent, its command sent, its command at the mirror."""

LAST = "actuators"
"""File with the actuators that the mirror received last, float32."""

_PR_SET_TIMERSLACK = 29
_GO = "go"
_POLL_S = 0.02
_LAST_COMMAND_S = 0.05


class RoleProcess:
    """A role of a run, in its own process."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self.role, folder, rate_hz, frames, cpu, priority = arguments
        self.folder = Path(folder)
        self.rate_hz, self.count = float(rate_hz), int(frames)
        self.cpu, self.priority = int(cpu), int(priority)

    def set_up_realtime(self) -> None:
        """Set processor, scheduling class, timer slack and garbage collection, for later threads too."""
        os.sched_setaffinity(0, {self.cpu})
        policy = os.SCHED_FIFO if self.priority else os.SCHED_OTHER
        os.sched_setscheduler(0, policy, os.sched_param(self.priority))
        self.reduce_jitter()

    @staticmethod
    def reduce_jitter() -> None:
        """Set the timer slack to 1 ns and switch garbage collection off."""
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
        gc.freeze()
        gc.disable()

    def time_stamps(self, name: str) -> memoryview:
        """Times of one kind, indexed by the frame's number; 0 for none."""
        with (self.folder / name).open("r+b") as file:
            return memoryview(mmap.mmap(file.fileno(), 0)).cast("q")

    def last_actuators(self) -> Single:
        """The last actuators that the mirror received."""
        return np.memmap(self.folder / LAST, np.float32, "r+")

    def ready(self) -> None:
        """Report that this process is ready."""
        ready_file(self.folder, self.role).touch()

    def frame_numbers(self) -> Iterator[int]:
        """Report ready, wait for the start, then yield each frame's number at its absolute time; none is skipped.

        After the last frame it sleeps for 50 ms, so that the last command can arrive.
        """
        self.ready()
        while not (self.folder / _GO).exists():
            time.sleep(_POLL_S)
        due = self.time_stamps("due")
        begun_ns, now_ns = time.monotonic_ns(), time.monotonic_ns
        for number in range(1, self.count + 1):
            due[number] = due_ns = begun_ns + round(number * 1e9 / self.rate_hz)
            while (left_ns := due_ns - now_ns()) > 0:
                time.sleep(left_ns * 1e-9)
            yield number
        time.sleep(_LAST_COMMAND_S)


def ready_file(folder: Path, role: str) -> Path:
    """File that a role creates once it is ready."""
    return folder / f"ready-{role}"


def go(folder: Path) -> None:
    """Start a run."""
    (folder / _GO).touch()


class RunData:
    """The frames of a run, and the matrices that map a frame to actuators; each is a file in the run's folder.

    frames (frames, 80, 80) uint16 and I0 (6400,), dark included: DN; R (20, 6400): nm per DN; to_actuators (1156, 20):
    nm of surface per nm of wavefront.
    """

    def __init__(self, folder: Path) -> None:
        self.frames = np.fromfile(folder / "frames", np.uint16).reshape(-1, SIDE, SIDE)
        self.I0: Single = np.fromfile(folder / "I0", np.float32)
        self.R: Single = np.fromfile(folder / "R", np.float32).reshape(MODES, PIXELS)
        self.to_actuators: Single = np.fromfile(folder / "to_actuators", np.float32).reshape(ACTUATORS, MODES)

    def frame(self, number: int) -> npt.NDArray[np.uint16]:
        """Frame (80, 80) of this number."""
        image: npt.NDArray[np.uint16] = self.frames[number % len(self.frames)]
        return image


class NumpyStep:
    """Computes the bytes of actuators from the bytes of pixels in plain numpy, with preallocated arrays.

    y = R (I - I0); command = (1 - leak) command - gain y, clipped to the limit; actuators = to_actuators x command.
    """

    def __init__(self, run_data: RunData) -> None:
        self._run_data = run_data
        self._difference = np.empty(PIXELS, np.float32)
        self._error = np.empty(MODES, np.float32)
        self._command = np.zeros(MODES, np.float32)
        self._actuators = np.empty(ACTUATORS, np.float32)

    def command(self, payload: bytes) -> bytes:
        """The actuators (float32 bytes) for the pixels of a frame (uint16 bytes)."""
        run_data, command = self._run_data, self._command
        np.subtract(np.frombuffer(payload, np.uint16), run_data.I0, out=self._difference)
        np.matmul(run_data.R, self._difference, out=self._error)
        command *= np.float32(1 - LEAK)
        self._error *= np.float32(GAIN)
        command -= self._error
        np.clip(command, -LIMIT_NM, LIMIT_NM, out=command)
        np.matmul(run_data.to_actuators, command, out=self._actuators)
        return self._actuators.tobytes()
