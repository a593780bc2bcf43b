"""Fraction of dark-hole steps that the loop undoes: the table of docs/howto/zero_point.md."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lowfc.adapters.bus.run import new_run_id
from lowfc.adapters.logs.history import History, read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.arrays import Array, Mask
from lowfc.client import Client, running
from lowfc.contract.errors import LowfcError
from lowfc.control.loop.command_channels import FLAT

STEPS = 20
SEED = 5  # of the steps
SETTLE = 100
"""Frames waited for after each step."""
WINDOW = 300
"""Frames waited for after the last step, in addition to `SETTLE`, and after the removal of the shape."""
STEPS_COMBINED = 5
"""Number of steps combined into one on the channel that does not shift the zero point. There the loop undoes nearly the
whole step, so fewer steps suffice to measure the fraction."""
SHIFTED, PLAIN = "dark-hole", FLAT
"""Names of two channels: `SHIFTED` shifts the zero point of the loop, `PLAIN` does not."""
GAINS = "[control]\ntilt_gain = 0.5\ngain = 0.05\n"
"""Gains of the loop; the fraction depends on them."""
COMMAND = "lowfc sim-loop --lockstep --rate 1000 --disturbance bench --star-magnitude -2"
PATIENCE_S = 60.0
"""Longest wait for the loop to start, for a frame, and for the processes to end."""


@dataclass(frozen=True)
class ChannelResult:
    """Result of a channel, nm rms of wavefront; the first row of the arrays with steps is before the first step.

    Attributes:
        channel_nm: (1 + steps, modes) modes of the channel's shape as the sensor sees them.
        reaction_nm: (1 + steps, modes) command without the part that cancels the disturbance, at the end of each step.
        residual_nm: (2,) rms of the true residual about its mean, before the first step, and after the last one
            while the shape is applied.
    """

    channel_nm: Array
    reaction_nm: Array
    residual_nm: Array

    def undone(self) -> tuple[float, float]:
        """Fraction of the steps that the loop undoes, by least squares over all steps, and its standard error."""
        steps, reaction = (each - each.mean(axis=0) for each in (self.channel_nm, self.reaction_nm))
        power = float((steps * steps).sum())
        slope = float((steps * reaction).sum()) / power
        noise = float(np.square(reaction - slope * steps).mean())
        return -slope, float(np.sqrt(noise / power))


@dataclass(frozen=True)
class DarkHoleRun:
    """Results of a run: its channels, and the path of its log."""

    channels: dict[str, ChannelResult]
    log: Path


def dark_hole(
    folder: Path, step_rms_nm: float, toml: str = "", base_nm: npt.ArrayLike = 0.0, seed: int | None = None
) -> DarkHoleRun:
    """Apply the steps on one channel, remove them, and do the same on the other channel, in one run of the processes.

    Args:
        folder: Folder of the log.
        step_rms_nm: Rms of each step, nm of surface.
        toml: Configuration in TOML, appended to `GAINS`.
        base_nm: (rows, columns) nm of surface, the configured flat map, to which the steps on channel `flat` are added.
        seed: Seed of the simulation; the configuration's if None.

    Raises:
        LowfcError: The loop did not start, failed, or refused a step.
    """
    (folder / "run.toml").write_text(f"{GAINS}{toml}")
    run, failure = new_run_id(), ""
    command = [sys.executable, "-P", "-m", *COMMAND.split(), "--run", run, "--config", "run.toml", "--json"]
    command += [] if seed is None else ["--seed", str(seed)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=folder, text=True, stdout=pipe, stderr=pipe) as process:  # noqa: S603  # our own
        try:
            deadline_s = time.monotonic() + PATIENCE_S
            while run not in running() and time.monotonic() < deadline_s and process.poll() is None:
                time.sleep(0.05)
            with Client(run) as loop:
                first_frames, channel_modes_nm = apply_steps(loop, step_rms_nm, np.asarray(base_nm))
        except LowfcError as error:
            failure = f"{error}; "
        finally:
            process.send_signal(signal.SIGINT)
            try:
                out, errors = process.communicate(timeout=PATIENCE_S)
            finally:
                process.kill()  # has no effect once the process has ended
    if failure or process.returncode:
        raise LowfcError(f"{failure}output of the loop: {out}{errors}")
    log = folder / json.loads(out)["log"]
    return DarkHoleRun(channel_results(read_history(LogReader(log)), first_frames, channel_modes_nm), log)


def apply_steps(loop: Client, step_rms_nm: float, base_nm: Array) -> tuple[dict[str, list[int]], Array]:
    """Apply the steps on a closed loop.

    Returns:
        The first frame of each step and of the removal, by channel; and the modes (1 + steps, modes) of the shape
        without `base_nm`, as the sensor sees them, nm rms of wavefront: before the first step, then after each step.
    """
    first_frames: dict[str, list[int]] = {}

    def wait(frames: int) -> None:
        for _ in loop.steps(frames, patience_s=PATIENCE_S):
            pass

    wait(2 * WINDOW)
    calibration = loop.calibration()
    sensed = np.asarray(calibration.actuators_to_modes.any(axis=0)).reshape(calibration.grid)
    steps = step_rms_nm * np.random.default_rng(SEED).standard_normal((STEPS, *calibration.grid))
    shapes = np.cumsum(steps * sensed, axis=0)
    for channel, stride, channel_base_nm in ((SHIFTED, 1, 0 * base_nm), (PLAIN, STEPS_COMBINED, base_nm)):
        first_frames[channel] = []
        for shape in shapes[stride - 1 :: stride]:
            first_frames[channel].append(loop.channel(channel, shape + channel_base_nm).frame_sequence)
            wait(SETTLE)
        wait(WINDOW)
        first_frames[channel].append(loop.channel(channel, np.zeros(calibration.grid) + channel_base_nm).frame_sequence)
        wait(WINDOW)
    channel_modes_nm = shapes.reshape(STEPS, -1) @ calibration.actuators_to_modes.T.astype(np.float64)
    return first_frames, np.vstack([np.zeros(channel_modes_nm.shape[1]), channel_modes_nm])


def channel_results(history: History, first_frames: dict[str, list[int]], modes_nm: Array) -> dict[str, ChannelResult]:
    """Results of the channels, from the history of a simulated run and the values that `apply_steps` returned."""
    truths, sequences = history.true, history.steps.sequence
    assert truths is not None  # noqa: S101  # a simulated loop logs the truth
    reaction_nm = history.steps.command_nm + truths.disturbance_nm
    has_truth = np.isfinite(truths.disturbance_nm[:, 0])

    def last_before(end: int, frames: int) -> Mask:
        return np.asarray(has_truth & (sequences < end) & (sequences >= end - frames))

    results = {}
    for name, changed_at in first_frames.items():
        settled = [last_before(end, 3 * SETTLE // 4) for end in changed_at]
        means_nm = np.array([reaction_nm[rows].mean(axis=0, dtype=np.float64) for rows in settled])
        residual_nm = [
            np.sqrt(truths.residual_nm[last_before(end, WINDOW)].var(axis=0, dtype=np.float64).sum())
            for end in (changed_at[0], changed_at[-1])
        ]
        stride = STEPS // (len(changed_at) - 1)
        results[name] = ChannelResult(modes_nm[::stride], means_nm, np.array(residual_nm))
    return results
