"""What an annunciator remembers of a run: sums over the last seconds, who is alive, the last of what was said."""

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.adapters.history import Single, Whole
from lowfc.adapters.run import mirror_role
from lowfc.contract.codec import actuators
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
from lowfc.control.estimator import saturated_pixels
from lowfc.control.safety import LoopMode, Reason
from lowfc.programs.view.attainable import Attainable
from lowfc.programs.view.moment import Moment
from lowfc.programs.watch import topic_count

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
"""Processes need a few seconds to start; whoever is not there after this is missed."""
_GLANCES = 1000
_MODES: dict[int, LoopMode] = {mode.value: mode for mode in LoopMode}


class Life(Enum):
    """How a process is, as far as one can hear."""

    NEVER = auto()
    STARTING = auto()
    RUNNING = auto()
    STOPPED = auto()
    SILENT = auto()


class Sign(NamedTuple):
    """Sign of life of a process, and for how long there has been none."""

    life: Life
    silent_s: float


class Rms(NamedTuple):
    """Root mean squares of a wavefront, and of what it would be without the mirror; tilt per axis."""

    residual_nm: float
    open_nm: float
    tilt_residual_nm: float
    tilt_open_nm: float


@dataclass(frozen=True, slots=True)
class _Glance:
    """What one moment brought; of `truth` and `measured` a count and the sums of squares of `Rms`."""

    host_ns: int
    counts: Counter[Reason | str]
    truth: npt.NDArray[np.float64]
    measured: npt.NDArray[np.float64]
    span: tuple[int, int, int, int] | None
    durations_ns: Whole


