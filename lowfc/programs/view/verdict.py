"""Judgement on a run, for a person who has never seen one: is the loop closed, how good is it, is anything wrong."""

from dataclasses import dataclass
from pathlib import PurePath

import numpy as np

from lowfc.contract.codec import actuators
from lowfc.contract.messages import FRAME, STEP, Role, wire
from lowfc.control.safety import LoopMode, Reason
from lowfc.programs.view.camera_verdict import all_refused, frames, star
from lowfc.programs.view.tile import Level, Tile, ago, counted, figure
from lowfc.programs.view.watcher import GRACE_S, RECENT_S, Life, Rms, Watcher

WORSE = 1.1
"""A closed loop that leaves more than was there, by more than the scatter of a second's rms, does harm."""
LATEST_S = 0.3
"""It must still do so at the end of that second: a loop that has just begun, or caught up, is better by then."""
DIVERGING = 3.0
"""So much more than was there is no bad tuning any more: the loop is unstable, or its signs are wrong."""
NEAR_STROKE = 0.9
"""From here on a mirror has next to nothing left for what comes."""
LIMITED = 0.5
"""A limit that acts on half of the commands is no passing gust."""
MANY_LATE = 0.05
"""One late command in twenty is the host's; more of them are another delay than the one that was tuned for."""
BEHIND_S, FAR_BEHIND_S = 1.0, 5.0
"""A view is a glance old at best; a second shows, and after five it is history."""
UNCORRECTED = ("OPEN", "SAFED", "DEAD")
"""The loop as it is where nothing corrects; where it waits or has ended, that would say something else."""
_LONGEST = 110
"""Letters of a text of somebody else's that a tile has room for."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The tiles, and the worst of it in one sentence."""

    headline: str
    level: Level
    tiles: tuple[Tile, ...]


_LIMITS: dict[Reason, str] = {
    Reason.MODAL_LIMIT: "modal limit",
    Reason.STROKE: "actuator stroke",
    Reason.SLEW: "actuator slew",
    Reason.NEIGHBOUR: "neighbouring actuators",
    Reason.NOT_FINITE: "command not finite",
    Reason.WRONG_GRID: "wrong grid",
}


def judge(watcher: Watcher, nm_per_mas: float | None = None) -> Verdict:
    """Judge the last seconds.

    Args:
        watcher: fed with the moments of the run.
        nm_per_mas: wavefront rms of a tilt of 1 mas (`lowfc.optics.photometry`); without it tilt is not told.
    """
    loop = _loop(watcher)
    wavefront = _wavefront(watcher, nm_per_mas, loop)
    tiles = [
        loop,
        wavefront,
        frames(watcher),
        star(watcher),
        _mirror(watcher),
        _latency(watcher),
        _recorder(watcher),
    ]
    if watcher.behind_s > BEHIND_S:
        tiles.append(_view(watcher))
    worst = max(tiles, key=lambda tile: tile.level)  # the first of several: causes stand before what follows of them
    if worst.level >= Level.WARNING:
        return Verdict(worst.advice, worst.level, tuple(tiles))
    headline = f"{loop.advice} {wavefront.advice}" if loop.level is Level.GOOD else loop.advice
    return Verdict(headline, loop.level, tuple(tiles))


