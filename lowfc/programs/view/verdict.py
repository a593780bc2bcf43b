"""Judgement on a run, for a person who has never seen one: is the loop closed, how good is it, is anything wrong."""

from dataclasses import dataclass
from datetime import UTC, datetime

from lowfc.contract.messages import FRAME, STEP, from_timestamp, wire
from lowfc.contract.printable import printable
from lowfc.control.safety import LoopMode, Reason
from lowfc.programs.view.camera_verdict import all_refused, frames, star
from lowfc.programs.view.facts import Fact, facts
from lowfc.programs.view.recorder_verdict import recorder
from lowfc.programs.view.tile import Level, Tile, ago, counted, figure, short
from lowfc.programs.view.watcher import GRACE_S, RECENT_S, Life, Watcher
from lowfc.programs.view.wavefront_verdict import WORSE, wavefront

NEAR_STROKE = 0.9
"""From here on a mirror has next to nothing left for what comes."""
LIMITED = 0.5
"""A limit that acts on half of the commands is no passing gust."""
MANY_LATE = 0.05
"""One late command in twenty is the host's; more of them are another delay than the one that was tuned for."""
BEHIND_S, FAR_BEHIND_S = 1.0, 5.0
"""A view is a glance old at best; a second shows, and after five it is history."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The tiles, and the worst of it in one sentence."""

    headline: str
    level: Level
    tiles: tuple[Tile, ...]
    facts: tuple[Fact, ...] = ()


