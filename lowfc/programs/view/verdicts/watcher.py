"""State of a run, derived from snapshots of its messages."""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.logs.columns import count_reasons, frame_rate_hz
from lowfc.arrays import Array, Long, Sequences
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import CONTROLLER_STATE, FRAME, MIRROR_STATE, STEP, Log, Role, Topic, from_timestamp, wire
from lowfc.contract.printable import printable
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.control.loop.estimator import saturated_pixels
from lowfc.control.loop.safety import LoopMode
from lowfc.programs.launch.watch import topic_count
from lowfc.programs.view.snapshot import Accumulator, Snapshot, Wavefronts
from lowfc.programs.view.verdicts.run_state import NOW_S, PERIODS, RECENT_S, Counts, Liveness, Process, Rms, RunState
from lowfc.programs.view.verdicts.steady import ResidualComparison, SteadyFrames, compare_with_best_gains

LATEST_S = 0.3
"""Length of the interval, up to the last snapshot, over which `latest` is computed; it is short, to show the
improvement of a loop that has just closed or recovered."""
SILENT_S = 2.0
"""Time without a message after which a process counts as silent: four Healths, which are sent twice a second."""
FRAMES_SILENT_S = 1.0
"""Time without frames or steps after which they are reported as missing, but at least `PERIODS` frame periods."""
COMPARISON_PERIOD_NS = 30_000_000_000
"""Time between two computations of the best gains, which take 0.3 s for 14 modes."""
_SAMPLES = 1000  # largest number of samples kept
_MODES: dict[int, LoopMode] = {mode.value: mode for mode in LoopMode}
_COUNTERS: dict[str, tuple[Role, Callable[[wire.Health], int]]] = {
    "skipped": (Role.CONTROLLER, lambda health: topic_count(health, FRAME.key).skipped),
    "missing": (Role.CONTROLLER, lambda health: topic_count(health, FRAME.key).missing),
    "late": (Role.CAMERA, lambda health: health.commands_late),
    "lost": (Role.RECORDER, lambda health: health.recording.lost),
}
"""For each count: the process that reports it, and how it is read from that process's Health."""


class _Sample(NamedTuple):
    """Rows and counts of a snapshot.

    Attributes:
        squares: for the true and for the measured wavefront, the number of rows and the sum of squares of each field of
            `Rms`.
    """

    host_ns: int
    counts: Counts
    squares: tuple[Array, Array]
    sequence: Sequences
    time_ns: Long
    durations_ns: Long


