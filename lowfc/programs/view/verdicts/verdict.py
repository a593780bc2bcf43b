"""Verdict on a run, for an operator new to such loops: whether the loop is closed, how well it works, what is wrong.

`judge` is a pure function from the state of the last seconds to tiles.
"""

from functools import partial
from pathlib import PurePath

import numpy as np

from lowfc.contract.codecs.codec import actuators
from lowfc.contract.messages import Role, from_timestamp, wire
from lowfc.control.loop.safety import Limit, LoopMode, Reason, Rejection, reason_name
from lowfc.control.loop.wording import CAMERA_MISFIT, MEASURED_FIRST, counted
from lowfc.programs.cli.correction import MANY_LATE, NEAR_STROKE, Correction, correction
from lowfc.programs.view.verdicts.camera_verdict import all_refused, frames, star
from lowfc.programs.view.verdicts.facts import facts
from lowfc.programs.view.verdicts.run_state import Liveness, RunState
from lowfc.programs.view.verdicts.tile import Level, Tile, Verdict, absent, clock, duration, rounded, short, worst_of
from lowfc.programs.view.verdicts.wavefront_verdict import contrast, wavefront

LIMITED = 0.5
"""Fraction of limited commands above which the limit is not transient."""
BEHIND_S, FAR_BEHIND_S = 1.0, 5.0
"""Delay of the view for a warning, and for an alarm."""

LIMITS: dict[Reason, tuple[str, str]] = {
    Limit.MODAL_LIMIT: (
        "modal limit",
        "centre the star, offload the slow part of the command, or raise the limit with `lowfc ctl limit`",
    ),
    Limit.STROKE: (
        "actuator stroke",
        "offload the slow part of the command, or use a better flat map or smaller channels",
    ),
    Limit.SLEW: ("actuator slew", "nothing to do if the loop has just been closed or reset; otherwise lower the gain"),
    Limit.NEIGHBOUR: ("neighbouring actuators", "use smaller channels, and look for a stuck actuator"),
    Limit.NOT_FINITE: ("command not finite", "check calibration and law"),
    Limit.WRONG_GRID: ("wrong grid", "load the calibration of this mirror"),
}
"""Limits that act on a command: text and advice."""

_REFUSED_COMMAND: dict[int, str] = {
    Rejection.NO_MIRROR: "Its driver failed: see the last warning in `lowfc ctl status`.",
    Rejection.OUT_OF_ORDER: "A second controller may command it: stop all controllers but one.",
    Rejection.AHEAD: "Set the clocks of both hosts and restart the controller.",
    Limit.WRONG_GRID: "Set mirror.rows and mirror.columns, or load the calibration of this mirror.",
    Limit.NOT_FINITE: "Check calibration and law.",
    Limit.CHANNEL: "Too many programs command it: end one of them.",
}
"""Advice for each reason for which a mirror refuses commands."""


def judge(state: RunState, nm_per_mas: float | None = None) -> Verdict:
    """Judge the last seconds; tilt is left out without `nm_per_mas`, the wavefront rms of a tilt of 1 mas."""
    loop = _loop(state)
    residual = wavefront(state, nm_per_mas, loop)
    tiles = [loop, residual, frames(state), star(state), _mirror(state), _latency(state), _recorder(state)]
    reported = {role: state.snapshot.health.get(role) for role in (Role.CAMERA, Role.CONTROLLER)}
    recent_wavefronts = {role: one.health.recent_wavefront for role, one in reported.items() if one is not None}
    if role := next((role for role, recent in recent_wavefronts.items() if recent.costliest_modes), None):
        measured_now = state.wavefront is not None
        tiles.insert(2, contrast(recent_wavefronts[role], now=measured_now, estimated=role is Role.CONTROLLER))
    if state.snapshot.behind_s > BEHIND_S:
        tiles.append(_view(state.snapshot.behind_s))
    worst = worst_of(tiles)
    headline, level = worst.advice, worst.level
    if worst.level < Level.WARNING:
        headline, level = loop.advice, loop.level
        if loop.level is Level.GOOD and residual.advice:
            wrong = ", nothing is wrong" if residual.level is Level.GOOD else ""
            headline, level = f"Loop closed{wrong}. {residual.advice}", residual.level
    return Verdict(headline, level, tuple(tiles), facts(state))


