"""The history of a run, as columns: what a log says of every step, for reports, exports and what-ifs.

Frames are not in it (read them from the log); everything else that is known of a frame is one row.
"""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lowfc.adapters.log_reader import LogReader
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import Log, wire
from lowfc.contract.published import Published
from lowfc.control.calibration import Calibration

Single = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int64]
Sequences = npt.NDArray[np.uint64]

STAGES = ("transport", "wakeup", "compute", "publish", "frame_to_command")
"""Durations of the controller, as in ControlTiming."""


@dataclass(frozen=True, slots=True)
class Steps:
    """One row for every step, in the order they were recorded; (steps,) or (steps, modes).

    Attributes:
        sequence: of the frame it was made from.
        time_ns: of that frame, nanoseconds since the epoch.
        mode: loop mode, as `LoopMode`.
        reasons: bit `1 << reason` for each reason given.
        error_nm: measured modal error; NaN where the frame was refused. So is pol_nm, pseudo-open-loop.
        command_nm: modal command after the step.
        flux_dn: sum of the good pixels.
    """

    sequence: Sequences
    time_ns: Whole
    mode: npt.NDArray[np.uint8]
    reasons: Whole
    error_nm: Single
    pol_nm: Single
    command_nm: Single
    flux_dn: Single
    saturated_pixels: Whole


@dataclass(frozen=True, slots=True)
class Truths:
    """What the simulation knew, one row per frame; empty for a log of real devices."""

    sequence: Sequences
    time_ns: Whole
    disturbance_nm: Single
    residual_nm: Single
    disturbance_rms_nm: Single
    residual_rms_nm: Single


@dataclass(frozen=True, slots=True)
class MirrorStates:
    """One row for every state of the mirror.

    Attributes:
        sequence: of the frame behind the command applied.
        publish_time_ns: when the mirror said that it was there.
        stroke_nm: largest deviation of an actuator from flat.
        limits: bit `1 << reason` for each of the mirror's own limits that acted.
        highest_nm, lowest_nm: (rows, columns) extremes of each actuator over the run.
    """

    sequence: Sequences
    publish_time_ns: Whole
    stroke_nm: Single
    limits: Whole
    highest_nm: Single
    lowest_nm: Single


@dataclass(frozen=True, slots=True)
class History:
    """Everything a log says of a run, but the frames.

    Attributes:
        log: the reader, read to its end: metadata, attachments, whether the log is complete.
        configuration: that the log was recorded with; None without one that can be read.
        remarks: what of that this version cannot use, a sentence each that names the log.
        controllers: states of the controllers, in order.
        frame_sequence, frame_publish_ns: of every frame in the log.
        command_publish_ns: of every mirror command in the log.
        stages_ns: (timed steps,) each of `STAGES`, for the frames of `timed_sequence`.
        left_out: steps of another number of modes than the last calibration's, or with impossible values.
        requests: what operators asked, with the answers.
        events: (log time ns, message).
        health: the last of each process.
        counts: messages by topic key.
        published: laws and tables that were played, by identity.
        span_ns: log times of the first and the last message; (0, 0) for none.
    """

    log: LogReader
    configuration: Configuration | None
    calibration: Calibration | None
    controllers: list[wire.ControllerState]
    camera: wire.CameraState | None
    frame_sequence: Sequences
    frame_publish_ns: Whole
    command_publish_ns: Whole
    steps: Steps
    truths: Truths
    mirror: MirrorStates
    timed_sequence: Sequences
    stages_ns: dict[str, Whole]
    left_out: int
    requests: list[wire.Request]
    events: list[tuple[int, Log]]
    health: dict[str, wire.Health]
    counts: Counter[str]
    span_ns: tuple[int, int]
    published: Published = field(default_factory=Published)
    remarks: list[str] = field(default_factory=list)

    @property
    def controller(self) -> wire.ControllerState | None:
        """The controller's last state; None without one."""
        return self.controllers[-1] if self.controllers else None

    @property
    def rate_hz(self) -> float:
        """See `frame_rate_hz`."""
        return frame_rate_hz(self.camera, self.steps)


def frame_rate_hz(camera: wire.CameraState | None, steps: Steps) -> float:
    """Frame rate: the camera's period where it is known, the median interval of the steps otherwise; 0 for none."""
    if camera is not None and camera.period_ns:
        return 1e9 / camera.period_ns
    intervals_ns = np.diff(steps.time_ns)
    median_ns = float(np.median(intervals_ns)) if intervals_ns.size else 0.0
    return 1e9 / median_ns if median_ns > 0 else 0.0


def rows_of(sequence: Sequences, among: Sequences) -> Whole:
    """Row in `among` of each sequence, the first one where there are several; -1 where there is none."""
    if not among.size:
        return np.full(sequence.shape, -1, np.int64)
    order = np.argsort(among, kind="stable")
    places = np.minimum(np.searchsorted(among, sequence, sorter=order), among.size - 1)
    rows = order[places]
    return np.where(among[rows] == sequence, rows, -1).astype(np.int64)
