"""The state of a run in the last seconds, from which the verdict is made."""

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

from lowfc.contract.messages import Log, wire
from lowfc.control.loop.safety import LoopMode, Reason
from lowfc.programs.view.verdicts.steady import Attained

NOW_S = 1.0
"""What is called "now": long enough for an rms of vibrations, short enough to follow a person's hand."""
RECENT_S = 5.0
"""An incident stays visible so long after its last time, so that a person who looks up sees it."""
GRACE_S = 10.0
"""Processes need a few seconds to start; one that has not after this is missed."""

Counts = Counter[Reason | str]


class Liveness(Enum):
    """How a process is, judged by its messages."""

    NEVER = auto()
    STARTING = auto()
    RUNNING = auto()
    STOPPED = auto()
    SILENT = auto()


class Process(NamedTuple):
    """How a process is, and for how long it has sent nothing."""

    life: Liveness = Liveness.NEVER
    silent_s: float = 0.0


_NEVER = Process()


class Rms(NamedTuple):
    """Root mean squares of a wavefront, and of what it would be without the mirror; tilt per axis."""

    residual_nm: float
    open_nm: float
    tilt_residual_nm: float
    tilt_open_nm: float


@dataclass(frozen=True, slots=True)
class RunState:
    """The last seconds of a run.

    Attributes:
        mode: of the loop; None before the first message about it. `why` is the cause of its last change.
        running_s: since the first message. `behind_s` is the delay of the view itself.
        simulated: the frames' times are not this host's.
        period_ns: of the frames; 0 where the camera does not report it. `rate_hz` is that of the frames behind the
            steps; None with less than two of them.
        controller, camera, mirror, recorder: the processes; of several mirrors the one that is worst.
        frame_silent_s, step_silent_s: time without a frame or step, where the frame rate does not explain it.
        recent, now, totals: counts of each reason, of "steps", and of what was "skipped", "missing", "late" or "lost",
            in `RECENT_S`, in `NOW_S` and since the start.
        flux: light on the newest frame, of what the calibration expects; None without both.
        saturated: good pixels at full well in the newest frame.
        wavefront: of the last second; once the controller was stopped, of the last one with a step. `latest` is the
            end of it. They are `true` in a simulation, otherwise measured.
        contrast: what the wavefront adds to the dark zone, true or as measured; None where that is not known.
        attained: what the loop leaves, and what it could leave.
        latency_us: p50 and p99 from frame to command of the same second.
        stroke_nm: largest deviation of an actuator from flat, of `stroke_limit_nm` (0 where it is not known).
        mirror_state, controller_state, recording: the last reports; None before the first.
        noll: modes of the calibration.
        run, host: of the controller; without one, of the process that reported first.
        note: the operator's last one.
    """

    mode: LoopMode | None = None
    why: str = ""
    running_s: float = 0.0
    behind_s: float = 0.0
    simulated: bool = False
    period_ns: int = 0
    rate_hz: float | None = None
    controller: Process = _NEVER
    camera: Process = _NEVER
    mirror: Process = _NEVER
    recorder: Process = _NEVER
    frame_silent_s: float | None = None
    step_silent_s: float | None = None
    recent: Counts = field(default_factory=Counter)
    now: Counts = field(default_factory=Counter)
    totals: Counts = field(default_factory=Counter)
    flux: float | None = None
    saturated: int = 0
    wavefront: Rms | None = None
    latest: Rms | None = None
    true: bool = False
    contrast: wire.WavefrontFigures | None = None
    attained: Attained | None = None
    latency_us: tuple[float, float] | None = None
    stroke_nm: float = 0.0
    stroke_limit_nm: float = 0.0
    mirror_state: wire.MirrorState | None = None
    controller_state: wire.ControllerState | None = None
    recording: wire.Recording | None = None
    noll: tuple[int, ...] = ()
    run: str = ""
    host: str = ""
    note: Log | None = None