def _loop(state: RunState) -> Tile:
    tile, mode = partial(Tile, "LOOP"), state.mode
    controller, camera, mirror = state.controller, state.camera, state.mirror
    others, reported = {camera.life, mirror.life}, state.snapshot.controller
    if controller.life is Liveness.SILENT and others <= {Liveness.SILENT, Liveness.NEVER}:
        since = duration(controller.silent_s)
        advice = f"No message from any process for {since}: the run was killed, or this view has lost its connection. "
        return tile("NO MESSAGES", f"for {since}", Level.BAD, f"{advice}Check that its processes run.")
    if controller.life is Liveness.STOPPED and others <= {Liveness.STOPPED, Liveness.NEVER}:
        return tile("ENDED", "all processes stopped on request", advice="The run has ended.")
    harm = "nothing is corrected, the mirror holds or relaxes by itself"
    gone = absent("LOOP", "controller", controller, state.running_s, harm)
    if gone is not None or mode is None:
        return gone or tile("WAITING", "for the controller")
    if mode is LoopMode.SAFE:
        advice = "Loop in safe mode: the mirror stays flat until `lowfc ctl clear`; do that when it is safe."
        return tile("SAFE", state.mode_cause or "mirror flat, latched", Level.BAD, advice)
    if mode is LoopMode.IDLE:
        advice = "There is no calibration for these frames: the controller refuses every frame. Load or measure one."
        return tile("IDLE", state.mode_cause or "no calibration", Level.WARNING, advice)
    if mode is LoopMode.OPEN:
        return _open(state)
    if Liveness.STARTING in (controller.life, camera.life) or camera.life is Liveness.NEVER:
        return tile("WAITING", "closed, no frame yet", advice="Waiting for the first frame.")
    if held := _held(reported):
        advice = f"The loop is closed but does not correct: {held}."
        return tile("HOLDING", f"closed, but not correcting: {held}", Level.WARNING, advice)
    if mirror.life is Liveness.SILENT:  # only in logs of version 0.1, whose states have no `mirror_fault`
        return tile("CLOSED", "but the mirror is silent", Level.WARNING)
    if camera.life is Liveness.STOPPED:
        advice = "The camera was stopped: the loop is closed but does not correct."
        return tile("HOLDING", "closed, but the camera was stopped", advice=advice)
    if state.frame_silent_s is not None:
        return tile("HOLDING", "closed, but not correcting: no frames", Level.WARNING)
    if state.step_silent_s is not None:
        advice = "The controller processes no frames: the mirror holds or relaxes by itself. Check its last output."
        return tile("HOLDING", "closed, but no step in the last second", Level.WARNING, advice)
    if all_refused(state):
        advice = "Every frame is refused: the loop is closed and holds its command."
        return tile("HOLDING", "closed, but not correcting: every frame is refused", Level.WARNING, advice)
    if state.now[Limit.LAW_OVERRULED]:
        advice = (
            "The law has a larger residual than the integrator, which took over. Tune again: `lowfc tune --live 20`."
        )
        return tile("CLOSED", "the integrator in place of the law", Level.WARNING, advice)
    return tile("CLOSED", f"correcting{_since(reported)}", Level.GOOD, "Loop closed, nothing is wrong.")


def _held(state: wire.ControllerState | None) -> str:
    """Reason why a closed loop holds: the mirror, a lease or an interlock; empty if it does not hold."""
    if state is None:
        return ""
    if state.mirror_fault:
        return f"the mirror {short(state.mirror_fault)}"
    if state.lease.holds and not state.lease.ended:
        return f"reserved for {short(state.lease.holder)}"
    return next((short(one.why) for one in state.interlocks_acting if one.action == "hold"), "")


