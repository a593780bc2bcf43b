"""The state of a run in the last seconds, from which the verdict is made."""

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

from lowfc.contract.messages import Log, wire
from lowfc.control.loop.safety import LoopMode, Reason
from lowfc.programs.view.snapshot import Accumulator, Snapshot
from lowfc.programs.view.verdicts.steady import Attained

NOW_S = 1.0
"""What is called "now": long enough for an rms of vibrations, short enough to follow a person's hand."""
RECENT_S = 5.0
"""An incident stays visible so long after its last time, so that a person who looks up sees it."""
GRACE_S = 10.0
"""Processes need a few seconds to start; one that has not after this is missed."""
OTHER_CLOCK_NS = 3_600_000_000_000
"""Clocks of one host do not differ by an hour: frame times that do are simulated, or another clock's."""

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
_NOTHING = Accumulator().snapshot(0)


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
        snapshot: the last one.
        mode: of the loop; None before the first message about it. `why` is the cause of its last change.
        running_s: since the first message.
        rate_hz: of the frames behind the steps; None with less than two of them.
        controller, camera, mirror, recorder: the processes; of several mirrors the one that is worst.
        frame_silent_s, step_silent_s: time without a frame or step, where the frame rate does not explain it.
        recent, now, totals: counts of each reason, of "steps", and of what was "skipped", "missing", "late" or "lost",
            in `RECENT_S`, in `NOW_S` and since the start.
        flux: light on the newest frame, of what the calibration expects; None without both.
        saturated: good pixels at full well in the newest frame.
        wavefront: of the last second; once the controller was stopped, of the last one with a step. `latest` is the
            end of it. They are `true` in a simulation, otherwise measured.
        attained: what the loop leaves, and what it could leave.
        latency_us: p50 and p99 from frame to command of the same second.
        mirror_state: the last one; None before the first.
        note: the operator's last one.
    """

    snapshot: Snapshot = _NOTHING
    mode: LoopMode | None = None
    why: str = ""
    running_s: float = 0.0
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
    attained: Attained | None = None
    latency_us: tuple[float, float] | None = None
    mirror_state: wire.MirrorState | None = None
    note: Log | None = None

    @property
    def simulated(self) -> bool:
        """Whether the frames' times are not this host's."""
        return abs(self.snapshot.time_ns - self.snapshot.host_ns) > OTHER_CLOCK_NS
