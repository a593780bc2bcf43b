"""Verdict on a whole log, shown at its end in place of the verdict on its last seconds."""

from collections import Counter
from datetime import UTC, datetime
from functools import partial
from math import isnan

import numpy as np

from lowfc.adapters.logs.columns import Steps
from lowfc.control.durations import Durations
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.wording import counted, hertz
from lowfc.programs.cli.correction import MANY_LATE, NEAR_STROKE, Correction, correction
from lowfc.programs.cli.status import holds_shape
from lowfc.programs.view.snapshot import LogEnd, Snapshot, Wavefronts
from lowfc.programs.view.verdicts.camera_verdict import DIM, FEW, REFUSED
from lowfc.programs.view.verdicts.facts import facts
from lowfc.programs.view.verdicts.run_state import PERIODS, RunState
from lowfc.programs.view.verdicts.span_means import SpanMeans
from lowfc.programs.view.verdicts.tile import Level, Tile, Verdict, duration, rounded, worst_of
from lowfc.programs.view.verdicts.verdict import LIMITS, stroke
from lowfc.programs.view.verdicts.watcher import FRAMES_SILENT_S

_MODES = {mode.value: mode for mode in LoopMode}
_MAX_KEPT = 8192
"""Largest number of kept steps, and of kept wavefronts without a step: a loaded host may record steps seconds late."""
_NAMES = {LoopMode.OPEN: "open", LoopMode.SAFE: "safe", LoopMode.IDLE: "idle", None: "without steps"}

_LEVELS = {Correction.GOOD: Level.GOOD, Correction.LITTLE: Level.NEUTRAL, Correction.HARM: Level.WARNING}