def _since(state: wire.ControllerState | None) -> str:
    if state is None or not state.HasField("mode_timestamp") or state.mode != wire.LOOP_MODE_CLOSED:
        return ""
    since = clock(from_timestamp(state.mode_timestamp))
    return f" since {since}" + (f" ({short(state.mode_cause)})" if state.mode_cause else "")


def _open(state: RunState) -> Tile:
    shape, rms = "mirror holds its last shape", state.wavefront
    if rms is not None and correction(rms.residual_nm, rms.open_nm) is Correction.HARM:
        shape += ", worse than a flat mirror: `lowfc ctl safe` relaxes it to flat"
    level, advice = Level.NEUTRAL, "The loop is open: nothing is corrected, `lowfc ctl close` closes it."
    if state.mode_cause == MEASURED_FIRST:
        advice = "The loop is open until its gains are measured, and then closes by itself."
    if state.mode_cause.startswith(CAMERA_MISFIT):
        level = Level.WARNING
        advice = f"The loop opened by itself, as {CAMERA_MISFIT}: restore it or calibrate, then `lowfc ctl close`."
    return Tile("LOOP", "OPEN", f"{state.mode_cause or 'measuring only'}; {shape}", level, f"{advice} The {shape}.")


def _mirror(state: RunState) -> Tile:
    tile, reported = partial(Tile, "MIRROR"), state.mirror_state
    gone = absent("MIRROR", "mirror", state.mirror, state.running_s, "commands have no effect")
    if gone is not None:
        return gone
    if reported is None:
        return tile("?", "its state is not known")
    if reported.refused and reported.status != wire.MIRROR_STATUS_FOLLOWING:
        why = reason_name(reported.refused)
        remedy = _REFUSED_COMMAND.get(int(reported.refused), "See the events.")
        advice = f"The mirror refuses the commands ({why}): it holds or relaxes by itself. {remedy}"
        return tile("REFUSES", f"the commands: {why}", Level.BAD, advice)
    if reported.status == wire.MIRROR_STATUS_WAITING:
        return tile("WAITING", "no command yet")
    if reported.status == wire.MIRROR_STATUS_EXPIRED and state.controller.life is not Liveness.STARTING:
        level = Level.NEUTRAL if state.controller.life is Liveness.STOPPED else Level.BAD
        advice = "The mirror receives no commands: the last one has expired, it holds or relaxes by itself. "
        return tile("EXPIRED", "no commands: holds or relaxes by itself", level, f"{advice}Check the controller.")
    used_nm, limit_nm = stroke_used_nm(reported), state.snapshot.stroke_nm
    value, of_limit = stroke(used_nm, limit_nm)
    acting = {reason: state.recent[reason] for reason in LIMITS if state.recent[reason]}
    own = [reason for reason in LIMITS if reason.value in reported.limits_hit]
    if acting or own:
        words = ", ".join(LIMITS[reason][0] for reason in acting or own)
        how = f"{counted(max(acting.values()), 'time')} {state.lately}" if acting else "by its own limits"
        often = max(state.now[reason] for reason in LIMITS) > LIMITED * max(1, state.now["steps"])
        commonest = max(acting or own, key=lambda reason: state.recent[reason])
        advice = f"The mirror is at a limit ({words}), {how}: {LIMITS[commonest][1]}."
        return tile("AT LIMIT", f"{words}: {how}; {value} {of_limit}", Level.BAD if often else Level.WARNING, advice)
    if limit_nm and used_nm > NEAR_STROKE * limit_nm:
        advice = f"The mirror has used {value} of its stroke: little is left. Offload the slow part of the command."
        return tile(value, f"{of_limit}: nearly all", Level.WARNING, advice)
    return tile(value, f"{of_limit}, no limit acts", Level.GOOD)


def stroke_used_nm(mirror: wire.MirrorState) -> float:
    """Largest deviation of an actuator from flat; 0 if the mirror's message cannot be read."""
    surface_nm = actuators(mirror)
    return float(np.abs(surface_nm).max(initial=0.0)) if surface_nm is not None else 0.0