def _loop(watcher: Watcher) -> Tile:
    sign, mode = watcher.controller(), watcher.mode
    others = (watcher.camera(), watcher.mirrors())
    title = "LOOP"
    if sign.life is Life.SILENT:
        since = ago(sign.silent_s)
        if all(one.life in (Life.SILENT, Life.NEVER) for one in others):
            advice = (
                f"Nothing heard of any process for {since}: the run was killed or this view is cut off from it. "
                "Look whether its processes live."
            )
            return Tile(title, "NOTHING HEARD", f"of anybody for {since}", Level.BAD, advice)
        advice = (
            f"Controller silent for {since}: nothing is corrected, the mirror holds or relaxes by itself. "
            "See its last words, restart it."
        )
        return Tile(title, "DEAD", f"controller silent for {since}", Level.BAD, advice)
    if sign.life is Life.STOPPED:
        if all(one.life in (Life.STOPPED, Life.NEVER) for one in others):
            return Tile(title, "ENDED", "all stopped as told", Level.NEUTRAL, "The run has ended, as told.")
        return Tile(
            title, "STOPPED", "controller stopped as told", Level.NEUTRAL, "The controller was told to stop: no loop."
        )
    if sign.life is Life.NEVER or mode is None:
        if watcher.running_s > GRACE_S:
            advice = "There is no controller: nothing is corrected. Start `lowfc controller` for this run."
            return Tile(title, "NO CONTROLLER", "not heard of", Level.WARNING, advice)
        return Tile(title, "WAITING", "for the controller", Level.NEUTRAL, "Waiting for the run to start.")
    match mode:
        case LoopMode.SAFED:
            advice = "Safed: the mirror is flat and stays so until `lowfc ctl clear`; do that when it is safe."
            return Tile(title, "SAFED", watcher.why or "mirror flat, latched", Level.BAD, advice)
        case LoopMode.IDLE:
            advice = "The controller has no calibration: it refuses every frame. Give it one."
            return Tile(title, "IDLE", "no calibration", Level.WARNING, advice)
        case LoopMode.OPEN:
            return _open(watcher)
    if Life.STARTING in (sign.life, watcher.camera().life) or watcher.camera().life is Life.NEVER:
        return Tile(title, "WAITING", "closed, no frame yet", Level.NEUTRAL, "Waiting for the first frame.")
    if watcher.mirrors().life is Life.SILENT:
        return Tile(title, "CLOSED", "but the mirror is silent", Level.WARNING)
    if watcher.camera().life is Life.STOPPED:
        advice = "The camera was told to stop: the loop is closed, and holds its command."
        return Tile(title, "HOLDING", "closed, but the camera was stopped", Level.NEUTRAL, advice)
    if watcher.silent_s(FRAME) is not None:
        return Tile(title, "HOLDING", "closed, but no frames: command held", Level.WARNING)
    if watcher.silent_s(STEP) is not None:
        advice = "The controller takes no frames: the mirror holds or relaxes by itself. See its last words."
        return Tile(title, "HOLDING", "closed, but no step in the last second", Level.WARNING, advice)
    if all_refused(watcher):
        return Tile(title, "HOLDING", "closed, but every frame is refused: command held", Level.WARNING)
    return Tile(title, "CLOSED", "correcting", Level.GOOD, "Loop closed, nothing is wrong.")


def _open(watcher: Watcher) -> Tile:
    shape = "mirror holds its last shape"
    found, _ = watcher.wavefront()
    if found is not None and found.residual_nm > WORSE * found.open_nm:
        shape += ", worse than a flat mirror: `lowfc ctl safe` flattens it"
    detail = f"{watcher.why or 'measuring only'}; {shape}"
    if "camera" in watcher.why:
        advice = (
            "The loop opened by itself, the camera changed: set it back or calibrate again, then `lowfc ctl close`. "
            f"The {shape}."
        )
        return Tile("LOOP", "OPEN", detail, Level.WARNING, advice)
    advice = f"The loop is open: nothing is corrected, `lowfc ctl close` closes it. The {shape}."
    return Tile("LOOP", "OPEN", detail, Level.NEUTRAL, advice)


