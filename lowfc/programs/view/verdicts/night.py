"""The verdict on a whole log, at its end: how the night was, not its last instant."""

from collections import Counter
from datetime import UTC, datetime

import numpy as np

from lowfc.adapters.logs.columns import Steps
from lowfc.control.loop.durations import Durations
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.wording import counted
from lowfc.programs.view.snapshot import LogEnd, Snapshot
from lowfc.programs.view.verdicts.camera_verdict import DIM, FEW, REFUSED
from lowfc.programs.view.verdicts.course import Course
from lowfc.programs.view.verdicts.facts import facts
from lowfc.programs.view.verdicts.tile import Level, Tile, Verdict, figure, long_time, worst_of
from lowfc.programs.view.verdicts.verdict import LIMITS, stroke
from lowfc.programs.view.verdicts.watcher import Watcher
from lowfc.programs.view.verdicts.wavefront_verdict import GOOD_FACTOR

_LONGEST_STEP_NS = 1_000_000_000
"""A pause between two steps that is longer counts as time without steps."""
_MODES = {mode.value: mode for mode in LoopMode}


class Night:
    """Everything since the first snapshot, in sums."""

    def __init__(self) -> None:
        self._course = Course()
        self._closed = np.zeros(3)  # rows while the loop was closed, and the squares of what was left, and of flat
        self._mode_ns: Counter[LoopMode | None] = Counter()
        self._first_ns = self._last_ns = 0
        self._latency = Durations()
        self._stroke_nm = 0.0
        self._lost = 0

    def feed(self, snapshot: Snapshot, watcher: Watcher) -> None:
        """Add a snapshot that `watcher` was fed with."""
        self._course.feed(snapshot)
        steps, truths = snapshot.steps, snapshot.truths
        if steps.time_ns.size:
            self._add_modes(steps)
            closed = steps.mode == LoopMode.CLOSED.value
            if truths.sequence.size:
                rows = np.isin(truths.sequence, steps.sequence[closed])
                left_nm2, flat_nm2 = truths.residual_rms_nm[rows] ** 2.0, truths.disturbance_rms_nm[rows] ** 2.0
            else:
                rows = np.isfinite(steps.error_nm).all(axis=1) & closed
                left_nm2, flat_nm2 = (np.sum(one[rows] ** 2.0, axis=1) for one in (steps.error_nm, steps.pol_nm))
            if not self._course.true or truths.sequence.size:
                self._closed += (len(left_nm2), left_nm2.sum(), flat_nm2.sum())
        for duration_ns in snapshot.timings["frame_to_command"].tolist():
            self._latency.add(duration_ns)
        self._stroke_nm = max(self._stroke_nm, watcher.stroke_nm())
        self._lost = max(self._lost, watcher.messages_lost())

    def verdict(self, watcher: Watcher, ended: LogEnd) -> Verdict:
        """Tiles of the whole log, and a sentence; the worst of them where somebody should look."""
        loop, wavefront = self._loop(), self._wavefront()
        tiles = (
            loop,
            wavefront,
            _frames(watcher),
            self._star(),
            self._mirror(watcher),
            self._timing(watcher),
            self._log(ended),
        )
        worst = worst_of(tiles)
        level = worst.level if worst.level >= Level.WARNING else min(loop.level, wavefront.level)
        headline = "Log without a step of the controller"
        if self._first_ns:
            begin = datetime.fromtimestamp(self._first_ns * 1e-9, UTC)
            span = long_time((self._last_ns - self._first_ns) * 1e-9)
            headline = f"{span} from {begin:%Y-%m-%d %H:%M:%S}: loop {loop.value.lower()}"
        if wavefront.advice:
            headline += f", {wavefront.advice}"
        advice = f" {worst.advice}" if worst.advice and worst is not wavefront else ""
        return Verdict(f"{headline}.{advice}", level, tiles, facts(watcher))

    def _add_modes(self, steps: Steps) -> None:
        time_ns = steps.time_ns
        self._first_ns = self._first_ns or int(time_ns[0])
        after_ns = np.diff(time_ns, prepend=self._last_ns or time_ns[0])
        with_steps = (after_ns >= 0) & (after_ns <= _LONGEST_STEP_NS)
        self._mode_ns[None] += int(after_ns[~with_steps & (after_ns > 0)].sum())
        for value in np.unique(steps.mode):
            self._mode_ns[_MODES.get(int(value))] += int(after_ns[with_steps & (steps.mode == value)].sum())
        self._last_ns = int(time_ns[-1])

    def _loop(self) -> Tile:
        total_ns, closed_ns = max(sum(self._mode_ns.values()), 1), self._mode_ns[LoopMode.CLOSED]
        share = min(100 * closed_ns / total_ns, 99.9)
        value = "CLOSED" if closed_ns == total_ns else f"{share:.3g} % CLOSED" if closed_ns else "NOT CLOSED"
        names = {LoopMode.OPEN: "open", LoopMode.SAFE: "safe", LoopMode.IDLE: "idle", None: "without frames"}
        others = [f"{name} {self._time_in(mode)}" for mode, name in names.items() if self._mode_ns[mode]]
        detail = ", ".join([f"closed {self._time_in(LoopMode.CLOSED)}", *others])
        if self._mode_ns[LoopMode.SAFE]:
            advice = f"The loop was in safe mode for {self._time_in(LoopMode.SAFE)}: see the events."
            return Tile("LOOP", value, detail, Level.WARNING, advice)
        return Tile("LOOP", value, detail, Level.GOOD if closed_ns > 0.5 * total_ns else Level.NEUTRAL)

    def _time_in(self, mode: LoopMode | None) -> str:
        return long_time(self._mode_ns[mode] * 1e-9)

    def _wavefront(self) -> Tile:
        count, left_nm2, flat_nm2 = self._closed
        if not count:
            return Tile("WAVEFRONT", "?", "never measured with the loop closed", Level.NEUTRAL)
        left_nm, flat_nm = float(np.sqrt(left_nm2 / count)), float(np.sqrt(flat_nm2 / count))
        worst_nm = float(np.nanmax(self._course.wavefront()[1][:, 0], initial=0.0))
        better = flat_nm / left_nm if left_nm else 1.0
        detail = (
            f"while closed, {better:.1f} x better than {figure(flat_nm)} nm with a flat mirror; "
            f"worst {self._span()}: {figure(worst_nm)} nm; {'true' if self._course.true else 'measured, with noise'}"
        )
        level = Level.GOOD if better >= GOOD_FACTOR else Level.NEUTRAL
        value = f"{figure(left_nm)} nm rms"
        return Tile("WAVEFRONT", value, detail, level, f"{value} left of {figure(flat_nm)} nm")

    def _span(self) -> str:
        return long_time(self._course.span_ns * 1e-9)

    def _star(self) -> Tile:
        light = 100 * self._course.light()
        light = light[np.isfinite(light)]
        if not light.size:
            return Tile("STAR", "?", "no frame was used", Level.NEUTRAL)
        value, dimmest = f"{np.median(light):.0f} %", f"{light.min():.0f}"
        detail = f"of the expected light; in {self._span()} between {dimmest} and {light.max():.0f} %"
        if light.min() < 100 * DIM:
            return Tile("STAR", value, detail, Level.WARNING, f"The star was dim, down to {dimmest} %.")
        return Tile("STAR", value, detail, Level.GOOD)

    def _mirror(self, watcher: Watcher) -> Tile:
        value, of = stroke(self._stroke_nm, watcher.snapshot.stroke_nm)
        acted = [
            f"{words}: {counted(watcher.totals[reason], 'time')}"
            for reason, words in LIMITS.items()
            if watcher.totals[reason]
        ]
        if acted:
            named = ", ".join(acted)
            advice = f"The mirror was at a limit ({named}): the disturbance was larger than it can correct."
            return Tile("MIRROR", "AT LIMIT", f"{named}; {value} {of} at most", Level.WARNING, advice)
        return Tile("MIRROR", value, f"{of} at most, no limit acted", Level.GOOD)

    def _timing(self, watcher: Watcher) -> Tile:
        if not self._latency.count:
            return Tile("LATENCY", "?", "not measured", Level.NEUTRAL)
        middle, long, most = (f"{figure(ns / 1e3)} us" for ns in self._latency.percentiles_ns(0.5, 0.99, 1.0))
        detail = f"frame to command; 1 in 100 over {long}, at most {most}"
        if watcher.simulated:
            return Tile("LATENCY", middle, f"{detail}; of no effect in simulated time", Level.NEUTRAL)
        return Tile("LATENCY", middle, detail, Level.GOOD)

    def _log(self, ended: LogEnd) -> Tile:
        lost = counted(self._lost, "message")
        detail = f"{ended.name}, {f'{lost} lost' if self._lost else 'nothing lost'}"
        if not ended.complete:
            advice = f"{ended.no_end.capitalize()}."
            return Tile("LOG", "NO END", f"{detail} up to here", Level.WARNING, advice)
        if self._lost:
            advice = f"The recorder lost {lost}: disk or processor was too slow for it."
            return Tile("LOG", "FINISHED", detail, Level.WARNING, advice)
        return Tile("LOG", "FINISHED", detail, Level.GOOD)


def _frames(watcher: Watcher) -> Tile:
    totals = watcher.totals
    lost, steps = totals["skipped"] + totals["missing"], totals["steps"]
    refused = Counter({words: totals[reason] for reason, (words, _) in REFUSED.items() if totals[reason]})
    named = ", ".join(f"{count} {words}" for words, count in refused.most_common(3))
    unused = lost + refused.total()
    detail = f"of {counted(steps, 'frame')}: {lost} lost, {refused.total()} refused{f' ({named})' if named else ''}"
    if unused >= FEW * max(steps, 1):
        advice = f"{counted(lost, 'frame')} lost, {refused.total()} refused: see the events."
        return Tile("FRAMES", f"{unused} UNUSED", detail, Level.WARNING, advice)
    rate = f"{1e9 / watcher.period_ns:.0f} Hz" if watcher.period_ns else f"{steps}"
    return Tile("FRAMES", rate, detail, Level.GOOD if steps else Level.NEUTRAL)
