"""What the verdict knows of a run: sums over the last seconds, which processes are alive, the last of each state."""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.logs.columns import count_reasons
from lowfc.arrays import Array, Long, Sequences, Single
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import (
    CONTROLLER_STATE,
    FRAME,
    MIRROR_STATE,
    STEP,
    Log,
    Role,
    Topic,
    from_timestamp,
    wire,
)
from lowfc.contract.printable import printable
from lowfc.control.loop.estimator import saturated_pixels
from lowfc.control.loop.safety import LoopMode, Reason
from lowfc.programs.launch.watch import topic_count
from lowfc.programs.view.snapshot import Accumulator, Snapshot
from lowfc.programs.view.verdicts.steady import Attainable

NOW_S = 1.0
"""What is called "now": long enough for an rms of vibrations, short enough to follow a person's hand."""
RECENT_S = 5.0
"""What has happened stays visible so long after its last time, so that a person who looks up sees it."""
SILENT_S = 2.0
"""A process sends Health twice a second; four of them do not get lost by chance."""
FRAMES_SILENT_S = 1.0
"""Without a frame for so long, and for `PERIODS` of its own, a camera is not merely slow."""
PERIODS = 10
"""Frames of a slow camera that "now" holds."""
OTHER_CLOCK_NS = 3_600_000_000_000
"""Clocks of one host do not differ by an hour: frame times that do are simulated, or another clock's."""
GRACE_S = 10.0
"""Processes need a few seconds to start; one that has not after this is missed."""
_SAMPLES = 1000
_MODES: dict[int, LoopMode] = {mode.value: mode for mode in LoopMode}
_COUNTED: dict[str, tuple[Role, Callable[[wire.Health], int]]] = {
    "skipped": (Role.CONTROLLER, lambda health: topic_count(health, FRAME.key).skipped),
    "missing": (Role.CONTROLLER, lambda health: topic_count(health, FRAME.key).missing),
    "late": (Role.CAMERA, lambda health: health.commands_late),
    "lost": (Role.RECORDER, lambda health: health.recording.lost),
}
"""What processes count, and where it is in their Health."""

_TOPICS = {Role.CONTROLLER: (STEP, CONTROLLER_STATE), Role.CAMERA: (FRAME,)}
"""Topics that are signs of life, too."""

Counts = Counter[Reason | str]


class Liveness(Enum):
    """How a process is, judged by its messages."""

    NEVER = auto()
    STARTING = auto()
    RUNNING = auto()
    STOPPED = auto()
    SILENT = auto()


class LivenessReport(NamedTuple):
    """How a process is, and for how long it has sent nothing."""

    life: Liveness
    silent_s: float


class Rms(NamedTuple):
    """Root mean squares of a wavefront, and of what it would be without the mirror; tilt per axis."""

    residual_nm: float
    open_nm: float
    tilt_residual_nm: float
    tilt_open_nm: float


class _Sample(NamedTuple):
    """What one snapshot brought; of `truth` and `measured` a count and the sums of squares of `Rms`."""

    host_ns: int
    counts: Counts
    truth: Array
    measured: Array
    sequence: Sequences
    time_ns: Long
    durations_ns: Long