class Watcher:
    """Is fed with moments; answers for the last seconds.

    Attributes:
        moment: the last one.
        mode: of the loop; None before the first word of it.
        why: of the last change of mode.
        flux: light on the newest frame, of what the calibration expects; None without both.
        saturated: good pixels at full well in the newest frame.
        mirror: its last state.
        note: the operator's last one; None before the first.
        totals: of everything that `recent` counts, since the first moment.
        attainable: what the loop could leave.
        begun_ns: host time of the first moment with a message.
    """

    def __init__(self) -> None:
        """Nothing has been heard."""
        self.moment: Moment | None = None
        self.mode: LoopMode | None = None
        self.why = ""
        self.flux: float | None = None
        self.saturated = 0
        self.mirror: wire.MirrorState | None = None
        self.begun_ns = 0
        self.note: Log | None = None
        self.totals: Counter[Reason | str] = Counter()
        self.attainable = Attainable()
        self._why_ns = 0
        self._glances: deque[_Glance] = deque(maxlen=_GLANCES)
        self._totals: dict[float, Counter[Reason | str]] = {}
        self._counted: dict[str, tuple[int, int]] = {}
        self._told: dict[str, object] = {}
        self._worked: list[_Glance] = []

    @property
    def behind_s(self) -> float:
        """How late the last moment was; silence is counted without it."""
        return self.moment.behind_s if self.moment else 0.0

    def feed(self, moment: Moment) -> None:
        """Take what is new."""
        self.moment = moment
        self._totals.clear()
        if not self.begun_ns and moment.heard_ns:
            self.begun_ns = moment.host_ns
        self._mode(moment)
        self._events(moment.events)
        self.attainable.feed(moment)
        self.mirror = moment.mirror or self.mirror
        if moment.frame is not None and moment.calibration is not None:
            self._light(moment.frame, moment)
        steps, truths = moment.steps, moment.truths
        tilts = _tilts(moment, steps.error_nm.shape[1]), _tilts(moment, truths.residual_nm.shape[1])
        used = np.isfinite(steps.error_nm).all(axis=1) if steps.error_nm.shape[1] else np.zeros(len(steps.mode), bool)
        error_nm, pol_nm = steps.error_nm[used], steps.pol_nm[used]
        self._glances.append(
            _Glance(
                moment.host_ns,
                Counter({"steps": len(steps.mode), **_reasons(steps.reasons), **self._grown(moment)}),
                _sums(
                    truths.residual_rms_nm,
                    truths.disturbance_rms_nm,
                    truths.residual_nm,
                    truths.disturbance_nm,
                    tilts[1],
                ),
                _sums(_norm(error_nm), _norm(pol_nm), error_nm, pol_nm, tilts[0]),
                _span(steps.sequence, steps.time_ns),
                moment.timings["frame_to_command"],
            )
        )
        self.totals.update(self._glances[-1].counts)
        while self._glances[0].host_ns < moment.host_ns - RECENT_S * 1e9 - PERIODS * self.period_ns:
            self._glances.popleft()
        if moment.steps.mode.size:
            self._worked = list(self._last(NOW_S))

    @property
    def period_ns(self) -> int:
        """Of the frames; 0 where the camera does not say."""
        camera = self.moment.camera if self.moment else None
        return camera.period_ns if camera is not None else 0

    def run_and_host(self) -> tuple[str, str]:
        """Name of the run, and the host of its controller or, without one, of the process heard first."""
        if self.moment is None:
            return "", ""
        if self.moment.ended is not None:
            return self.moment.ended.run, self.moment.ended.host
        heard = {name: one.health for name, one in self.moment.health.items() if name != Role.VIEWER}
        health = heard.get(Role.CONTROLLER) or next(iter(heard.values()), wire.Health())
        return printable(health.run_id), printable(health.host)

    @property
    def simulated(self) -> bool:
        """Whether the frames' times are not this host's."""
        return self.moment is not None and abs(self.moment.time_ns - self.moment.host_ns) > OTHER_CLOCK_NS

    @property
    def running_s(self) -> float:
        """Time since the first message was heard."""
        return (self.moment.host_ns - self.begun_ns) * 1e-9 if self.moment and self.begun_ns else 0.0

    def recent(self, what: Reason | str) -> int:
        """How often a reason was given lately; or "steps", or what was "skipped", "missing", "late" or "lost"."""
        return self._total(RECENT_S)[what]

    def now(self, what: Reason | str) -> int:
        """The same for the last second."""
        return self._total(NOW_S)[what]

    def wavefront(self, span_s: float = NOW_S, *, ended: bool = False) -> tuple[Rms | None, bool]:
        """Of the last second, or the last with a step in it, and whether it is the truth; None without any."""
        glances = self._worked if ended else list(self._last(span_s))
        for sums, true in (([one.truth for one in glances], True), ([one.measured for one in glances], False)):
            total = np.sum(sums, axis=0) if sums else np.zeros(5)
            if total[0]:
                return Rms(*(float(value) for value in np.sqrt(total[1:] / total[0]))), true
        return None, False

    def rate_hz(self) -> float | None:
        """Rate of the frames behind the steps, by their own times; None with less than two since it started."""
        spans = [glance.span for glance in self._last(NOW_S) if glance.span is not None]
        spans = [span for span in spans if start_of(span[0]) == start_of(spans[-1][2])]
        if not spans:
            return None
        frames, elapsed_ns = spans[-1][2] - spans[0][0], spans[-1][3] - spans[0][1]
        return frames * 1e9 / elapsed_ns if elapsed_ns > 0 and frames > 0 else None

    def durations_us(self, *, ended: bool = False) -> tuple[float, float] | None:
        """p50 and p99 of frame to command in the last second, or the last with a step in it; None without any."""
        durations = [glance.durations_ns for glance in (self._worked if ended else self._last(NOW_S))]
        every = np.concatenate(durations) if durations else np.zeros(0)
        return None if not every.size else (float(np.median(every)) / 1e3, float(np.percentile(every, 99)) / 1e3)

    def stroke_nm(self) -> float:
        """Largest deviation of an actuator from flat in the mirror's last state; 0 without one."""
        surface_nm = actuators(self.mirror) if self.mirror is not None else None
        return float(np.abs(surface_nm).max(initial=0.0)) if surface_nm is not None else 0.0

    def messages_lost(self) -> int:
        """By the recorder, as it reported last."""
        heard = self.moment.health.get(Role.RECORDER) if self.moment else None
        return heard.health.recording.lost if heard is not None else 0

    def controller(self) -> Sign:
        """Of the controller."""
        return self._sign((Role.CONTROLLER,), STEP, CONTROLLER_STATE)

    def camera(self) -> Sign:
        """Of the camera; one of the user's own may send frames and nothing else."""
        return self._sign((Role.CAMERA,), FRAME)

    def recorder(self) -> Sign:
        """Of the recorder."""
        return self._sign((Role.RECORDER,))

    def mirrors(self) -> Sign:
        """Of the mirror; where there are several, of the one silent longest, and of a stopped one only if all are."""
        names = [name for name in self.moment.health if name.startswith(mirror_role(""))] if self.moment else []
        if len(names) > 1:
            return max(
                (self._sign((name,)) for name in names),
                key=lambda sign: (sign.life is Life.SILENT, sign.life is not Life.STOPPED, sign.silent_s),
            )
        return self._sign(names, MIRROR_STATE)

    def silent_s(self, topic: Topic) -> float | None:
        """Time without a message that comes with every frame, where it is longer than this rate explains; else None."""
        if self.moment is None or not self.begun_ns:
            return None
        heard_ns = self.moment.heard_ns  # a step tells of its frame, which a log need not have
        silent_s = self._since_s(max(heard_ns.get(topic.key, self.begun_ns), heard_ns.get(STEP.key, 0)))
        return silent_s if silent_s > max(FRAMES_SILENT_S, PERIODS * self.period_ns * 1e-9) else None

    def _total(self, span_s: float) -> Counter[Reason | str]:
        """Counts of the last moments, added up once."""
        if span_s not in self._totals:
            total: Counter[Reason | str] = Counter()
            for glance in self._last(span_s):
                total.update(glance.counts)
            self._totals[span_s] = total
        return self._totals[span_s]

    def _last(self, span_s: float) -> Iterator[_Glance]:
        if self.moment is None:
            return iter(())
        span_ns = max(span_s * 1e9, PERIODS * self.period_ns)
        return (glance for glance in self._glances if glance.host_ns > self.moment.host_ns - span_ns)

    def _sign(self, names: Iterable[str], *topics: Topic) -> Sign:
        if self.moment is None:
            return Sign(Life.NEVER, 0.0)
        heard = next((self.moment.health[name] for name in names if name in self.moment.health), None)
        sent_ns = max(
            (self.moment.heard_ns[topic.key] for topic in topics if topic.key in self.moment.heard_ns), default=0
        )
        last_ns = max(sent_ns, heard.time_ns if heard is not None else 0)
        if not last_ns:
            return Sign(Life.NEVER, 0.0)
        silent_s = self._since_s(last_ns)
        said = heard.health.state if heard is not None and heard.time_ns >= sent_ns else "running"
        if said in ("stopping", "stopped"):
            return Sign(Life.STOPPED, silent_s)
        if silent_s > max(SILENT_S, PERIODS * self.period_ns * 1e-9):
            return Sign(Life.SILENT, silent_s)
        return Sign(Life.STARTING if said in ("starting", "ready") else Life.RUNNING, silent_s)

    def _since_s(self, time_ns: int) -> float:
        return max(0.0, (self.moment.host_ns - time_ns) * 1e-9 - self.behind_s) if self.moment else 0.0

    def _mode(self, moment: Moment) -> None:
        """The newest word on the mode: of a step, a state or a Health that is new."""
        heard = moment.health.get(Role.CONTROLLER)
        for name, said in (("health", heard and heard.health), ("state", moment.controller)):
            if said is not None and said is not self._told.get(name):
                self.mode = _MODES.get(said.mode, self.mode)
            self._told[name] = said
        if moment.steps.mode.size:
            self.mode = _MODES.get(int(moment.steps.mode[-1]), self.mode)

    def _events(self, events: Iterable[Log]) -> None:
        """The newest note and cause: events from before a view began come after those that it received itself."""
        for event in events:
            time_ns = from_timestamp(event.timestamp)
            if event.message.startswith("MODE_CHANGED") and time_ns >= self._why_ns:
                self.why, self._why_ns = printable(event.message.partition(": ")[2]), time_ns
            if event.message.startswith("NOTE ") and (
                self.note is None or time_ns >= from_timestamp(self.note.timestamp)
            ):
                self.note = event

    def _light(self, frame: npt.NDArray[np.uint16], moment: Moment) -> None:
        calibration = moment.calibration
        if calibration is None or frame.shape != calibration.shape:
            self.flux = None
            return
        pixels = frame.reshape(-1)
        self.flux = float((pixels - calibration.dark) @ calibration.good) / calibration.flux_dn
        self.saturated = saturated_pixels(calibration, pixels)

    def _grown(self, moment: Moment) -> dict[Reason | str, int]:
        """By how much what the processes count has grown since the last moment; a restarted one begins anew."""
        grown: dict[Reason | str, int] = {}
        for role in (Role.CONTROLLER, Role.CAMERA, Role.RECORDER):
            heard = moment.health.get(role)
            if heard is None:
                continue
            health, frames = heard.health, topic_count(heard.health, FRAME.key)
            counts = {
                Role.CONTROLLER: {"skipped": frames.skipped, "missing": frames.missing},
                Role.CAMERA: {"late": health.commands_late},
                Role.RECORDER: {"lost": health.recording.lost},
            }[role]
            for name, count in counts.items():
                pid, before = self._counted.get(name, (health.pid, count))
                if pid == health.pid and count > before:
                    grown[name] = count - before
                self._counted[name] = (health.pid, count)
        return grown