LIMITS: dict[Reason, str] = {
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
    left = wavefront(watcher, nm_per_mas, loop)
    tiles = [
        loop,
        left,
        frames(watcher),
        star(watcher),
        _mirror(watcher),
        _latency(watcher),
        recorder(watcher),
    ]
    if watcher.behind_s > BEHIND_S:
        tiles.append(_view(watcher))
    worst = max(tiles, key=lambda tile: tile.level)  # the first of several: causes stand before what follows of them
    headline, level = worst.advice, worst.level
    if worst.level < Level.WARNING:
        headline, level = loop.advice, loop.level
        if loop.level is Level.GOOD and left.advice:
            headline = f"{'Loop closed, nothing is wrong' if left.level is Level.GOOD else 'Loop closed'}. "
            headline, level = headline + left.advice, left.level
    return Verdict(headline, level, tuple(tiles), facts(watcher))


def _loop(watcher: Watcher) -> Tile:
    sign, mode = watcher.controller(), watcher.mode
    others = (watcher.camera(), watcher.mirrors())
    title = "LOOP"
    if sign.life is Life.SILENT:
        since = ago(sign.silent_s)
        if all(one.life in (Life.SILENT, Life.NEVER) for one in others):
            advice = (
                f"No message from any process for {since}: the run was killed, or this view is cut off from it. "
                "Check that its processes run."
            )
            return Tile(title, "NO MESSAGES", f"from any process for {since}", Level.BAD, advice)
        advice = (
            f"Controller silent for {since}: nothing is corrected, the mirror holds or relaxes by itself. "
            "See its last output, restart it."
        )
        return Tile(title, "DEAD", f"controller silent for {since}", Level.BAD, advice)
    if sign.life is Life.STOPPED:
        if all(one.life in (Life.STOPPED, Life.NEVER) for one in others):
            return Tile(title, "ENDED", "all processes stopped on request", Level.NEUTRAL, "The run has ended.")
        return Tile(
            title,
            "STOPPED",
            "controller stopped on request",
            Level.NEUTRAL,
            "The controller was stopped: no loop runs.",
        )
    if sign.life is Life.NEVER or mode is None:
        if watcher.running_s > GRACE_S:
            advice = "There is no controller: nothing is corrected. Start `lowfc controller` for this run."
            return Tile(title, "NO CONTROLLER", "no message from it", Level.WARNING, advice)
        return Tile(title, "WAITING", "for the controller", Level.NEUTRAL, "Waiting for the run to start.")
    match mode:
        case LoopMode.SAFED:
            advice = (
                "Loop in safe mode: the mirror is flat and stays flat until `lowfc ctl clear`; do that when it is safe."
            )
            return Tile(title, "SAFE", watcher.why or "mirror flat, latched", Level.BAD, advice)
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
        advice = "The camera was stopped: the loop is closed and holds its command."
        return Tile(title, "HOLDING", "closed, but the camera was stopped", Level.NEUTRAL, advice)
    if watcher.silent_s(FRAME) is not None:
        return Tile(title, "HOLDING", "closed, but no frames: command held", Level.WARNING)
    if watcher.silent_s(STEP) is not None:
        advice = "The controller processes no frames: the mirror holds or relaxes by itself. See its last output."
        return Tile(title, "HOLDING", "closed, but no step in the last second", Level.WARNING, advice)
    if all_refused(watcher):
        return Tile(title, "HOLDING", "closed, but every frame is refused: command held", Level.WARNING)
    return Tile(title, "CLOSED", f"correcting{_since(watcher)}", Level.GOOD, "Loop closed, nothing is wrong.")


def _since(watcher: Watcher) -> str:
    """Since when the loop mode is as it is, where the controller reports it."""
    state = watcher.moment.controller if watcher.moment else None
    if state is None or not state.HasField("mode_timestamp") or state.mode != wire.LOOP_MODE_CLOSED:
        return ""
    since = datetime.fromtimestamp(from_timestamp(state.mode_timestamp) * 1e-9, UTC)
    cause = f" ({short(printable(state.mode_cause))})" if state.mode_cause else ""
    return f" since {since:%H:%M:%S}{cause}"


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


def _mirror(watcher: Watcher) -> Tile:
    title, sign, state = "MIRROR", watcher.mirrors(), watcher.mirror
    if sign.life is Life.SILENT:
        since = ago(sign.silent_s)
        advice = f"Mirror silent for {since}: commands go nowhere. See its last output, restart it."
        return Tile(title, "DEAD", f"silent for {since}", Level.BAD, advice)
    if sign.life is Life.NEVER and watcher.running_s > GRACE_S:
        return Tile(
            title, "NO MIRROR", "no message from it", Level.WARNING, "There is no mirror. Start it for this run."
        )
    if sign.life is Life.STOPPED:
        return Tile(title, "STOPPED", "the mirror, on request", Level.NEUTRAL)
    if state is None or state.status == wire.MIRROR_STATUS_WAITING:
        return Tile(title, "WAITING", "no command yet", Level.NEUTRAL)
    if state.status == wire.MIRROR_STATUS_EXPIRED and watcher.controller().life is not Life.STARTING:
        told = watcher.controller().life is Life.STOPPED
        advice = (
            "The mirror receives no commands: the last one has expired, it holds or relaxes by itself. "
            "Look at the controller."
        )
        detail = "no commands: holds or relaxes by itself"
        return Tile(title, "EXPIRED", detail, Level.NEUTRAL if told else Level.BAD, advice)
    return _stroke(watcher, state)


def _stroke(watcher: Watcher, state: wire.MirrorState) -> Tile:
    title = "MIRROR"
    used_nm = watcher.stroke_nm()
    settings = watcher.moment.controller.settings if watcher.moment and watcher.moment.controller else None
    stroke_nm = settings.stroke_nm if settings is not None else 0.0
    value = f"{100 * used_nm / stroke_nm:.0f} %" if stroke_nm else f"{used_nm:.0f} nm"
    of = f"of {stroke_nm:g} nm stroke used" if stroke_nm else "of stroke used"
    acting = {reason: watcher.recent(reason) for reason in LIMITS}
    own_limits = [int(reason) for reason in state.limits_hit]
    own = [words for reason, words in LIMITS.items() if reason.value in own_limits]
    if any(acting.values()) or own:
        words = [words for reason, words in LIMITS.items() if acting[reason]] or own
        now = max((watcher.now(reason) for reason in LIMITS), default=0)
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


def _view(watcher: Watcher) -> Tile:
    behind = ago(watcher.behind_s)
    advice = f"This view is {behind} behind: what it shows is old. The loop does not suffer; close other programs."
    level = Level.BAD if watcher.behind_s > FAR_BEHIND_S else Level.WARNING
    return Tile("VIEW", behind, "behind the loop", level, advice)