def _wavefront(watcher: Watcher, nm_per_mas: float | None, loop: Tile) -> Tile:
    title, ended = "WAVEFRONT", loop.value == "ENDED"
    found, true = watcher.wavefront(ended=ended)
    if found is None:
        return Tile(title, "?", "not measured now", Level.NEUTRAL)
    value = f"{figure(found.residual_nm)} nm rms"
    flat = f"{figure(found.open_nm)} nm with a flat mirror"
    more = f"{_tilt(found, nm_per_mas)}{'true' if true else 'measured, with noise'}"
    if ended:
        return Tile(title, f"last: {figure(found.residual_nm)} nm", f"of {flat}; {more}", Level.NEUTRAL)
    if loop.level is not Level.GOOD:
        compared = f"not corrected; {flat}" if loop.value in UNCORRECTED else f"of {flat}"
        return Tile(title, value, f"{compared}; {more}", Level.NEUTRAL)
    factor = found.open_nm / found.residual_nm if found.residual_nm else 1.0
    compared = f"{factor:.1f} x better than" if factor >= 1 else "of"
    detail = f"{compared} {flat}; {more}"
    good = f"{figure(found.residual_nm)} nm rms of wavefront are left of {flat}."
    latest, _ = watcher.wavefront(LATEST_S)
    if factor >= 1 / WORSE or latest is None or latest.residual_nm <= WORSE * latest.open_nm:
        return Tile(title, value, detail, Level.GOOD, good)
    level = Level.BAD if factor < 1 / DIVERGING else Level.WARNING
    detail = f"worse than {flat}; {more}"
    advice = f"The loop does harm: {figure(found.residual_nm)} nm rms, {flat}. Lower the gain or open the loop."
    return Tile(title, value, detail, level, advice)


def _mirror(watcher: Watcher) -> Tile:
    title, sign, state = "MIRROR", watcher.mirrors(), watcher.mirror
    if sign.life is Life.SILENT:
        since = ago(sign.silent_s)
        advice = f"Mirror silent for {since}: commands go nowhere. See its last words, restart it."
        return Tile(title, "DEAD", f"silent for {since}", Level.BAD, advice)
    if sign.life is Life.NEVER and watcher.running_s > GRACE_S:
        return Tile(title, "NO MIRROR", "not heard of", Level.WARNING, "There is no mirror. Start it for this run.")
    if sign.life is Life.STOPPED:
        return Tile(title, "STOPPED", "the mirror, as told", Level.NEUTRAL)
    if state is None or state.status == wire.MIRROR_STATUS_WAITING:
        return Tile(title, "WAITING", "no command yet", Level.NEUTRAL)
    if state.status == wire.MIRROR_STATUS_EXPIRED and watcher.controller().life is not Life.STARTING:
        told = watcher.controller().life is Life.STOPPED
        advice = (
            "The mirror gets no commands: the last one expired, it holds or relaxes by itself. Look at the controller."
        )
        detail = "no commands: holds or relaxes by itself"
        return Tile(title, "EXPIRED", detail, Level.NEUTRAL if told else Level.BAD, advice)
    return _stroke(watcher, state)


def _stroke(watcher: Watcher, state: wire.MirrorState) -> Tile:
    title = "MIRROR"
    surface_nm = actuators(state)
    used_nm = float(np.abs(surface_nm).max(initial=0.0)) if surface_nm is not None else 0.0
    settings = watcher.moment.controller.settings if watcher.moment and watcher.moment.controller else None
    stroke_nm = settings.stroke_nm if settings is not None else 0.0
    value = f"{100 * used_nm / stroke_nm:.0f} %" if stroke_nm else f"{used_nm:.0f} nm"
    of = f"of {stroke_nm:g} nm stroke used" if stroke_nm else "of stroke used"
    acting = {reason: watcher.recent(reason) for reason in _LIMITS}
    own_limits = [int(reason) for reason in state.limits_hit]
    own = [words for reason, words in _LIMITS.items() if reason.value in own_limits]
    if any(acting.values()) or own:
        words = [words for reason, words in _LIMITS.items() if acting[reason]] or own
        now = max((watcher.now(reason) for reason in _LIMITS), default=0)
        often = now > LIMITED * max(1, watcher.now("steps"))
        count = max(acting.values())
        advice = (
            f"The mirror is at a limit ({', '.join(words)}), {counted(count, 'time')} in the last {RECENT_S:g} s: "
            "the disturbance is larger than it can correct. Offload it, or raise the limit if that is safe."
        )
        detail = f"{', '.join(words)}: {counted(count, 'time')} in {RECENT_S:g} s; {value} {of}"
        return Tile(title, "AT LIMIT", detail, Level.BAD if often else Level.WARNING, advice)
    if stroke_nm and used_nm > NEAR_STROKE * stroke_nm:
        advice = f"The mirror has used {value} of its stroke: little is left. Offload the slow part of it."
        return Tile(title, value, f"{of}: nearly all", Level.WARNING, advice)
    return Tile(title, value, f"{of}, no limit acts", Level.GOOD)