def stroke(used_nm: float, limit_nm: float) -> tuple[str, str]:
    """Texts of the stroke used and of its limit; `limit_nm` is 0 if unknown."""
    if limit_nm:
        return f"{100 * used_nm / limit_nm:.0f} %", f"of {limit_nm:g} nm stroke used"
    return f"{used_nm:.0f} nm", "of stroke used"


def _latency(state: RunState) -> Tile:
    tile = partial(Tile, "LATENCY")
    if state.latency_us is None:
        return tile("?", "not measured now")
    p50, p99 = map(rounded, state.latency_us)
    value, detail = f"{p50} us", f"frame to command; 1 in 100 over {p99} us"
    late, share = state.recent["late"], state.recent["late"] / max(1, state.recent["steps"])
    if state.controller.life is Liveness.STOPPED:
        return tile(f"last: {value}", detail)
    if state.simulated:
        return tile(value, f"{detail}; without effect in simulated time")
    if share > MANY_LATE:
        advice = (
            f"{counted(late, 'command')}, {100 * share:.2g} %, came after the start of the next exposure: "
            "the delay is longer than the loop is tuned for. Free the host's processors or lower the rate."
        )
        explanation = f"{'command' if late == 1 else 'commands'} {state.lately}; {value}, {detail}"
        return tile(f"{late} LATE", explanation, Level.WARNING, advice)
    if 0 < state.snapshot.period_ns < state.latency_us[1] * 1e3:
        advice = f"1 command in 100 takes over {p99} us, longer than a frame. Free the host or lower the rate."
        return tile(value, f"slow: {detail}", Level.WARNING, advice)
    return tile(value, detail, Level.GOOD)


def _recorder(state: RunState) -> Tile:
    tile, recorder, last = partial(Tile, "RECORDER"), state.recorder, state.snapshot.health.get(Role.RECORDER)
    if last is None:
        return tile("NONE", "there is no recorder: nothing is recorded")
    recording = last.health.recording
    log, failure = map(short, (PurePath(recording.file).stem, recording.failure))
    if failure:
        advice = f"Recording failed, the loop goes on: {failure}. Remove the cause, such as a full disk, then "
        advice += "`lowfc ctl record start`."
        return tile("FAILED", failure, Level.BAD, advice)
    gone = absent("RECORDER", "recorder", recorder, state.running_s, "nothing is recorded, the loop goes on")
    if gone is not None and recorder.life is Liveness.SILENT:
        return gone
    if recorder.life is Liveness.STOPPED:
        if state.controller.life not in (Liveness.RUNNING, Liveness.STARTING):
            return tile("STOPPED", f"{log} is complete")
        advice = "The recorder was stopped, the loop goes on: nothing is recorded. Restart `lowfc record`."
        return tile("STOPPED", f"{log} is complete; nothing is recorded now", Level.WARNING, advice)
    if recording.stopped:
        advice = "Recording was stopped by an operator: nothing is recorded. `lowfc ctl record start` resumes."
        return tile("STOPPED", f"not recording since {log} was finished", Level.WARNING, advice)
    if state.recent["lost"]:
        messages = counted(state.recent["lost"], "message")
        advice = f"The recorder lost {messages} {state.lately}: disk or processor is too slow."
        return tile("LOSING", f"{messages} {state.lately}, {recording.lost} in all", Level.BAD, advice)
    if not recording.file:
        return tile("WAITING", "no log yet")
    losses = f"{counted(recording.lost, 'message')} lost" if recording.lost else "nothing lost"
    return tile("RECORDING", f"{log}, {losses}", Level.GOOD)


def _view(behind_s: float) -> Tile:
    since, level = duration(behind_s), Level.BAD if behind_s > FAR_BEHIND_S else Level.WARNING
    advice = f"This view is {since} behind and shows old data. The loop is not affected; close other programs."
    return Tile("VIEW", since, "behind the loop", level, advice)
