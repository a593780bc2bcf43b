"""The verdict on a whole log, at its end: how the night was, not its last instant."""

from collections import Counter
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from lowfc.control.durations import Durations
from lowfc.control.safety import LoopMode
from lowfc.programs.view.camera_verdict import DIM, FEW, REFUSED
from lowfc.programs.view.course import Course
from lowfc.programs.view.facts import facts
from lowfc.programs.view.moment import LogEnd, Moment
from lowfc.programs.view.tile import Level, Tile, counted, figure, long_time
from lowfc.programs.view.verdict import LIMITS, Verdict
from lowfc.programs.view.watcher import Watcher
from lowfc.programs.view.wavefront_verdict import GOOD_FACTOR

_LONGEST_STEP_NS = 1_000_000_000
"""A pause between two steps that is longer counts as time without steps."""
_MODES = {mode.value: mode for mode in LoopMode}


class Night:
    """Everything since the first moment, in sums."""

    def __init__(self) -> None:
        self._course = Course()
        self._closed = np.zeros(3)  # rows while the loop was closed, and the squares of what was left, and of flat
        self._mode_ns: Counter[LoopMode | None] = Counter()
        self._first_ns = self._last_ns = 0
        self._latency = Durations()
        self._stroke_nm = 0.0
        self._lost = 0

    def feed(self, moment: Moment, watcher: Watcher) -> None:
        """Add a moment that `watcher` was fed with."""
        self._course.feed(moment)
        steps, truths = moment.steps, moment.truths
        if steps.time_ns.size:
            self._modes(steps.time_ns, steps.mode)
            closed = steps.sequence[steps.mode == LoopMode.CLOSED.value]
            if truths.sequence.size:
                rows = np.isin(truths.sequence, closed)
                left_nm2, flat_nm2 = truths.residual_rms_nm[rows] ** 2.0, truths.disturbance_rms_nm[rows] ** 2.0
            else:
                rows = np.isfinite(steps.error_nm).all(axis=1) & (steps.mode == LoopMode.CLOSED.value)
                left_nm2, flat_nm2 = (np.sum(one[rows] ** 2.0, axis=1) for one in (steps.error_nm, steps.pol_nm))
            if not self._course.true or truths.sequence.size:
                self._closed += (len(left_nm2), left_nm2.sum(), flat_nm2.sum())
        for duration_ns in moment.timings["frame_to_command"].tolist():
            self._latency.add(duration_ns)
        self._stroke_nm = max(self._stroke_nm, watcher.stroke_nm())
        self._lost = max(self._lost, watcher.messages_lost())

    def verdict(self, watcher: Watcher, ended: LogEnd) -> Verdict:
        """Tiles of the whole log, and a sentence; the worst of them where somebody should look."""
        tiles = (
            self._loop(),
            self._wavefront(),
            self._frames(watcher),
            self._star(),
            self._mirror(watcher),
            self._timing(watcher),
            self._log(ended),
        )
        worst = max(tiles, key=lambda tile: tile.level)
        level = worst.level if worst.level >= Level.WARNING else min(tile.level for tile in tiles[:2])
        loop, wavefront = tiles[0], tiles[1]
        said = "Log without a step of the controller"
        if self._first_ns:
            begin = datetime.fromtimestamp(self._first_ns * 1e-9, UTC)
            span = long_time((self._last_ns - self._first_ns) * 1e-9)
            said = f"{span} from {begin:%Y-%m-%d %H:%M:%S}: loop {loop.value.lower()}"
        if wavefront.advice:
            said += f", {wavefront.advice}"
        return Verdict(
            f"{said}.{f' {worst.advice}' if worst.advice and worst is not wavefront else ''}",
            level,
            tiles,
            facts(watcher),
        )

    def _modes(self, time_ns: npt.NDArray[np.int64], mode: npt.NDArray[np.uint8]) -> None:
        self._first_ns = self._first_ns or int(time_ns[0])
        after_ns = np.diff(time_ns, prepend=self._last_ns or time_ns[0])
        whole = (after_ns >= 0) & (after_ns <= _LONGEST_STEP_NS)
        self._mode_ns[None] += int(after_ns[~whole & (after_ns > 0)].sum())
        for value in np.unique(mode):
            self._mode_ns[_MODES.get(int(value))] += int(after_ns[whole & (mode == value)].sum())
        self._last_ns = int(time_ns[-1])

    def _loop(self) -> Tile:
        title, total_ns = "LOOP", max(sum(self._mode_ns.values()), 1)
        closed_ns = self._mode_ns[LoopMode.CLOSED]
        share = 100 * closed_ns / total_ns
        value = "CLOSED" if closed_ns == total_ns else f"{min(share, 99.9):.3g} % CLOSED" if closed_ns else "NOT CLOSED"
        names = {LoopMode.OPEN: "open", LoopMode.SAFED: "safe", LoopMode.IDLE: "idle", None: "without frames"}
        others = [
            f"{name} {long_time(self._mode_ns[mode] * 1e-9)}" for mode, name in names.items() if self._mode_ns[mode]
        ]
        detail = ", ".join([f"closed {long_time(closed_ns * 1e-9)}", *others])
        if safe_ns := self._mode_ns[LoopMode.SAFED]:
            advice = f"The loop was in safe mode for {long_time(safe_ns * 1e-9)}: see the events."
            return Tile(title, value, detail, Level.WARNING, advice)
        return Tile(title, value, detail, Level.GOOD if closed_ns > 0.5 * total_ns else Level.NEUTRAL)

    def _wavefront(self) -> Tile:
        title, (count, left_nm2, flat_nm2) = "WAVEFRONT", self._closed
        if not count:
            return Tile(title, "?", "never measured with the loop closed", Level.NEUTRAL)
        left_nm, flat_nm = float(np.sqrt(left_nm2 / count)), float(np.sqrt(flat_nm2 / count))
        _, rms_nm = self._course.wavefront()
        worst_nm = float(np.nanmax(rms_nm[:, 0], initial=0.0))
        better = flat_nm / left_nm if left_nm else 1.0
        kind = "true" if self._course.true else "measured, with noise"
        detail = (
            f"while closed, {better:.1f} x better than {figure(flat_nm)} nm with a flat mirror; "
            f"worst {long_time(self._course.span_ns * 1e-9)}: {figure(worst_nm)} nm; {kind}"
        )
        level = Level.GOOD if better >= GOOD_FACTOR else Level.NEUTRAL
        return Tile(
            title, f"{figure(left_nm)} nm rms", detail, level, f"{figure(left_nm)} nm rms left of {figure(flat_nm)} nm"
        )

    def _frames(self, watcher: Watcher) -> Tile:
        title, totals = "FRAMES", watcher.totals
        lost, steps = totals["skipped"] + totals["missing"], totals["steps"]
        refused = Counter({words: totals[reason] for reason, (words, _) in REFUSED.items() if totals[reason]})
        named = ", ".join(f"{count} {words}" for words, count in refused.most_common(3))
        detail = f"of {counted(steps, 'frame')}: {lost} lost, {refused.total()} refused{f' ({named})' if named else ''}"
        if lost + refused.total() >= FEW * max(steps, 1):
            advice = f"{counted(lost, 'frame')} lost, {refused.total()} refused: see the events."
            return Tile(title, f"{lost + refused.total()} UNUSED", detail, Level.WARNING, advice)
        rate = f"{1e9 / watcher.period_ns:.0f} Hz" if watcher.period_ns else f"{steps}"
        return Tile(title, rate, detail, Level.GOOD if steps else Level.NEUTRAL)

    def _star(self) -> Tile:
        title, light = "STAR", self._course.light()
        light = 100 * light[np.isfinite(light)]
        if not light.size:
            return Tile(title, "?", "no frame was used", Level.NEUTRAL)
        span = long_time(self._course.span_ns * 1e-9)
        detail = f"of the expected light; in {span} between {light.min():.0f} and {light.max():.0f} %"
        if light.min() < 100 * DIM:
            return Tile(
                title,
                f"{np.median(light):.0f} %",
                detail,
                Level.WARNING,
                f"The star was dim, down to {light.min():.0f} %.",
            )
        return Tile(title, f"{np.median(light):.0f} %", detail, Level.GOOD)

    def _mirror(self, watcher: Watcher) -> Tile:
        title, settings = (
            "MIRROR",
            watcher.moment.controller.settings if watcher.moment and watcher.moment.controller else None,
        )
        stroke_nm = settings.stroke_nm if settings is not None else 0.0
        value = f"{100 * self._stroke_nm / stroke_nm:.0f} %" if stroke_nm else f"{self._stroke_nm:.0f} nm"
        of = f"of {stroke_nm:g} nm stroke used at most" if stroke_nm else "of stroke used at most"
        acted = {words: watcher.totals[reason] for reason, words in LIMITS.items() if watcher.totals[reason]}
        if acted:
            named = ", ".join(f"{words}: {counted(count, 'time')}" for words, count in acted.items())
            advice = f"The mirror was at a limit ({named}): the disturbance was larger than it can correct."
            return Tile(title, "AT LIMIT", f"{named}; {value} {of}", Level.WARNING, advice)
        return Tile(title, value, f"{of}, no limit acted", Level.GOOD)

    def _timing(self, watcher: Watcher) -> Tile:
        if not self._latency.count:
            return Tile("LATENCY", "?", "not measured", Level.NEUTRAL)
        middle_us, long_us, most_us = (ns / 1e3 for ns in self._latency.percentiles_ns(0.5, 0.99, 1.0))
        detail = f"frame to command; 1 in 100 over {figure(long_us)} us, at most {figure(most_us)} us"
        if watcher.simulated:
            return Tile(
                "LATENCY", f"{figure(middle_us)} us", f"{detail}; of no effect in simulated time", Level.NEUTRAL
            )
        return Tile("LATENCY", f"{figure(middle_us)} us", detail, Level.GOOD)

    def _log(self, ended: LogEnd) -> Tile:
        losses = f"{counted(self._lost, 'message')} lost" if self._lost else "nothing lost"
        detail = f"{ended.name}, {losses}"
        if not ended.complete:
            advice = "The log has no end: its recorder was killed, or is still writing."
            return Tile("LOG", "NO END", f"{detail} up to here", Level.WARNING, advice)
        if self._lost:
            advice = f"The recorder lost {counted(self._lost, 'message')}: disk or processor was too slow for it."
            return Tile("LOG", "FINISHED", detail, Level.WARNING, advice)
        return Tile("LOG", "FINISHED", detail, Level.GOOD)