class LogVerdict:
    """The verdict on a log, from sums over all its snapshots."""

    def __init__(self) -> None:
        self._means = SpanMeans()
        self._closed = SpanMeans()  # of the frames with the loop closed
        self._modes = np.zeros((2, 0), np.uint64)  # sequence and loop mode of the last steps
        self._without_step = np.zeros(0, np.uint64), np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        self._mode_ns: Counter[LoopMode | None] = Counter()
        self._first_ns = self._last_ns = 0
        self._latency = Durations()
        self._shape_held = False

    def feed(self, snapshot: Snapshot) -> None:
        """Add a snapshot."""
        self._means.feed(snapshot)
        if snapshot.steps.time_ns.size:
            self._add_modes(snapshot.steps.at(snapshot.new_exposures), snapshot.period_ns)
        self._add_closed(snapshot.steps, snapshot.wavefronts(true=self._means.true))
        for duration_ns in snapshot.timings["frame_to_command"].tolist():
            self._latency.add(duration_ns)
        self._shape_held |= holds_shape(snapshot.controller)

    def verdict(self, state: RunState, ended: LogEnd) -> Verdict:
        """Tiles of the whole log, and a headline, with the advice of the worst tile if it needs attention."""
        loop, wavefront = self._loop(), self._wavefront()
        others = _frames(state), self._star(), _mirror(state, ended), self._timing(state), _log(state, ended)
        tiles = (loop, wavefront, *others)
        worst = worst_of(tiles)
        level = worst.level if worst.level >= Level.WARNING else min(loop.level, wavefront.level)
        headline = f"Log without a step of the controller{' with a valid time' if state.totals['steps'] else ''}"
        if self._first_ns:
            begin = datetime.fromtimestamp(self._first_ns * 1e-9, UTC)
            span = duration((self._last_ns - self._first_ns) * 1e-9)
            headline = f"{span} from {begin:%Y-%m-%d %H:%M:%S}: loop {loop.value.lower()}"
        if wavefront.advice:
            headline += f", {wavefront.advice}"
        advice = f" {worst.advice}" if worst.advice and worst is not wavefront else ""
        return Verdict(f"{headline}.{advice}", level, tiles, facts(state))

    def _add_closed(self, steps: Steps, wavefronts: Wavefronts) -> None:
        """Add the wavefronts of the closed loop; step and true wavefront of a frame may be in different snapshots."""
        self._modes = np.hstack([self._modes, np.stack([steps.sequence, steps.mode.astype(np.uint64)])])[:, -_MAX_KEPT:]
        waiting_sequence, waiting_ns, waiting_nm = self._without_step
        sequence = np.concatenate([waiting_sequence, wavefronts.sequence])
        time_ns = np.concatenate([waiting_ns, wavefronts.time_ns])
        rms_nm = np.concatenate([waiting_nm, wavefronts.rms_nm])
        closed = np.isin(sequence, self._modes[0, self._modes[1] == LoopMode.CLOSED.value])
        self._closed.add_wavefronts(time_ns[closed], rms_nm[closed], true=self._means.true)
        waiting = np.flatnonzero(~np.isin(sequence, self._modes[0]))[-_MAX_KEPT:]
        self._without_step = sequence[waiting], time_ns[waiting], rms_nm[waiting]

    def _add_modes(self, steps: Steps, period_ns: int) -> None:
        """Add the time before each step to its loop mode; a gap that a live view would report has no loop mode."""
        time_ns = steps.time_ns
        if not time_ns.size:
            return
        self._first_ns = self._first_ns or int(time_ns[0])
        after_ns = np.diff(time_ns, prepend=self._last_ns or time_ns[0])
        with_steps = (after_ns >= 0) & (after_ns <= max(FRAMES_SILENT_S * 1e9, PERIODS * period_ns))
        self._mode_ns[None] += int(after_ns[~with_steps & (after_ns > 0)].sum())
        for value in np.unique(steps.mode):
            self._mode_ns[_MODES.get(int(value))] += int(after_ns[with_steps & (steps.mode == value)].sum())
        self._last_ns = int(time_ns[-1])

    def _loop(self) -> Tile:
        total_ns, closed_ns = max(sum(self._mode_ns.values()), 1), self._mode_ns[LoopMode.CLOSED]
        share = min(100 * closed_ns / total_ns, 99.9)
        value = "CLOSED" if closed_ns == total_ns else f"{share:.3g} % CLOSED" if closed_ns else "NOT CLOSED"
        times = {mode: duration(spent_ns * 1e-9) for mode, spent_ns in self._mode_ns.items() if spent_ns}
        others = [f"{name} {times[mode]}" for mode, name in _NAMES.items() if mode in times]
        detail = ", ".join([f"closed {duration(closed_ns * 1e-9)}", *others])
        if LoopMode.SAFE in times:
            advice = f"The loop was in safe mode for {times[LoopMode.SAFE]}: see the events."
            return Tile("LOOP", value, detail, Level.WARNING, advice)
        return Tile("LOOP", value, detail, Level.GOOD if closed_ns > 0.5 * total_ns else Level.NEUTRAL)

    def _wavefront(self) -> Tile:
        residual_nm, flat_nm = self._closed.rms_nm()
        if isnan(residual_nm):
            return Tile("WAVEFRONT", "?", "never measured with the loop closed")
        worst_nm = float(np.nanmax(self._closed.wavefront()[1][:, 0]))
        factor = flat_nm / residual_nm if residual_nm else 1.0
        compared = f"{factor:.1f} x better" if factor >= 1 else "worse"
        includes_shapes = self._closed.true and self._shape_held
        shapes = " with offset and channels," if includes_shapes else ""
        kind = "true (simulated)" if self._closed.true else "measured, with noise"
        detail = (
            f"while closed,{shapes} {compared} than {rounded(flat_nm)} nm with a flat mirror; worst "
            f"{_span(self._closed)}: {rounded(worst_nm)} nm; {kind}"
        )
        level = _LEVELS[Correction.LITTLE if includes_shapes and factor < 1 else correction(residual_nm, flat_nm)]
        value, than = f"{rounded(residual_nm)} nm rms", "worse than " if level is Level.WARNING else ""
        advice = f"residual while closed {value},{shapes} {than}{rounded(flat_nm)} nm with a flat mirror"
        return Tile("WAVEFRONT", value, detail, level, advice)

    def _star(self) -> Tile:
        light = 100 * self._means.light()
        light = light[np.isfinite(light)]
        if not light.size:
            return Tile("STAR", "?", "no frame was used")
        value, dimmest = f"{np.median(light):.0f} %", f"{light.min():.0f}"
        detail = f"of the expected light; means over {_span(self._means)}: {dimmest} to {light.max():.0f} %"
        if light.min() < 100 * DIM:
            return Tile("STAR", value, detail, Level.WARNING, f"The star was dim, down to {dimmest} %.")
        return Tile("STAR", value, detail, Level.GOOD)

    def _timing(self, state: RunState) -> Tile:
        if not self._latency.count:
            return Tile("LATENCY", "?", "not measured")
        tile, durations_ns = partial(Tile, "LATENCY"), self._latency.percentiles_ns(0.5, 0.99, 1.0)
        p50, p99, largest = (f"{rounded(ns / 1e3)} us" for ns in durations_ns)
        detail = f"frame to command; 1 in 100 over {p99}, at most {largest}"
        if state.simulated:
            return tile(p50, f"{detail}; without effect in simulated time")
        late, share = state.totals["late"], state.totals["late"] / max(1, state.totals["steps"])
        if share > MANY_LATE:
            advice = f"{counted(late, 'command')}, {100 * share:.2g} %, came after the start of the next exposure."
            return tile(f"{late} LATE", f"{100 * share:.2g} %; {p50}, {detail}", Level.WARNING, advice)
        if 0 < state.snapshot.period_ns < durations_ns[1]:
            advice = f"1 command in 100 took over {p99}, longer than a frame."
            return tile(p50, f"slow: {detail}", Level.WARNING, advice)
        return tile(p50, detail, Level.GOOD)


