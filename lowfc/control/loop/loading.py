"""Changes of calibration, mirror, camera or loop mode; the mirror keeps its shape, but relaxes to flat in safe mode."""

from dataclasses import replace

import numpy as np

from lowfc.arrays import Single
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.camera import CameraSettings, changes
from lowfc.control.loop.command_channels import ADOPTED, Channel
from lowfc.control.loop.inputs import MirrorReport, MirrorShape, Outputs, PendingEvent
from lowfc.control.loop.interlocks import IN_WORDS, Action, BenchReport, judged, refusal
from lowfc.control.loop.safety import LoopMode, limit
from lowfc.control.loop.state import ActiveLoop, Settings, State
from lowfc.control.loop.wording import CAMERA_MISFIT, MEASURED_FIRST

ADOPTED_NM = 1.0
"""Largest deviation from the modal command's shape that is ignored, nm of surface; a larger one becomes a channel."""
REFUSED_IN_A_ROW = 3
"""A closed loop counts as holding its command once this number of frames in a row is refused."""
LATCHED = "it was in safe mode before the controller started"
MIRROR_WAS_SAFE = "the mirror's last command was sent in safe mode"


def loaded(
    settings: Settings, state: State, calibration: Calibration, source: str, time_ns: int
) -> tuple[State, list[PendingEvent]]:
    """The state with another calibration, and its events without those of the loop mode, which the caller adds.

    If the mirror has the same grid, it keeps its shape: the channels stay, the rest becomes a command of the new modes,
    and the part outside the modes becomes a channel (not in safe mode). A probe sequence ends, and the next command
    removes its last shape; gains, offset and law are kept only for the same modes.
    """
    loop, before = ActiveLoop.at_rest(settings, calibration), state.loop
    details: dict[str, object] = {
        "id": calibration.id[:12],
        "modes": len(calibration.noll),
        "estimator": calibration.estimator,
        "source": source,
    }
    events = [PendingEvent("CALIBRATION_LOADED", details)]
    if before is not None and before.actuators_nm.shape == calibration.grid:
        before = end_probe(before, state.frame_sequence, "a calibration was loaded", events)
        shape_nm = before.actuators_nm
        same = before.calibration.noll == calibration.noll
        if before.command_channels is not None:
            shape_nm = shape_nm - before.command_channels.sum_nm
            if before.play is not None:  # the next command removes its last shape
                shape_nm = (before.to_actuators @ before.history_nm[0]).reshape(calibration.grid)
            command_channels = loop.channels_or_empty()._replace(play=before.play)
            command_channels = command_channels.with_all(before.command_channels.channels, loop.to_modes)
            if same:
                command_channels = command_channels._replace(offset_nm=before.command_channels.offset_nm)
            loop = loop._replace(command_channels=command_channels.settled())
        command_nm = loop.inverse @ shape_nm.reshape(-1)
        loop = loop._replace(
            integrator=before.integrator if same else loop.integrator,
            automatic=before.automatic if same else loop.automatic,
            law_runner=before.law_runner if same else None,
            actuators_nm=before.actuators_nm,
            history_nm=(command_nm,) * len(loop.history_nm),
        )
        if state.mode is not LoopMode.SAFE:  # in safe mode the mirror relaxes to flat and stays there
            loop, adoption_events = adopted(loop, shape_nm)
            events += adoption_events
    before_mode, cause = state.mode, "a calibration was loaded"
    mode = settings.start_mode if before_mode is LoopMode.IDLE else before_mode
    if mode is LoopMode.SAFE:
        cause = LATCHED
    state = state._replace(loop=loop)
    # A loop that an interlock holds may stay closed.
    acting = tuple(interlock for interlock in state.conditions.acting if interlock.action is not Action.HOLD)
    if mode is not LoopMode.SAFE and (wrong := uncalibrated_cause(state)):
        mode, cause = LoopMode.IDLE, wrong
    elif mode is LoopMode.CLOSED and (wrong := misfit_cause(state)):
        mode, cause = LoopMode.OPEN, f"{CAMERA_MISFIT}: {wrong}"
    elif mode is LoopMode.CLOSED and (wrong := refusal(acting, "close")):
        mode, cause = LoopMode.OPEN, wrong
    elif before_mode is LoopMode.IDLE and mode is LoopMode.CLOSED and loop.automatic.any():
        mode, cause = LoopMode.OPEN, MEASURED_FIRST
    return (state if mode is before_mode else in_mode(state, mode, time_ns, cause)), events


