"""How much of a dark hole's steps the loop undoes: the table of docs/howto/zero_point.md."""

import json
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.progress import track

from lowfc.adapters.logs.history import read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.arrays import Array, Mask
from lowfc.client import Client, running
from lowfc.contract.errors import BusError
from lowfc.control.loop.command_channels import FLAT
from tools.shared import Figures, markdown

STEPS = 20
SEED = 5
SETTLE, WINDOW = 100, 300
"""Frames after each step, and after the last one and the one that takes it all back."""
AT_ONCE = 5
"""Steps that are taken at once where the zero point is not shifted along: what is undone of those is no small thing."""
EACH_NM = (1.0, 2.0, 5.0)
SHIFTED, PLAIN = "dark-hole", FLAT
"""Channels with the sensor's zero point taken along, and without."""
GAINS = "[control]\ntilt_gain = 0.5\ngain = 0.05\n"
"""What the loop would undo depends on its gains."""
COMMAND = "lowfc sim-loop --lockstep --rate 1000 --disturbance bench --star-magnitude -2"
RUN = "dark-hole"
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Channel:
    """What became of a channel; arrays (1 + changes of it, modes), nm rms of wavefront, the first before all changes.

    Attributes:
        seen_nm: what the sensor sees of the channel.
        own_nm: the loop's own command beyond what cancels the disturbance, mean of the last frames of each step.
        left_nm: (2,) rms of the true residual about its mean, before the steps and after them.
    """

    seen_nm: Array
    own_nm: Array
    left_nm: Array

    def undone(self) -> tuple[float, float]:
        """Fraction of the steps that the loop undoes, least squares over all of them, and its standard error."""
        seen, own = self.seen_nm - self.seen_nm.mean(axis=0), self.own_nm - self.own_nm.mean(axis=0)
        power = float((seen * seen).sum())
        slope = float((seen * own).sum()) / power
        noise = float(np.square(own - slope * seen).mean())
        return -slope, float(np.sqrt(noise / power))


@dataclass(frozen=True)
class Night:
    """A run: its channels, and where its log is."""

    channels: dict[str, Channel]
    log: Path


def shapes_nm(grid: tuple[int, int], each_nm: float, usable: Mask | None = None) -> Array:
    """The channel (steps, rows, columns) after each step: every one adds a random shape, nm rms of surface."""
    steps = each_nm * np.random.default_rng(SEED).standard_normal((STEPS, *grid))
    return np.asarray(np.cumsum(steps if usable is None else steps * usable, axis=0))


def dark_hole(folder: Path, each_nm: float, toml: str = "", base_nm: npt.ArrayLike = 0.0) -> Night:
    """Take the steps on one channel, take them back, and take them on the other; all in one run of the processes.

    Args:
        folder: where the log goes.
        each_nm: rms of each step.
        toml: configuration.
        base_nm: (rows, columns) what is on the channel without a zero-point shift all the time.
    """
    (folder / "night.toml").write_text(f"{GAINS}{toml}")
    words = [sys.executable, "-m", *COMMAND.split(), "--run", RUN, "--config", "night.toml", "--json"]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            deadline_s = time.monotonic() + PATIENCE_S
            while RUN not in running() and time.monotonic() < deadline_s and process.poll() is None:
                time.sleep(0.05)
            marks, seen = _asked(each_nm, np.asarray(base_nm))
        except BusError as error:
            process.send_signal(signal.SIGINT)
            raise RuntimeError(f"{error}; the loop said: {process.communicate(timeout=PATIENCE_S)}") from error
        process.send_signal(signal.SIGINT)
        out, complaints = process.communicate(timeout=PATIENCE_S)
    if process.returncode:
        raise RuntimeError(complaints)
    log = folder / json.loads(out)["log"]
    return Night(_channels(log, marks, seen), log)