class Watcher:
    """Derives the state of a run from its snapshots."""

    def __init__(self) -> None:
        self._snapshot: Snapshot = Accumulator().snapshot(0)
        self._mode: LoopMode | None = None
        self._cause, self._cause_ns = "", 0
        self._flux: float | None = None
        self._saturated = 0
        self._mirror: wire.MirrorState | None = None
        self._begun_ns = 0
        self._note: Log | None = None
        self._totals: Counts = Counter()
        self._steady, self._compared_ns = SteadyFrames(), 0
        self._comparison: ResidualComparison | None = None
        self._samples: deque[_Sample] = deque(maxlen=_SAMPLES)
        self._last_counts: dict[str, tuple[int, int]] = {}
        self._last_active: list[_Sample] = []

    def feed(self, snapshot: Snapshot) -> None:
        """Add a snapshot."""
        self._snapshot = snapshot
        if not self._begun_ns and snapshot.sent_ns:
            self._begun_ns = snapshot.host_ns
        self._update_mode(snapshot)
        self._update_events(snapshot.events)
        self._update_light(snapshot)
        self._update_comparison(snapshot)
        self._mirror = snapshot.mirror or self._mirror
        self._samples.append(self._sample(snapshot))
        self._totals.update(self._samples[-1].counts)
        while self._samples[0].host_ns < snapshot.host_ns - RECENT_S * 1e9 - PERIODS * self._snapshot.period_ns:
            self._samples.popleft()
        if snapshot.steps.mode.size:
            self._last_active = self._last_samples(NOW_S)

    def state(self) -> RunState:
        """State of the run at the last snapshot."""
        snapshot, now = self._snapshot, self._last_samples(NOW_S)
        controller = self._process((Role.CONTROLLER,), STEP, CONTROLLER_STATE)
        stopped = controller.life is Liveness.STOPPED
        wavefront, true = _rms(now)
        if wavefront is None and stopped:
            wavefront, true = _rms(self._last_active)
        active, reported = self._last_active if stopped else now, snapshot.controller
        cause = printable(reported.mode_cause) if reported and _MODES.get(int(reported.mode)) is self._mode else ""
        durations_us = np.concatenate([np.zeros(0), *(one.durations_ns / 1e3 for one in active)])
        return RunState(
            snapshot=snapshot,
            mode=self._mode,
            mode_cause=cause or self._cause,  # the cause may have changed without an event, or before this view
            running_s=(snapshot.host_ns - self._begun_ns) * 1e-9 if self._begun_ns else 0.0,
            rate_hz=_rate_hz(now),
            controller=controller,
            camera=self._process((Role.CAMERA,), FRAME),  # a user's own camera may send nothing else
            mirror=self._worst_mirror(),
            recorder=self._process((Role.RECORDER,)),
            frame_silent_s=self._silent_s(FRAME),
            step_silent_s=self._silent_s(STEP),
            recent=sum((one.counts for one in self._last_samples(RECENT_S)), Counts()),
            now=sum((one.counts for one in now), Counts()),
            totals=self._totals,
            flux=self._flux,
            saturated=self._saturated,
            wavefront=wavefront,
            latest=_rms(self._last_samples(LATEST_S))[0],
            true=true,
            comparison=self._comparison,
            latency_us=tuple(np.percentile(durations_us, [50, 99]).tolist()) if durations_us.size else None,
            mirror_state=self._mirror,
            note=self._note,
        )

    def _last_samples(self, span_s: float) -> list[_Sample]:
        begin_ns = self._snapshot.host_ns - max(span_s * 1e9, PERIODS * self._snapshot.period_ns)
        return [one for one in self._samples if one.host_ns > begin_ns]

    def _worst_mirror(self) -> Process:
        """The mirror whose last message is oldest, silent ones first; a stopped mirror only if all are stopped."""
        names = [name for name in self._snapshot.health if name.startswith(mirror_role(""))]
        if len(names) <= 1:
            return self._process(names, MIRROR_STATE)
        return max(
            (self._process((name,)) for name in names),
            key=lambda one: (one.life is Liveness.SILENT, one.life is not Liveness.STOPPED, one.silent_s),
        )

    def _process(self, names: Iterable[str], *topics: Topic) -> Process:
        """Liveness of the first of these processes that sent Health, by its Health or by these topics."""
        last = next((self._snapshot.health[name] for name in names if name in self._snapshot.health), None)
        sent_ns = max((self._snapshot.sent_ns.get(topic, 0) for topic in topics), default=0)
        last_ns = max(sent_ns, last.time_ns if last is not None else 0)
        if not last_ns:
            return Process()
        silent_s = self._since_s(last_ns)
        state = last.health.state if last is not None and last.time_ns >= sent_ns else "running"
        if state in ("stopping", "stopped"):
            return Process(Liveness.STOPPED, silent_s)
        if silent_s > max(SILENT_S, PERIODS * self._snapshot.period_ns * 1e-9):
            return Process(Liveness.SILENT, silent_s)
        return Process(Liveness.STARTING if state in ("starting", "ready") else Liveness.RUNNING, silent_s)

    def _silent_s(self, topic: Topic) -> float | None:
        if not self._begun_ns:
            return None
        sent_ns = self._snapshot.sent_ns  # a step implies a frame, and a log may have no frames
        silent_s = self._since_s(max(sent_ns.get(topic, self._begun_ns), sent_ns.get(STEP, 0)))
        return silent_s if silent_s > max(FRAMES_SILENT_S, PERIODS * self._snapshot.period_ns * 1e-9) else None

    def _since_s(self, time_ns: int) -> float:
        """Time since `time_ns`, minus the time for which messages may have waited in this view."""
        return max(0.0, (self._snapshot.host_ns - time_ns) * 1e-9 - self._snapshot.behind_s)

    def _update_mode(self, snapshot: Snapshot) -> None:
        """Take the loop mode from the newest step, else from the controller's state, else from its Health."""
        last = snapshot.health.get(Role.CONTROLLER)
        report = snapshot.controller or (last.health if last is not None else None)
        mode = snapshot.steps.mode[-1] if snapshot.steps.mode.size else report.mode if report is not None else 0
        self._mode = _MODES.get(int(mode), self._mode)

    def _update_events(self, events: Iterable[Log]) -> None:
        """Keep the newest note and the newest cause of a mode change, by their times.

        Events from before the view arrive after the live ones.
        """
        for event in events:
            time_ns = from_timestamp(event.timestamp)
            if event.message.startswith("MODE_CHANGED") and time_ns >= self._cause_ns:
                self._cause, self._cause_ns = printable(event.message.partition(": ")[2]), time_ns
            newest_ns = from_timestamp(self._note.timestamp) if self._note is not None else 0
            if event.message.startswith("NOTE ") and time_ns >= newest_ns:
                self._note = event

    def _update_light(self, snapshot: Snapshot) -> None:
        calibration, frame = snapshot.calibration, snapshot.frame
        if frame is None or calibration is None:
            return
        if frame.shape != calibration.shape:
            self._flux = None
            return
        pixels = frame.reshape(-1)
        self._flux = float((pixels - calibration.dark) @ calibration.good) / calibration.flux_dn
        self._saturated = saturated_pixels(calibration, pixels)

    def _update_comparison(self, snapshot: Snapshot) -> None:
        before = self._steady.mode, self._steady.law
        if not self._steady.feed(snapshot):
            return
        if before != (self._steady.mode, self._steady.law):
            self._comparison = None  # the last result was for another law or loop mode
            self._compared_ns = snapshot.time_ns
        if snapshot.time_ns - self._compared_ns >= COMPARISON_PERIOD_NS:
            self._compared_ns = snapshot.time_ns
            rate_hz = frame_rate_hz(snapshot.camera, snapshot.steps)
            self._comparison = compare_with_best_gains(self._steady, rate_hz, snapshot.camera)

    def _sample(self, snapshot: Snapshot) -> _Sample:
        steps = snapshot.steps
        counts = Counts(count_reasons(steps.reasons))
        counts.update(steps=len(steps.mode), **self._count_increases(snapshot))
        true, measured = snapshot.wavefronts(true=True), snapshot.wavefronts(true=False)
        squares = _squares(snapshot, true), _squares(snapshot, measured)
        durations_ns = snapshot.timings["frame_to_command"]
        return _Sample(snapshot.host_ns, counts, squares, steps.sequence, steps.time_ns, durations_ns)

    def _count_increases(self, snapshot: Snapshot) -> dict[str, int]:
        """Increase of the processes' counts since the last snapshot, or since the first Health of a new process."""
        increases: dict[str, int] = {}
        for name, (role, count_in) in _COUNTERS.items():
            last = snapshot.health.get(role)
            if last is None:
                continue
            count = count_in(last.health)
            start_s, before = self._last_counts.get(name, (-1, 0))
            if start_s != last.start_s:
                before = count_in(last.first)
            if count > before:
                increases[name] = count - before
            self._last_counts[name] = (last.start_s, count)
        return increases