def safe_pending(settings: Settings, state: State) -> bool:
    """Whether safe mode was latched before the start, and is entered once mirror or calibration is known."""
    return settings.start_mode is LoopMode.SAFE and state.loop is None and not state.conditions.clear_id


def misfit_cause(state: State) -> str:
    """Why the camera's last received settings do not fit the calibration; empty if they do.

    A calibration without camera settings fits any camera settings with its shape and saturation.
    """
    camera, loop = state.conditions.camera, state.loop
    if camera is None or loop is None or not loop.calibration.noll:
        return ""
    calibration = loop.calibration
    calibrated = loop.camera or replace(camera, shape=calibration.shape, saturation_dn=calibration.saturation_dn)
    return "; ".join(changes(camera, calibrated))


def uncalibrated_cause(state: State) -> str:
    """Why no mode can be measured: no calibration, or one computed for another frame size; empty otherwise."""
    loop, camera = state.loop, state.conditions.camera
    hint = ": measure a calibration with `lowfc commission`"
    if loop is None or not loop.calibration.noll:
        return f"no calibration is loaded{hint}"
    rows, columns = loop.calibration.shape
    if camera is None or camera.shape == (rows, columns) or not loop.calibration.operator_hash:
        return ""
    frames = "{} x {}".format(*camera.shape)
    return f"the computed calibration is for frames of {rows} x {columns} pixels, the camera's are {frames}{hint}"


def holding_cause(state: State) -> str:
    """Why a closed loop would hold its command at present; empty if it would correct."""
    if state.conditions.mirror_fault:
        return f"the mirror {state.conditions.mirror_fault}"
    if state.frame_timeout:
        return "no frame comes"
    if why := interlock_or_permit_cause(state):
        return why
    if state.refused is not None and state.refused_count >= REFUSED_IN_A_ROW:
        return f"frames are refused as {state.refused.name}"
    return ""


def interlock_or_permit_cause(state: State) -> str:
    """Interlock or permit that holds the command of a closed loop; empty if there is none."""
    acting, lease = state.conditions.acting, state.conditions.lease
    if lease is not None and lease.holds and not lease.ended:
        return f"it is held for {lease.holder}"
    for interlock in acting:
        if interlock.action is Action.HOLD:
            return f"an interlock acts: {interlock.why}"
    return ""


def bench_reported(settings: Settings, state: State, report: BenchReport) -> tuple[State, Outputs]:
    """Evaluate the interlocks on a bench value; an interlock may open the loop, but none closes it.

    Before the first used frame, `refuse_close` also opens a loop that started closed. While the gains are measured,
    `open` and `refuse_close` keep the loop from closing by itself afterwards.
    """
    before = state.conditions.acting
    after = judged(settings.interlocks, before, report)
    if after is before:
        return state, Outputs()
    begun = [interlock for interlock in after if interlock not in before]
    events = [
        PendingEvent("INTERLOCK_ACTS", {"why": interlock.why, "action": IN_WORDS[interlock.action]})
        for interlock in begun
    ]
    acting_now = {interlock.number for interlock in after}
    events += [
        PendingEvent("INTERLOCK_CLEARED", {"why": interlock.why})
        for interlock in before
        if interlock.number not in acting_now
    ]
    state = state._replace(conditions=state.conditions._replace(acting=after))
    opening = (Action.OPEN,) if state.frames_used and not state.waits_for_gains else (Action.OPEN, Action.REFUSE_CLOSE)
    for interlock in begun:
        mode, cause = state.mode, f"an interlock acts: {interlock.why}"
        if interlock.action is Action.SAFE:
            mode = LoopMode.SAFE
        elif interlock.action in opening and mode is LoopMode.CLOSED:
            mode = LoopMode.OPEN
        elif interlock.action in opening and state.waits_for_gains:  # the loop no longer closes by itself
            state = state._replace(conditions=state.conditions._replace(mode_cause=cause))
        state = _changed(state, mode, report.time_ns, cause, events)
    return state, Outputs(events=events, changed=True)


