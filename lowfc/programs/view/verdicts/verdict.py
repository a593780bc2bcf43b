"""Judgement on a run, for a person who has never seen one: is the loop closed, how good is it, is anything wrong."""

from datetime import UTC, datetime
from pathlib import PurePath

from lowfc.contract.messages import FRAME, STEP, Role, from_timestamp, wire
from lowfc.contract.printable import printable
from lowfc.control.loop.safety import Limit, LoopMode, Reason
from lowfc.control.loop.wording import counted
from lowfc.programs.view.verdicts.camera_verdict import all_refused, frames, star
from lowfc.programs.view.verdicts.facts import facts
from lowfc.programs.view.verdicts.tile import Level, Tile, Verdict, ago, figure, short, worst_of
from lowfc.programs.view.verdicts.watcher import GRACE_S, RECENT_S, Liveness, Watcher
from lowfc.programs.view.verdicts.wavefront_verdict import WORSE, wavefront

NEAR_STROKE = 0.9
"""From here on a mirror has next to nothing left for what comes."""
LIMITED = 0.5
"""A limit that acts on half of the commands is no passing gust."""
MANY_LATE = 0.05
"""One late command in twenty is the host's; more of them are another delay than the one that was tuned for."""
BEHIND_S, FAR_BEHIND_S = 1.0, 5.0
"""A view is a glance old at best; a second shows, and after five it is history."""


LIMITS: dict[Reason, str] = {
    Limit.MODAL_LIMIT: "modal limit",
    Limit.STROKE: "actuator stroke",
    Limit.SLEW: "actuator slew",
    Limit.NEIGHBOUR: "neighbouring actuators",
    Limit.NOT_FINITE: "command not finite",
    Limit.WRONG_GRID: "wrong grid",
}


def judge(watcher: Watcher, nm_per_mas: float | None = None) -> Verdict:
    """Judge the last seconds.

    Args:
        watcher: fed with the snapshots of the run.
        nm_per_mas: wavefront rms of a tilt of 1 mas (`lowfc.optics.detector.photometry`); without it tilt is left out.
    """
    loop = _loop(watcher)
    left = wavefront(watcher, nm_per_mas, loop)
    tiles = [loop, left, frames(watcher), star(watcher), _mirror(watcher), _latency(watcher), _recorder(watcher)]
    if watcher.snapshot.behind_s > BEHIND_S:
        tiles.append(_view(watcher.snapshot.behind_s))
    worst = worst_of(tiles)
    headline, level = worst.advice, worst.level
    if worst.level < Level.WARNING:
        headline, level = loop.advice, loop.level
        if loop.level is Level.GOOD and left.advice:
            wrong = ", nothing is wrong" if left.level is Level.GOOD else ""
            headline, level = f"Loop closed{wrong}. {left.advice}", left.level
    return Verdict(headline, level, tuple(tiles), facts(watcher))