def _latency(watcher: Watcher) -> Tile:
    title, stopped = "LATENCY", watcher.controller().life is Life.STOPPED
    durations = watcher.durations_us(ended=stopped)
    if durations is None:
        return Tile(title, "?", "not measured now", Level.NEUTRAL)
    middle_us, long_us = durations
    value, detail = f"{figure(middle_us)} us", f"frame to command; 1 in 100 over {figure(long_us)} us"
    late, steps = watcher.recent("late"), watcher.recent("steps")
    if stopped:
        return Tile(title, f"last: {value}", detail, Level.NEUTRAL)
    if watcher.simulated:
        return Tile(title, value, f"{detail}; of no effect in simulated time", Level.NEUTRAL)
    if late > MANY_LATE * max(1, steps):
        advice = (
            f"{counted(late, 'command')}, {100 * late / max(1, steps):.2g} %, came after the next exposure had begun: "
            "there is more delay than the loop is tuned for. Free the host's processors or lower the rate."
        )
        return Tile(
            title,
            f"{late} LATE",
            f"{'command' if late == 1 else 'commands'} in {RECENT_S:g} s; {value}, {detail}",
            Level.WARNING,
            advice,
        )
    if watcher.period_ns and long_us * 1e3 > watcher.period_ns:
        advice = (
            f"1 command in 100 takes over {figure(long_us)} us, longer than a frame. Free the host or lower the rate."
        )
        return Tile(title, value, f"slow: {detail}", Level.WARNING, advice)
    return Tile(title, value, detail, Level.GOOD)


def _recorder(watcher: Watcher) -> Tile:
    title, sign = "RECORDER", watcher.recorder()
    heard = watcher.moment.health.get(Role.RECORDER) if watcher.moment else None
    if heard is None:
        return Tile(title, "NONE", "nothing is recorded", Level.NEUTRAL)
    done = heard.health.recording
    if done.failure:
        advice = (
            f"Recording stopped, the loop goes on: {_short(done.failure)}. Make room and start `lowfc record` again."
        )
        return Tile(title, "FAILED", _short(done.failure), Level.BAD, advice)
    if sign.life is Life.SILENT:
        since = ago(sign.silent_s)
        advice = f"Recorder silent for {since}: the run is not recorded, the loop goes on. Start `lowfc record` again."
        return Tile(title, "DEAD", f"silent for {since}: nothing is recorded", Level.BAD, advice)
    if sign.life is Life.STOPPED:
        return Tile(title, "STOPPED", f"{_short(PurePath(done.file).stem)} is complete", Level.NEUTRAL)
    if lost := watcher.recent("lost"):
        messages = counted(lost, "message")
        advice = f"The recorder lost {messages} in the last {RECENT_S:g} s: disk or processor is too slow for it."
        return Tile(title, "LOSING", f"{messages} in {RECENT_S:g} s, {done.lost} in all", Level.BAD, advice)
    if not done.file:
        return Tile(title, "WAITING", "no log yet", Level.NEUTRAL)
    losses = f"{counted(done.lost, 'message')} lost" if done.lost else "nothing lost"
    return Tile(title, "RECORDING", f"{_short(PurePath(done.file).stem)}, {losses}", Level.GOOD)


def _view(watcher: Watcher) -> Tile:
    behind = ago(watcher.behind_s)
    advice = f"This view is {behind} behind: what it shows is old. The loop does not suffer; close other programs."
    level = Level.BAD if watcher.behind_s > FAR_BEHIND_S else Level.WARNING
    return Tile("VIEW", behind, "behind the loop", level, advice)


def _tilt(found: Rms, nm_per_mas: float | None) -> str:
    if not nm_per_mas or not found.tilt_open_nm:
        return ""
    residual, before = (figure(one / nm_per_mas) for one in (found.tilt_residual_nm, found.tilt_open_nm))
    return f"tilt {residual} of {before} mas per axis; "


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