def mirror_shape_reported(settings: Settings, state: State, shape: MirrorShape) -> tuple[State, Outputs]:
    """Start from the mirror's shape, so that it does not jump; after the first command, shapes change nothing."""
    if state.commanded:
        return state, Outputs()
    events: list[PendingEvent] = []
    loop, safe_cause = state.loop, MIRROR_WAS_SAFE if shape.safe else ""
    if loop is None:  # probe sequences and channels need no calibration
        loop = ActiveLoop.at_rest(settings, Calibration.none(shape.actuators_nm.shape))
        events.append(PendingEvent("NOT_CALIBRATED", {"why": uncalibrated_cause(state)}))
        safe_cause = safe_cause or (LATCHED if safe_pending(settings, state) else "")
    if safe_cause:
        state = _changed(state, LoopMode.SAFE, shape.time_ns, safe_cause, events)
        loop = state.loop or loop  # without the channels that safe mode removes
    grid, finite = loop.calibration.grid, np.isfinite(shape.actuators_nm)
    wrong = "" if finite.all() else f"{np.sum(~finite)} of its {finite.size} actuators have no finite position"
    if shape.actuators_nm.shape != grid:
        wrong = f"the mirror has a grid of {shape.actuators_nm.shape}, the calibration {grid}"
    if wrong:
        events.append(PendingEvent("MIRROR_REFUSED", {"why": wrong}))
        return state, Outputs(events=events, changed=bool(safe_cause))
    limit_nm = loop.integrator.limit_nm
    plausible = shape.command_nm.shape == limit_nm.shape and (np.abs(shape.command_nm) <= limit_nm).all()
    command_nm = shape.command_nm if plausible else loop.inverse @ shape.actuators_nm.reshape(-1)
    loop = loop._replace(actuators_nm=shape.actuators_nm, history_nm=(command_nm,) * len(loop.history_nm))
    if command_nm.any():
        events.append(PendingEvent("MIRROR_ADOPTED", {"rms_nm": float(np.sqrt(command_nm @ command_nm))}))
    if state.mode is not LoopMode.SAFE:  # in safe mode the mirror relaxes to flat and stays there
        channels = loop.command_channels  # clients may have set channels before a late report
        loop, adoption_events = adopted(
            loop, shape.actuators_nm if channels is None else shape.actuators_nm - channels.sum_nm
        )
        events += adoption_events
    return state._replace(loop=loop), Outputs(events=events, changed=True)


def mirror_fault_reported(settings: Settings, state: State, report: MirrorReport) -> tuple[State, Outputs]:
    """Hold the command while the mirror does not follow; a closed loop returns to the mirror's last shape.

    A return of more than the slew limit takes several reports.
    """
    fault, loop = report.fault, state.loop
    changed = fault != state.conditions.mirror_fault
    events: list[PendingEvent] = []
    if changed:
        events.append(PendingEvent("MIRROR_LOST", {"fault": fault}) if fault else PendingEvent("MIRROR_BACK", {}))
    if loop is not None and fault:
        if changed:
            loop = end_probe(loop, state.frame_sequence, f"the mirror {fault}", events)
        if changed and loop.law_runner is not None:
            loop = loop._replace(law_runner=loop.law_runner.restarted())
        if state.mode is LoopMode.CLOSED and report.shape is not None:
            loop = _step_back(settings, loop, report.shape.actuators_nm)
    if not changed and loop is state.loop:
        return state, Outputs()
    conditions = state.conditions._replace(mirror_fault=fault)
    return state._replace(loop=loop, conditions=conditions), Outputs(events=events, changed=True)


def _step_back(settings: Settings, loop: ActiveLoop, shape_nm: Single) -> ActiveLoop:
    """Move the command towards a shape (rows, columns) of the mirror."""
    if shape_nm.shape != loop.calibration.grid:
        return loop
    limited_nm = limit(settings.limits, loop.actuators_nm, shape_nm).actuators_nm
    if np.array_equal(limited_nm, loop.actuators_nm):
        return loop
    modal_nm: Single = limited_nm if loop.command_channels is None else limited_nm - loop.command_channels.sum_nm
    command_nm = loop.inverse @ modal_nm.reshape(-1)
    return loop._replace(actuators_nm=limited_nm, history_nm=(command_nm,) * len(loop.history_nm))


def end_probe(loop: ActiveLoop, sequence: int, why: str, events: list[PendingEvent]) -> ActiveLoop:
    """End the probe sequence after this frame, unless it has no further row."""
    if loop.play is None or loop.play.finished(sequence + 1):
        return loop
    events.append(PendingEvent("PLAY_ENDED", {"why": why}))
    return loop.stopped(sequence)


