"""State of a run in the last seconds, the input of the verdict."""

from collections import Counter
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

from lowfc.contract.messages import Log, wire
from lowfc.control.loop.safety import LoopMode, Reason
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.steady import ResidualComparison

NOW_S = 1.0
"""Length of the span `now`: long enough for the rms of vibrations, short enough to show what an operator changed."""
RECENT_S = 5.0
"""Time for which an incident stays visible, so that an operator notices it."""
PERIODS = 10
"""Minimum length of each time span of the verdict, in frame periods, for slow cameras."""
GRACE_S = 10.0
"""Time for processes to start, after which an absent process is reported."""
OTHER_CLOCK_NS = 3_600_000_000_000
"""Difference from host time above which frame times count as simulated, or as those of another clock."""

Counts = Counter[Reason | str]


class Liveness(Enum):
    """Whether a process runs, judged by its messages."""

    NEVER = auto()  # no message yet
    STARTING = auto()
    RUNNING = auto()
    STOPPED = auto()  # on request
    SILENT = auto()  # no message for 2 s, or ten frame periods if longer: hung or killed


class Process(NamedTuple):
    """Liveness of a process, and the time since its last message."""

    life: Liveness = Liveness.NEVER
    silent_s: float = 0.0


class Rms(NamedTuple):
    """Rms of the residual wavefront and of the wavefront with a flat mirror (`open`); the rms of tilt is per axis."""

    residual_nm: float
    open_nm: float
    tilt_residual_nm: float
    tilt_open_nm: float


@dataclass(frozen=True, slots=True)
class RunState:
    """The last seconds of a run.

    Attributes:
        snapshot: last snapshot.
        mode: loop mode; None before the first message about it. `mode_cause` is the cause of its last change.
        running_s: time since the first message.
        rate_hz: frame rate, from the times of the steps; None with fewer than two steps.
        controller, camera, mirror, recorder: liveness of the processes; with several mirrors that of the worst.
        frame_silent_s, step_silent_s: time without a frame or step; None up to 1 s, or ten frame periods if longer.
        recent, now, totals: counts in `RECENT_S`, in `NOW_S` (both at least `PERIODS` frame periods) and since the
            first snapshot: of each reason; of "steps"; of frames "skipped" by a busy controller, or "missing" as they
            never arrived; of commands "late" for the next exposure; of messages "lost" by the recorder.
        flux: light on the newest frame as a fraction of the calibration's; None without a frame or calibration.
        saturated: number of good pixels at full well in the newest frame.
        wavefront: rms of the last second; once the controller was stopped, of its last second with a step. `latest` is
            the rms of the last 0.3 s. With `true`, both are the simulation's true wavefront, otherwise measured.
        comparison: residual of the loop, and of the best gains.
        latency_us: p50 and p99 of frame to command in the second of `wavefront`; None if not measured.
        mirror_state: last state of the mirror; None before the first.
        note: last note of the operator.
    """

    snapshot: Snapshot
    mode: LoopMode | None
    mode_cause: str
    running_s: float
    rate_hz: float | None
    controller: Process
    camera: Process
    mirror: Process
    recorder: Process
    frame_silent_s: float | None
    step_silent_s: float | None
    recent: Counts
    now: Counts
    totals: Counts
    flux: float | None
    saturated: int
    wavefront: Rms | None
    latest: Rms | None
    true: bool
    comparison: ResidualComparison | None
    latency_us: tuple[float, float] | None
    mirror_state: wire.MirrorState | None
    note: Log | None

    @property
    def lately(self) -> str:
        """The time span of `recent` in words."""
        return f"in the last {max(RECENT_S, PERIODS * self.snapshot.period_ns * 1e-9):g} s"

    @property
    def simulated(self) -> bool:
        """Whether the frame times are not by this host's clock."""
        return abs(self.snapshot.time_ns - self.snapshot.host_ns) > OTHER_CLOCK_NS