def _loop(watcher: Watcher) -> Tile:
    title, controller, mode = "LOOP", watcher.process(Role.CONTROLLER), watcher.mode
    camera, mirror = watcher.process(Role.CAMERA), watcher.mirrors()
    if controller.life is Liveness.SILENT:
        since = ago(controller.silent_s)
        if {camera.life, mirror.life} <= {Liveness.SILENT, Liveness.NEVER}:
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
    if controller.life is Liveness.STOPPED:
        if {camera.life, mirror.life} <= {Liveness.STOPPED, Liveness.NEVER}:
            return Tile(title, "ENDED", "all processes stopped on request", Level.NEUTRAL, "The run has ended.")
        advice = "The controller was stopped: no loop runs."
        return Tile(title, "STOPPED", "controller stopped on request", Level.NEUTRAL, advice)
    if controller.life is Liveness.NEVER or mode is None:
        if watcher.running_s > GRACE_S:
            advice = "There is no controller: nothing is corrected. Start `lowfc controller` for this run."
            return Tile(title, "NO CONTROLLER", "no message from it", Level.WARNING, advice)
        return Tile(title, "WAITING", "for the controller", Level.NEUTRAL, "Waiting for the run to start.")
    if mode is LoopMode.SAFE:
        advice = (
            "Loop in safe mode: the mirror is flat and stays flat until `lowfc ctl clear`; do that when it is safe."
        )
        return Tile(title, "SAFE", watcher.why or "mirror flat, latched", Level.BAD, advice)
    if mode is LoopMode.IDLE:
        advice = "The controller has no calibration: it refuses every frame. Give it one."
        return Tile(title, "IDLE", "no calibration", Level.WARNING, advice)
    if mode is LoopMode.OPEN:
        return _open(watcher)
    if Liveness.STARTING in (controller.life, camera.life) or camera.life is Liveness.NEVER:
        return Tile(title, "WAITING", "closed, no frame yet", Level.NEUTRAL, "Waiting for the first frame.")
    fault = watcher.snapshot.controller.mirror_fault if watcher.snapshot.controller is not None else ""
    if fault:
        return Tile(title, "HOLDING", f"closed, but the mirror {fault}: command held", Level.WARNING)
    if mirror.life is Liveness.SILENT:  # in logs of version 0.1 it is not missed
        return Tile(title, "CLOSED", "but the mirror is silent", Level.WARNING)
    if camera.life is Liveness.STOPPED:
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
    state = watcher.snapshot.controller
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
    level = Level.NEUTRAL
    advice = f"The loop is open: nothing is corrected, `lowfc ctl close` closes it. The {shape}."
    if "camera" in watcher.why:
        level = Level.WARNING
        advice = (
            "The loop opened by itself, the camera changed: set it back or calibrate again, then `lowfc ctl close`. "
            f"The {shape}."
        )
    return Tile("LOOP", "OPEN", f"{watcher.why or 'measuring only'}; {shape}", level, advice)


def _mirror(watcher: Watcher) -> Tile:
    title, mirror, state = "MIRROR", watcher.mirrors(), watcher.mirror
    if mirror.life is Liveness.SILENT:
        since = ago(mirror.silent_s)
        advice = f"Mirror silent for {since}: commands go nowhere. See its last output, restart it."
        return Tile(title, "DEAD", f"silent for {since}", Level.BAD, advice)
    if mirror.life is Liveness.NEVER and watcher.running_s > GRACE_S:
        advice = "There is no mirror. Start it for this run."
        return Tile(title, "NO MIRROR", "no message from it", Level.WARNING, advice)
    if mirror.life is Liveness.STOPPED:
        return Tile(title, "STOPPED", "the mirror, on request", Level.NEUTRAL)
    if state is None or state.status == wire.MIRROR_STATUS_WAITING:
        return Tile(title, "WAITING", "no command yet", Level.NEUTRAL)
    controller = watcher.process(Role.CONTROLLER).life
    if state.status == wire.MIRROR_STATUS_EXPIRED and controller is not Liveness.STARTING:
        level = Level.NEUTRAL if controller is Liveness.STOPPED else Level.BAD
        advice = (
            "The mirror receives no commands: the last one has expired, it holds or relaxes by itself. "
            "Look at the controller."
        )
        return Tile(title, "EXPIRED", "no commands: holds or relaxes by itself", level, advice)
    used_nm, limit_nm = watcher.stroke_nm(), watcher.snapshot.stroke_nm
    value, of = stroke(used_nm, limit_nm)
    acting = {reason: watcher.recent(reason) for reason in LIMITS}
    own = [words for reason, words in LIMITS.items() if reason.value in list(map(int, state.limits_hit))]
    if any(acting.values()) or own:
        words = ", ".join([words for reason, words in LIMITS.items() if acting[reason]] or own)
        often = max(map(watcher.now, LIMITS)) > LIMITED * max(1, watcher.now("steps"))
        times = counted(max(acting.values()), "time")
        advice = (
            f"The mirror is at a limit ({words}), {times} in the last {RECENT_S:g} s: "
            "the disturbance is larger than it can correct. Offload it, or raise the limit if that is safe."
        )
        detail = f"{words}: {times} in {RECENT_S:g} s; {value} {of}"
        return Tile(title, "AT LIMIT", detail, Level.BAD if often else Level.WARNING, advice)
    if limit_nm and used_nm > NEAR_STROKE * limit_nm:
        advice = f"The mirror has used {value} of its stroke: little is left. Offload the slow part of it."
        return Tile(title, value, f"{of}: nearly all", Level.WARNING, advice)
    return Tile(title, value, f"{of}, no limit acts", Level.GOOD)