def camera_reported(settings: Settings, state: State, camera: CameraSettings) -> tuple[State, Outputs]:
    """Store the camera's settings; open a closed loop if they do not fit.

    Before the first used frame, the loop is idle while `uncalibrated_cause` gives a cause.
    """
    after = _with_camera(state, camera)
    if after is state:
        return state, Outputs()
    wrong = misfit_cause(after)
    events: list[PendingEvent] = []
    mode, cause = after.mode, "the camera's frames fit the calibration"
    if wrong and wrong != misfit_cause(state):
        events.append(PendingEvent("CAMERA_CHANGED", {"what": wrong}))
        cause = f"{CAMERA_MISFIT}: {wrong}"
        if after.waits_for_gains:
            after = after._replace(conditions=after.conditions._replace(mode_cause=cause))
    if mode is not LoopMode.SAFE and uncalibrated_cause(after) and not after.frames_used:
        mode = LoopMode.IDLE
    elif (mode is LoopMode.CLOSED and wrong) or (mode is LoopMode.IDLE and not uncalibrated_cause(after)):
        mode = LoopMode.OPEN
    after = _changed(after, mode, camera.time_ns, cause, events)
    return after, Outputs(events=events, changed=True)


def _with_camera(state: State, camera: CameraSettings) -> State:
    """The state with newly received camera settings; the same object if they are unchanged."""
    loop, conditions = state.loop, state.conditions
    if camera != conditions.camera or conditions.camera_awaited:
        state = state._replace(conditions=conditions._replace(camera=camera, camera_awaited=False))
    if loop is not None and loop.calibration.noll and loop.camera is None and not misfit_cause(state):
        state = state._replace(loop=loop._replace(camera=camera))
    return state


def adopted(loop: ActiveLoop, shape_nm: Single) -> tuple[ActiveLoop, list[PendingEvent]]:
    """Adopt as a channel the part of a shape (rows, columns) that the modal command does not make, unless tiny."""
    deviation_nm = shape_nm.copy()
    deviation_nm -= (loop.to_actuators @ loop.history_nm[0]).reshape(deviation_nm.shape)
    if not np.abs(deviation_nm).max() > ADOPTED_NM:
        return loop, []
    channels = loop.channels_or_empty()
    before = channels.channel(ADOPTED)
    channel_nm = deviation_nm if before is None else before.shape_nm + deviation_nm
    channels = channels.with_channel(Channel(ADOPTED, channel_nm, channel_nm), loop.to_modes).settled()
    rms_nm = float(np.sqrt(np.mean(np.square(deviation_nm))))
    loop = loop._replace(command_channels=channels)
    return loop, [PendingEvent("SHAPE_ADOPTED", {"rms_nm": rms_nm})]


def in_mode(state: State, mode: LoopMode, time_ns: int, cause: str) -> State:
    """Change the loop mode; a probe sequence, a `step` request and a return to zero end.

    Safe mode removes the channels except the flat map and `EXTERNAL`; a law fades in when the loop closes.
    """
    loop = state.loop
    if loop is not None and mode is not state.mode:
        loop = loop.stopped(state.frame_sequence)
        if loop.command_channels is not None and mode is LoopMode.SAFE:
            channels = loop.command_channels.restarted_from_flat(loop.to_modes, only_flat=True)
            loop = loop._replace(command_channels=channels)
        if loop.law_runner is not None and mode is LoopMode.CLOSED:
            loop = loop._replace(law_runner=loop.law_runner.taking_over())
    same, conditions = mode is state.mode, state.conditions
    conditions = conditions if same else conditions._replace(mode_since_ns=time_ns, mode_cause=cause)
    return state._replace(
        mode=mode, loop=loop, steps_left=0, returning_to_zero=state.returning_to_zero and same, conditions=conditions
    )


def _changed(state: State, mode: LoopMode, time_ns: int, cause: str, events: list[PendingEvent]) -> State:
    """Change the loop mode and add the events of the change, unless the loop is in this mode already."""
    if mode is state.mode:
        return state
    after = in_mode(state, mode, time_ns, cause)
    events += mode_events(state, after)
    return after


def mode_events(before: State, after: State) -> list[PendingEvent]:
    """The events of a change of the loop mode; none if it is unchanged."""
    if after.mode is before.mode:
        return []
    why = after.conditions.mode_cause
    changed = PendingEvent("MODE_CHANGED", {"before": before.mode.in_words, "after": after.mode.in_words, "why": why})
    return [changed, PendingEvent("SAFED", {"why": why})] if after.mode is LoopMode.SAFE else [changed]