def _span(means: SpanMeans) -> str:
    return duration(means.span_ns * 1e-9)


def _frames(state: RunState) -> Tile:
    totals = state.totals
    lost, steps = totals["skipped"] + totals["missing"], totals["steps"]
    refused = Counter({words: totals[reason] for reason, (words, _) in REFUSED.items() if totals[reason]})
    named = ", ".join(f"{count} {words}" for words, count in refused.most_common(3))
    unused, frames = lost + refused.total(), lost + steps
    detail = f"of {counted(frames, 'frame')}: {lost} lost, {refused.total()} refused{f' ({named})' if named else ''}"
    if unused >= FEW * max(frames, 1):
        advice = f"{counted(lost, 'frame')} lost, {refused.total()} refused: see the events."
        return Tile("FRAMES", f"{unused} UNUSED", detail, Level.WARNING, advice)
    rate = hertz(1e9 / state.snapshot.period_ns) if state.snapshot.period_ns else f"{steps}"
    return Tile("FRAMES", rate, detail, Level.GOOD if steps else Level.NEUTRAL)


def _mirror(state: RunState, ended: LogEnd) -> Tile:
    value, of_limit = stroke(ended.stroke_nm or 0.0, state.snapshot.stroke_nm)
    used = f"at most {value} {of_limit}" if ended.stroke_nm is not None else "stroke not known"
    if acted := {words: state.totals[reason] for reason, (words, _) in LIMITS.items() if state.totals[reason]}:
        named = ", ".join(f"{words}: {counted(count, 'time')}" for words, count in acted.items())
        advice = f"The mirror was at a limit ({named}): see the events."
        return Tile("MIRROR", "AT LIMIT", f"{named}; {used}", Level.WARNING, advice)
    if ended.stroke_nm is None:
        return Tile("MIRROR", "?", f"{used}, no limit acted")
    if ended.stroke_nm > NEAR_STROKE * (state.snapshot.stroke_nm or np.inf):
        advice = f"The mirror used {value} of its stroke at most: little was left."
        return Tile("MIRROR", value, f"{of_limit} at most: nearly all", Level.WARNING, advice)
    return Tile("MIRROR", value, f"{of_limit} at most, no limit acted", Level.GOOD)


def _log(state: RunState, ended: LogEnd) -> Tile:
    messages = max(state.totals["lost"], ended.lost)  # from the recorder's last Health, and from the end of the log
    lost, parts = counted(messages, "message"), counted(ended.damaged, "part")
    detail = f"{ended.name}, {f'{lost} lost' if messages else 'nothing lost'}"
    if ended.damaged:
        advice = f"The log is damaged, {parts} left out: see `lowfc info`."
        return Tile("LOG", "DAMAGED", f"{parts} left out; {detail}", Level.WARNING, advice)
    if ended.missing_files:
        missing = f"{counted(ended.missing_files, 'file')} missing between the first and the last"
        return Tile("LOG", "INCOMPLETE", f"{missing}; {detail}", Level.WARNING, f"The log is incomplete: {missing}.")
    if ended.no_end:
        return Tile("LOG", "NO END", f"{detail} up to here", Level.WARNING, f"{ended.no_end.capitalize()}.")
    if messages:
        advice = f"The recorder lost {lost}: disk or processor was too slow."
        return Tile("LOG", "FINISHED", detail, Level.WARNING, advice)
    return Tile("LOG", "FINISHED", detail, Level.GOOD)