def stroke(used_nm: float, limit_nm: float) -> tuple[str, str]:
    """The stroke used, and of what; the limit is 0 where it is not known."""
    if limit_nm:
        return f"{100 * used_nm / limit_nm:.0f} %", f"of {limit_nm:g} nm stroke used"
    return f"{used_nm:.0f} nm", "of stroke used"


def _latency(watcher: Watcher) -> Tile:
    title, stopped = "LATENCY", watcher.process(Role.CONTROLLER).life is Liveness.STOPPED
    durations = watcher.durations_us(ended=stopped)
    if durations is None:
        return Tile(title, "?", "not measured now", Level.NEUTRAL)
    middle_us, long_us = durations
    value, detail = f"{figure(middle_us)} us", f"frame to command; 1 in 100 over {figure(long_us)} us"
    late, steps = watcher.recent("late"), max(1, watcher.recent("steps"))
    if stopped:
        return Tile(title, f"last: {value}", detail, Level.NEUTRAL)
    if watcher.simulated:
        return Tile(title, value, f"{detail}; of no effect in simulated time", Level.NEUTRAL)
    if late > MANY_LATE * steps:
        advice = (
            f"{counted(late, 'command')}, {100 * late / steps:.2g} %, came after the next exposure had begun: "
            "there is more delay than the loop is tuned for. Free the host's processors or lower the rate."
        )
        what = f"{'command' if late == 1 else 'commands'} in {RECENT_S:g} s; {value}, {detail}"
        return Tile(title, f"{late} LATE", what, Level.WARNING, advice)
    if watcher.period_ns and long_us * 1e3 > watcher.period_ns:
        advice = f"1 command in 100 takes over {figure(long_us)} us, longer than a frame."
        return Tile(title, value, f"slow: {detail}", Level.WARNING, f"{advice} Free the host or lower the rate.")
    return Tile(title, value, detail, Level.GOOD)


def _recorder(watcher: Watcher) -> Tile:
    title, recorder = "RECORDER", watcher.process(Role.RECORDER)
    last = watcher.snapshot.health.get(Role.RECORDER)
    if last is None:
        return Tile(title, "NONE", "there is no recorder: nothing is recorded", Level.NEUTRAL)
    done = last.health.recording
    log = short(PurePath(done.file).stem)
    if done.failure:
        advice = f"Recording failed, the loop goes on: {short(done.failure)}. Make room and start `lowfc record` again."
        return Tile(title, "FAILED", short(done.failure), Level.BAD, advice)
    if recorder.life is Liveness.SILENT:
        since = ago(recorder.silent_s)
        advice = f"Recorder silent for {since}: the run is not recorded, the loop goes on. Start `lowfc record` again."
        return Tile(title, "DEAD", f"silent for {since}: nothing is recorded", Level.BAD, advice)
    if recorder.life is Liveness.STOPPED:
        alone = watcher.process(Role.CONTROLLER).life in (Liveness.RUNNING, Liveness.STARTING)
        detail = f"{log} is complete; nothing is recorded now" if alone else f"{log} is complete"
        advice = "The recorder was stopped, the loop goes on: nothing is recorded. Start `lowfc record` again."
        return Tile(title, "STOPPED", detail, Level.WARNING if alone else Level.NEUTRAL, advice)
    if done.stopped:
        advice = "Recording was stopped by an operator: the night is not kept. `lowfc ctl record start` goes on."
        return Tile(title, "STOPPED", f"not recording since {log} was finished", Level.WARNING, advice)
    if lost := watcher.recent("lost"):
        messages = counted(lost, "message")
        advice = f"The recorder lost {messages} in the last {RECENT_S:g} s: disk or processor is too slow for it."
        return Tile(title, "LOSING", f"{messages} in {RECENT_S:g} s, {done.lost} in all", Level.BAD, advice)
    if not done.file:
        return Tile(title, "WAITING", "no log yet", Level.NEUTRAL)
    losses = f"{counted(done.lost, 'message')} lost" if done.lost else "nothing lost"
    return Tile(title, "RECORDING", f"{log}, {losses}", Level.GOOD)


def _view(behind_s: float) -> Tile:
    advice = (
        f"This view is {ago(behind_s)} behind: what it shows is old. The loop does not suffer; close other programs."
    )
    level = Level.BAD if behind_s > FAR_BEHIND_S else Level.WARNING
    return Tile("VIEW", ago(behind_s), "behind the loop", level, advice)