class Watcher:
    """Is fed with snapshots; answers for the last seconds.

    Attributes:
        snapshot: the last one.
        mode: of the loop; None before the first message about it.
        why: of the last change of mode.
        flux: light on the newest frame, of what the calibration expects; None without both.
        saturated: good pixels at full well in the newest frame.
        mirror: its last state.
        note: the operator's last one; None before the first.
        totals: of everything that `recent` counts, since the first snapshot.
        attainable: what the loop could leave.
        begun_ns: host time of the first snapshot with a message.
    """

    def __init__(self) -> None:
        self.snapshot: Snapshot = Accumulator().snapshot(0)
        self.mode: LoopMode | None = None
        self.why = ""
        self.flux: float | None = None
        self.saturated = 0
        self.mirror: wire.MirrorState | None = None
        self.begun_ns = 0
        self.note: Log | None = None
        self.totals: Counts = Counter()
        self.attainable = Attainable()
        self._why_ns = 0
        self._samples: deque[_Sample] = deque(maxlen=_SAMPLES)
        self._sums: dict[float, Counts] = {}
        self._counted: dict[str, tuple[int, int]] = {}
        self._reported: dict[str, object] = {}
        self._last_worked: list[_Sample] = []

    def feed(self, snapshot: Snapshot) -> None:
        """Take what is new."""
        self.snapshot = snapshot
        self._sums.clear()
        if not self.begun_ns and snapshot.sent_ns:
            self.begun_ns = snapshot.host_ns
        self._update_mode(snapshot)
        self._update_events(snapshot.events)
        self._update_light(snapshot)
        self.attainable.feed(snapshot)
        self.mirror = snapshot.mirror or self.mirror
        sample = self._sample(snapshot)
        self._samples.append(sample)
        self.totals.update(sample.counts)
        while self._samples[0].host_ns < snapshot.host_ns - RECENT_S * 1e9 - PERIODS * self.period_ns:
            self._samples.popleft()
        if snapshot.steps.mode.size:
            self._last_worked = self._last(NOW_S)

    @property
    def period_ns(self) -> int:
        """Of the frames; 0 where the camera does not report it."""
        return self.snapshot.camera.period_ns if self.snapshot.camera is not None else 0

    @property
    def simulated(self) -> bool:
        """Whether the frames' times are not this host's."""
        return abs(self.snapshot.time_ns - self.snapshot.host_ns) > OTHER_CLOCK_NS

    @property
    def running_s(self) -> float:
        """Time since the first message."""
        return (self.snapshot.host_ns - self.begun_ns) * 1e-9 if self.begun_ns else 0.0

    def run_and_host(self) -> tuple[str, str]:
        """Name of the run, and the host of its controller or, without one, of the process that reported first."""
        if self.snapshot.ended is not None:
            return self.snapshot.ended.run, self.snapshot.ended.host
        reported = {name: one.health for name, one in self.snapshot.health.items() if name != Role.VIEWER}
        health = reported.get(Role.CONTROLLER) or next(iter(reported.values()), wire.Health())
        return printable(health.run_id), printable(health.host)

    def recent(self, what: Reason | str) -> int:
        """How often a reason was given lately; or "steps", or what was "skipped", "missing", "late" or "lost"."""
        return self._total(RECENT_S)[what]

    def now(self, what: Reason | str) -> int:
        """The same for the last second."""
        return self._total(NOW_S)[what]

    def wavefront(self, span_s: float = NOW_S, *, ended: bool = False) -> tuple[Rms | None, bool]:
        """Of the last second, or the last with a step in it, and whether it is the truth; None without any."""
        samples = self._last_worked if ended else self._last(span_s)
        for true in (True, False):
            total: Array = sum((one.truth if true else one.measured for one in samples), np.zeros(5))
            if total[0]:
                return Rms(*np.sqrt(total[1:] / total[0]).tolist()), true
        return None, False

    def rate_hz(self) -> float | None:
        """Rate of the frames behind the steps, by their own times; None with less than two since it started."""
        worked = [one for one in self._last(NOW_S) if one.sequence.size]
        last = int(worked[-1].sequence[-1]) if worked else 0
        first = next((one for one in worked if start_of(int(one.sequence[0])) == start_of(last)), None)
        if first is None:
            return None
        frames, elapsed_ns = last - int(first.sequence[0]), int(worked[-1].time_ns[-1] - first.time_ns[0])
        return frames * 1e9 / elapsed_ns if elapsed_ns > 0 and frames > 0 else None

    def durations_us(self, *, ended: bool = False) -> tuple[float, float] | None:
        """p50 and p99 of frame to command in the last second, or the last with a step in it; None without any."""
        samples = self._last_worked if ended else self._last(NOW_S)
        every = np.concatenate([np.zeros(0), *(one.durations_ns for one in samples)])
        return (float(np.median(every)) / 1e3, float(np.percentile(every, 99)) / 1e3) if every.size else None

    def stroke_nm(self) -> float:
        """Largest deviation of an actuator from flat in the mirror's last state; 0 without one."""
        surface_nm = actuators(self.mirror) if self.mirror is not None else None
        return float(np.abs(surface_nm).max(initial=0.0)) if surface_nm is not None else 0.0

    def messages_lost(self) -> int:
        """By the recorder, as it reported last."""
        last = self.snapshot.health.get(Role.RECORDER)
        return last.health.recording.lost if last is not None else 0

    def process(self, role: Role) -> LivenessReport:
        """Of the controller, camera or recorder; a camera of the user's own may send frames and nothing else."""
        return self._liveness((role,), *_TOPICS.get(role, ()))

    def mirrors(self) -> LivenessReport:
        """Of the mirror; where there are several, of the one silent longest, and of a stopped one only if all are."""
        names = [name for name in self.snapshot.health if name.startswith(mirror_role(""))]
        if len(names) > 1:
            return max(
                (self._liveness((name,)) for name in names),
                key=lambda one: (one.life is Liveness.SILENT, one.life is not Liveness.STOPPED, one.silent_s),
            )
        return self._liveness(names, MIRROR_STATE)

    def silent_s(self, topic: Topic) -> float | None:
        """Time without a message that comes with every frame, where it is longer than this rate explains; else None."""
        if not self.begun_ns:
            return None
        sent_ns = self.snapshot.sent_ns  # a step stands for its frame, which a log need not have
        silent_s = self._since_s(max(sent_ns.get(topic, self.begun_ns), sent_ns.get(STEP, 0)))
        return silent_s if silent_s > max(FRAMES_SILENT_S, PERIODS * self.period_ns * 1e-9) else None

    def _total(self, span_s: float) -> Counts:
        if span_s not in self._sums:
            total: Counts = Counter()
            for one in self._last(span_s):
                total.update(one.counts)
            self._sums[span_s] = total
        return self._sums[span_s]

    def _last(self, span_s: float) -> list[_Sample]:
        begin_ns = self.snapshot.host_ns - max(span_s * 1e9, PERIODS * self.period_ns)
        return [one for one in self._samples if one.host_ns > begin_ns]

    def _liveness(self, names: Iterable[str], *topics: Topic) -> LivenessReport:
        last = next((self.snapshot.health[name] for name in names if name in self.snapshot.health), None)
        sent_ns = max((self.snapshot.sent_ns.get(topic, 0) for topic in topics), default=0)
        last_ns = max(sent_ns, last.time_ns if last is not None else 0)
        if not last_ns:
            return LivenessReport(Liveness.NEVER, 0.0)
        silent_s = self._since_s(last_ns)
        state = last.health.state if last is not None and last.time_ns >= sent_ns else "running"
        if state in ("stopping", "stopped"):
            return LivenessReport(Liveness.STOPPED, silent_s)
        if silent_s > max(SILENT_S, PERIODS * self.period_ns * 1e-9):
            return LivenessReport(Liveness.SILENT, silent_s)
        return LivenessReport(Liveness.STARTING if state in ("starting", "ready") else Liveness.RUNNING, silent_s)

    def _since_s(self, time_ns: int) -> float:
        """Silence, without what this view is late itself."""
        return max(0.0, (self.snapshot.host_ns - time_ns) * 1e-9 - self.snapshot.behind_s)

    def _update_mode(self, snapshot: Snapshot) -> None:
        """Take the mode of the newest message about it: a step, or a state or Health that is new."""
        last = snapshot.health.get(Role.CONTROLLER)
        for name, report in (("health", last and last.health), ("state", snapshot.controller)):
            if report is not None and report is not self._reported.get(name):
                self.mode = _MODES.get(report.mode, self.mode)
            self._reported[name] = report
        if snapshot.steps.mode.size:
            self.mode = _MODES.get(int(snapshot.steps.mode[-1]), self.mode)

    def _update_events(self, events: Iterable[Log]) -> None:
        """Keep the newest note and cause: events from before a view began come after those that it received itself."""
        for event in events:
            time_ns = from_timestamp(event.timestamp)
            if event.message.startswith("MODE_CHANGED") and time_ns >= self._why_ns:
                self.why, self._why_ns = printable(event.message.partition(": ")[2]), time_ns
            newest_ns = from_timestamp(self.note.timestamp) if self.note is not None else 0
            if event.message.startswith("NOTE ") and time_ns >= newest_ns:
                self.note = event

    def _update_light(self, snapshot: Snapshot) -> None:
        calibration, frame = snapshot.calibration, snapshot.frame
        if frame is None or calibration is None:
            return
        if frame.shape != calibration.shape:
            self.flux = None
            return
        pixels = frame.reshape(-1)
        self.flux = float((pixels - calibration.dark) @ calibration.good) / calibration.flux_dn
        self.saturated = saturated_pixels(calibration, pixels)

    def _sample(self, snapshot: Snapshot) -> _Sample:
        steps, truths = snapshot.steps, snapshot.truths
        used = np.isfinite(steps.error_nm).all(axis=1) & (steps.error_nm.shape[1] > 0)
        error_nm, pol_nm = steps.error_nm[used], steps.pol_nm[used]
        truth = _squares(
            snapshot, truths.residual_nm, truths.disturbance_nm, truths.residual_rms_nm, truths.disturbance_rms_nm
        )
        counts = Counts(count_reasons(steps.reasons))
        counts.update(steps=len(steps.mode), **self._grown(snapshot))
        durations_ns = snapshot.timings["frame_to_command"]
        measured = _squares(snapshot, error_nm, pol_nm, error_nm, pol_nm)
        return _Sample(snapshot.host_ns, counts, truth, measured, steps.sequence, steps.time_ns, durations_ns)

    def _grown(self, snapshot: Snapshot) -> dict[str, int]:
        """By how much what the processes count has grown since the last snapshot; a restarted one begins anew."""
        grown: dict[str, int] = {}
        for name, (role, count_in) in _COUNTED.items():
            last = snapshot.health.get(role)
            if last is None:
                continue
            count = count_in(last.health)
            pid, before = self._counted.get(name, (last.health.pid, count))
            if pid == last.health.pid and count > before:
                grown[name] = count - before
            self._counted[name] = (last.health.pid, count)
        return grown


def _squares(
    snapshot: Snapshot, residual_modes_nm: Single, open_modes_nm: Single, residual_nm: Single, open_nm: Single
) -> Array:
    """Count of rows, and the sums of squares of `Rms`; tip and tilt where the calibration is for so many modes."""
    noll = snapshot.calibration.noll if snapshot.calibration is not None else ()
    tilts = [column for column, index in enumerate(noll) if index in (2, 3)]
    if len(noll) != residual_modes_nm.shape[1]:
        tilts = []
    tilt_nm = [modes_nm[:, tilts] for modes_nm in (residual_modes_nm, open_modes_nm)]
    sums = [np.square(one, dtype=np.float64).sum() for one in (residual_nm, open_nm, *tilt_nm)]
    return np.array([len(residual_nm), *sums[:2], *(one / max(1, len(tilts)) for one in sums[2:])])