def _rms(samples: list[_Sample]) -> tuple[Rms | None, bool]:
    """Rms of the true or, without a true one, of the measured wavefront, and whether it is the true one."""
    for column in (0, 1):
        total: Array = sum((one.squares[column] for one in samples), np.zeros(5))
        if total[0]:
            return Rms(*np.sqrt(total[1:] / total[0]).tolist()), column == 0
    return None, False


def _rate_hz(samples: list[_Sample]) -> float | None:
    """Frame rate of the steps since the camera's last start, by their frame times."""
    active = [one for one in samples if one.sequence.size]
    last = int(active[-1].sequence[-1]) if active else 0
    first = next((one for one in active if start_of(int(one.sequence[0])) == start_of(last)), None)
    if first is None:
        return None
    frames, elapsed_ns = last - int(first.sequence[0]), int(active[-1].time_ns[-1] - first.time_ns[0])
    return frames * 1e9 / elapsed_ns if elapsed_ns > 0 and frames > 0 else None


def _squares(snapshot: Snapshot, wavefronts: Wavefronts) -> Array:
    """Number of rows, and the sum of squares of each field of `Rms`.

    The sums of tilt are 0 if the calibration's modes are not those of the rows.
    """
    noll = snapshot.noll if len(snapshot.noll) == wavefronts.residual_nm.shape[1] else ()
    tilts = [column for column, index in enumerate(noll) if index in TIP_TILT]
    tilt_nm2 = [
        np.square(one[:, tilts], dtype=float).sum() / max(1, len(tilts))
        for one in (wavefronts.residual_rms_nm, wavefronts.open_rms_nm)
    ]
    return np.array([len(wavefronts.rms_nm), *np.square(wavefronts.rms_nm, dtype=float).sum(axis=0), *tilt_nm2])