def _asked(each_nm: float, base_nm: Array) -> tuple[dict[str, list[int]], Array]:
    """First frames of each step of each channel and of its end, and what the sensor sees of the steps."""
    marks: dict[str, list[int]] = {}
    with Client(RUN) as loop:

        def pass_by(frames: int) -> None:
            for _ in loop.steps(frames, patience_s=PATIENCE_S):
                pass

        pass_by(2 * WINDOW)
        calibration = loop.calibration()
        used = np.asarray(calibration.actuators_to_modes.any(axis=0)).reshape(calibration.grid)
        shapes = shapes_nm(calibration.grid, each_nm, used)
        for channel, every, under_nm in ((SHIFTED, 1, 0 * base_nm), (PLAIN, AT_ONCE, base_nm)):
            marks[channel] = []
            for shape in shapes[every - 1 :: every]:
                marks[channel].append(loop.channel(channel, shape + under_nm).frame_sequence)
                pass_by(SETTLE)
            pass_by(WINDOW)
            marks[channel].append(loop.channel(channel, np.zeros(calibration.grid) + under_nm).frame_sequence)
            pass_by(WINDOW)
    seen = shapes.reshape(STEPS, -1) @ calibration.actuators_to_modes.T.astype(np.float64)
    return marks, np.vstack([np.zeros(seen.shape[1]), seen])


def _channels(log: Path, marks: dict[str, list[int]], seen_nm: Array) -> dict[str, Channel]:
    history = read_history(LogReader(log))
    truths = history.true
    if truths is None:
        raise RuntimeError(f"{log} has no truth")
    sequences, command = history.steps.sequence, history.steps.command_nm
    known = np.isfinite(truths.disturbance_nm[:, 0])

    def until(end: int, frames: int) -> Mask:
        return np.asarray(known & (sequences < end) & (sequences >= end - frames))

    found = {}
    for name, changed_at in marks.items():
        ends = [until(end, 3 * SETTLE // 4) for end in changed_at]
        own = np.array([(command[end] + truths.disturbance_nm[end]).mean(axis=0, dtype=np.float64) for end in ends])
        left = [
            np.sqrt(truths.residual_nm[until(end, WINDOW)].var(axis=0, dtype=np.float64).sum())
            for end in (changed_at[0], changed_at[-1])
        ]
        found[name] = Channel(seen_nm[:: STEPS // (len(changed_at) - 1)], own, np.array(left))
    return found


def measure() -> Figures:
    """What is undone of small and of large steps."""
    runs = {}
    for each_nm in track(EACH_NM, "dark holes"):
        with tempfile.TemporaryDirectory() as folder:
            night = dark_hole(Path(folder), each_nm)
        run: Figures = {"together_nm": each_nm * STEPS**0.5}
        for name, channel in night.channels.items():
            undone, error = channel.undone()
            run[name] = {"undone": undone, "error": error, "left_nm": channel.left_nm.tolist()}
            run["seen_nm"] = float(np.linalg.norm(channel.seen_nm[-1]))
        runs[f"{each_nm:g}"] = run
    return {"runs": runs}


def render(figures: Figures) -> str:
    """A line for each size of the steps."""
    head = (
        *("each step, nm rms of surface", "together", "what the sensor sees of it, nm of wavefront", "undone, %"),
        *("undone without the shift, %", "true residual before -> after, nm"),
    )
    rows = [
        (
            each,
            f"{run['together_nm']:.1f}",
            f"{run['seen_nm']:.1f}",
            *(f"{100 * run[name]['undone']:.2f} +- {100 * run[name]['error']:.2f}" for name in (SHIFTED, PLAIN)),
            " -> ".join(f"{left:.2f}" for left in run[SHIFTED]["left_nm"]),
        )
        for each, run in figures["runs"].items()
    ]
    return (
        f"{markdown(head, rows)}\n{STEPS} random steps, {SETTLE} frames apart, each added to those before it. Undone "
        "is how much of what the sensor sees of the channel is found, with the opposite sign, in the loop's own "
        "command beyond what cancels the disturbance, least squares over all steps and modes; with the standard error. "
        "Below zero, the loop adds to them. The true residual is the rms of all modes about their mean, over the "
        "circle, before the first step and after the last."
    )