def _reasons(bits: Whole) -> dict[Reason | str, int]:
    if not bits.any():
        return {}
    return {reason: int(np.count_nonzero(bits & (1 << reason))) for reason in Reason}


def _tilts(moment: Moment, modes: int) -> list[int]:
    """Columns of tip and tilt, where the calibration is for so many modes."""
    noll = moment.calibration.noll if moment.calibration is not None else ()
    return [column for column, index in enumerate(noll) if index in (2, 3)] if len(noll) == modes else []


def _norm(modes_nm: Single) -> npt.NDArray[np.float64]:
    return np.asarray(np.sqrt(np.square(modes_nm, dtype=np.float64).sum(axis=1)))


def _sums(
    residual_nm: npt.NDArray[np.floating],
    open_nm: npt.NDArray[np.floating],
    residual_modes_nm: Single,
    open_modes_nm: Single,
    tilts: list[int],
) -> npt.NDArray[np.float64]:
    squares = [float(np.square(one, dtype=np.float64).sum()) for one in (residual_nm, open_nm)]
    per_axis = [
        float(np.square(modes[:, tilts], dtype=np.float64).sum()) / max(1, len(tilts))
        for modes in (residual_modes_nm, open_modes_nm)
    ]
    return np.array([len(residual_nm), *squares, *per_axis])


def _span(sequence: npt.NDArray[np.uint64], time_ns: Whole) -> tuple[int, int, int, int] | None:
    """Sequence and time of the first and of the last frame."""
    if not sequence.size:
        return None
    return int(sequence[0]), int(time_ns[0]), int(sequence[-1]), int(time_ns[-1])
