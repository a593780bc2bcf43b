"""The controller as one pure function, `advance(settings, state, input)`; a run is a fold of it over the inputs.

The live loop, replay and the tests call it with each `Input` in order of input number. Nothing here reads a clock: each
input carries its time and every value that depends on a clock (the age of a frame, the time without frames).
"""

from collections.abc import Callable, Mapping

import numpy as np

from lowfc.arrays import Single
from lowfc.control.kernel.stepping import next_command, respond, step_to_flat
from lowfc.control.kernel.tables import Estimate, Tables
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.estimator import fill_saturated, saturated_pixels
from lowfc.control.loop.inputs import (
    COUNT_BITS,
    Command,
    Frame,
    Input,
    Load,
    MirrorReport,
    MirrorShape,
    Outputs,
    PendingEvent,
    Request,
    Step,
    Tick,
)
from lowfc.control.loop.interlocks import BenchReport
from lowfc.control.loop.loading import (
    bench_reported,
    camera_reported,
    end_probe,
    in_mode,
    interlock_or_permit_cause,
    loaded,
    mirror_fault_reported,
    mirror_shape_reported,
    mode_events,
)
from lowfc.control.loop.requests import answer
from lowfc.control.loop.reservation import lease_at_frame, lease_checked
from lowfc.control.loop.safety import NOT_NEW, Limit, LoopMode, Reason, Rejection
from lowfc.control.loop.state import ActiveLoop, Settings, State

UNMEASURED = frozenset({Rejection.NO_CALIBRATION, Rejection.WRONG_SIZE})
"""Rejections after which channels and probe sequences still move in open and idle loops."""
STEPPED = "its last step is done"
"""Cause of the open mode after the frames of a request `step`."""


def advance(settings: Settings, state: State, input_: Input) -> tuple[State, Outputs]:
    """Process one input; return the next state and the messages to send.

    An input that changes nothing and produces no output returns the same state object and is not counted.
    """
    if isinstance(input_, Frame):
        return _frame(settings, state, input_)
    after, outputs = _HANDLERS[type(input_)](settings, state, input_)
    if after is not state or outputs.events:
        after = after._replace(input_number=state.input_number + 1)
    return after, outputs


def _frame(settings: Settings, state: State, frame: Frame) -> tuple[State, Outputs]:
    events: list[PendingEvent] = []
    if frame.ahead:
        return _refuse(settings, state, frame, Rejection.AHEAD, events)
    if frame.sequence <= state.frame_sequence:
        stale = Rejection.REPEATED if frame.sequence == state.frame_sequence else Rejection.OUT_OF_ORDER
        return _refuse(settings, state, frame, stale, events)
    state, loop = _after_missing_frames(state, frame, events)
    lease_ended = False
    if state.conditions.lease is not None:
        state = lease_at_frame(settings, state._replace(loop=loop), frame)
        state, lease_events = lease_checked(state, 0, frame.sequence)
        loop, lease_ended = state.loop, bool(lease_events)
        events += lease_events
    if loop is None:
        return _refuse(settings, _with_newest_frame(state, loop, frame), frame, Rejection.NO_CALIBRATION, events)
    measured = _measure(settings, state, loop, frame)
    if isinstance(measured, Rejection):
        return _refuse(settings, _with_newest_frame(state, loop, frame), frame, measured, events)
    estimate, saturated, tables = measured
    identical = state.identical_frames + 1 if estimate.same(state.estimate) else 0
    if 0 < settings.max_identical_frames < identical:
        stuck = _with_newest_frame(state, loop, frame)._replace(identical_frames=identical)
        return _refuse(settings, stuck, frame, Rejection.STUCK, events)
    error_nm, pol_nm, loop, reasons, returning_to_zero = respond(
        settings, state, loop, estimate.error_nm, frame.sequence, events, tables
    )
    if reasons:
        loop = end_probe(loop, frame.sequence, _limit_cause(reasons), events)
    if state.refused is not None:
        details: dict[str, object] = {"refused": state.refused_count, "reason": state.refused.name}
        events.append(PendingEvent("FRAMES_ACCEPTED", details))
    if reasons != state.limits_hit:
        _limit_events(state.limits_hit, reasons, events)
    reported = (*reasons, Limit.LAW_OVERRULED) if _overruled(state, loop) else reasons
    mode, command_nm, commanded = state.mode, loop.history_nm[0], state.may_command
    steps_left, stepped = max(state.steps_left - 1, 0), state.steps_left == 1
    state = State(  # constructed anew: `_replace` takes twice as long
        mode,
        loop,
        frame.sequence,
        frame.time_ns,
        state.frames_used + 1,
        limits_hit=reasons,
        commanded=commanded,
        counts=_counted(state.counts, reported),
        steps_left=steps_left,
        returning_to_zero=returning_to_zero,
        input_number=state.input_number + 1,
        estimate=estimate,
        identical_frames=identical,
        conditions=state.conditions,
    )
    if stepped:
        before, state = state, in_mode(state, LoopMode.OPEN, frame.time_ns, STEPPED)
        events += [PendingEvent("LOOP_STEPPED", {}), *mode_events(before, state)]
    step = Step(
        frame.sequence, frame.time_ns, mode, command_nm, reported, error_nm, pol_nm, estimate.flux_dn, saturated
    )
    command = _command_message(state, loop, command_nm) if commanded else None
    return state, Outputs(step, command, None, events, changed=stepped or lease_ended)


def _command_message(state: State, loop: ActiveLoop, command_nm: Single) -> Command:
    """The command of the newest frame."""
    safe = state.mode is LoopMode.SAFE
    sequence, conditions = state.frame_sequence, state.conditions
    # Before the first frame the sequence is 0. The mirror may have applied a newer one, which a new `clear_id` resets.
    clear_id = conditions.clear_id or (0 if sequence else conditions.mode_since_ns)
    return Command(sequence, state.frame_time_ns, loop.actuators_nm, command_nm, safe, clear_id)


def _after_missing_frames(state: State, frame: Frame, events: list[PendingEvent]) -> tuple[State, ActiveLoop | None]:
    """The state, and the active loop advanced by the frames missing before this one."""
    if state.frame_timeout and state.frame_time_ns:
        events.append(PendingEvent("FRAMES_BACK", {"silent_ms": (frame.time_ns - state.frame_time_ns) / 1e6}))
    loop = state.loop
    if frame.sequence >> COUNT_BITS == state.frame_sequence >> COUNT_BITS:
        missing = frame.sequence - state.frame_sequence - 1
        if missing:
            number = frame.sequence & ((1 << COUNT_BITS) - 1)
            events.append(PendingEvent("FRAMES_MISSING", {"count": missing, "number": number}))
            loop = loop.missed(missing) if loop is not None else None
        return state, loop
    if state.frame_sequence:
        events.append(PendingEvent("CAMERA_RESTARTED", {}))
        if loop is not None:  # a probe sequence's rows are numbered from the previous start
            loop = end_probe(loop, state.frame_sequence, "the camera restarted", events)
    camera = state.conditions.camera
    if camera is not None and camera.start_s not in (0, frame.sequence >> COUNT_BITS):  # settings of another start
        state = state._replace(conditions=state.conditions._replace(camera_awaited=True))
    return state, loop


def _with_newest_frame(state: State, loop: ActiveLoop | None, frame: Frame) -> State:
    """The state with this loop, and with a refused frame as the newest one."""
    return state._replace(loop=loop, frame_timeout=False, frame_sequence=frame.sequence, frame_time_ns=frame.time_ns)


def _measure(
    settings: Settings, state: State, loop: ActiveLoop, frame: Frame
) -> tuple[Estimate, int, Tables | None] | Rejection:
    """Estimate, number of saturated pixels, tables if the fused step was used; or why the frame is refused."""
    calibration = loop.calibration
    if not calibration.noll:
        return Rejection.NO_CALIBRATION
    if state.conditions.camera_awaited:
        return Rejection.CAMERA_UNKNOWN
    if state.conditions.mirror_fault and state.mode is LoopMode.CLOSED:
        return Rejection.NO_MIRROR
    if state.mode is LoopMode.CLOSED and interlock_or_permit_cause(state):
        return Rejection.HELD
    if frame.pixels is None or frame.pixels.shape != calibration.shape:
        return Rejection.WRONG_SIZE
    if frame.age_ns > settings.max_frame_age_ns:
        return Rejection.LATE
    pixels, min_flux_dn = frame.pixels.ravel(), settings.min_flux_fraction * calibration.flux_dn
    tables = loop.estimator.tables
    fused = None if tables is None else tables.estimate(pixels, min_flux_dn)
    if fused is not None:
        return fused, 0, tables
    saturated = saturated_pixels(calibration, pixels)
    if saturated > settings.max_saturated_pixels:
        return Rejection.SATURATED
    if saturated:
        pixels = fill_saturated(calibration, pixels)
    estimate = loop.estimator.estimate(pixels, min_flux_dn)
    return Rejection.DARK if estimate is None else (estimate, saturated, None)


def _overruled(state: State, loop: ActiveLoop) -> bool:
    """Whether the integrator determines part of a closed loop's command because the guard overruled the law."""
    guard = loop.law_runner.guard if loop.law_runner is not None else None
    return guard is not None and state.mode is LoopMode.CLOSED and guard.overruled


def _limit_cause(limits: tuple[Reason, ...]) -> str:
    """Why a probe sequence ends once a limit acts: the mirror no longer shows the requested shape."""
    return f"a limit acted: {', '.join(reason.name for reason in limits)}"


def _refuse(
    settings: Settings, state: State, frame: Frame, reason: Rejection, events: list[PendingEvent]
) -> tuple[State, Outputs]:
    """State and outputs after a refused frame: the command is held, except in safe mode and as `UNMEASURED` allows."""
    if reason is not state.refused:
        events.append(PendingEvent("FRAMES_REFUSED", {"reason": reason.name}))
    loop, returning_to_zero, limits_hit = state.loop, state.returning_to_zero, state.limits_hit
    held_nm = np.zeros(0, np.float32)
    reasons: tuple[Reason, ...] = (reason,)
    if loop is not None:
        if state.mode is LoopMode.SAFE:
            loop = step_to_flat(settings, loop)
        elif reason in UNMEASURED and state.mode is not LoopMode.CLOSED:
            loop, limits_hit, returning_to_zero = next_command(
                settings, state, loop.predicted(1), loop.history_nm[0], frame.sequence
            )
            if limits_hit:
                loop = end_probe(loop, frame.sequence, _limit_cause(limits_hit), events)
            _limit_events(state.limits_hit, limits_hit, events)
            reasons = (reason, *limits_hit)
        elif reason not in NOT_NEW:
            loop = loop.missed(1)
        held_nm = loop.history_nm[0]
    state = state._replace(
        loop=loop,
        refused=reason,
        refused_count=state.refused_count + 1,
        limits_hit=limits_hit,
        returning_to_zero=returning_to_zero,
        commanded=loop is not None and state.may_command,
        counts=_counted(state.counts, reasons),
        input_number=state.input_number + 1,
    )
    step = Step(frame.sequence, frame.time_ns, state.mode, held_nm, reasons)
    if loop is None or not state.commanded:
        return state, Outputs(step=step, events=events)
    # The command has the newest frame's sequence even if this frame is older: the mirror refuses older commands.
    return state, Outputs(step=step, command=_command_message(state, loop, held_nm), events=events)


def _tick(settings: Settings, state: State, tick: Tick) -> tuple[State, Outputs]:
    """Without frames, repeat the held command, so that it expires only if the controller dies; or step to flat."""
    state, events = lease_checked(state, tick.time_ns, 0)
    lease_ended = bool(events)
    loop = state.loop
    safe = state.mode is LoopMode.SAFE
    silent = state.frame_timeout or tick.silent_ns > settings.frame_timeout_ns  # true until a newer frame comes
    if loop is None or not (state.commanded or safe):
        if silent is not state.frame_timeout:
            state = state._replace(frame_timeout=silent)
        return state, Outputs(events=tuple(events), changed=lease_ended)
    flatten = silent and settings.on_frame_timeout == "flat"
    counts = state.counts
    timeout_begins = silent and not state.frame_timeout
    if timeout_begins:
        action = "relaxing the mirror to flat" if flatten else "holding the command"
        events.append(PendingEvent("NO_FRAMES", {"silent_ms": tick.silent_ns / 1e6, "action": action}))
        counts = _counted(counts, (Rejection.NO_FRAME,))
    # Otherwise the command is held, and a probe sequence requested since then waits for a frame.
    if timeout_begins or flatten:
        loop = end_probe(loop, state.frame_sequence, f"no frame for {tick.silent_ns / 1e6:.0f} ms", events)
    if flatten or safe:
        loop = step_to_flat(settings, loop)
    state = state._replace(loop=loop, frame_timeout=silent, commanded=True, counts=counts)
    return state, Outputs(command=_command_message(state, loop, loop.history_nm[0]), events=events, changed=lease_ended)


def _load(settings: Settings, state: State, load: Load) -> tuple[State, Outputs]:
    after, events = loaded(settings, state, load.calibration, load.source, load.time_ns)
    return after, Outputs(events=[*events, *mode_events(state, after)], changed=True)


def _limit_events(before: tuple[Reason, ...], now: tuple[Reason, ...], events: list[PendingEvent]) -> None:
    events.extend(PendingEvent("LIMIT_HIT", {"reason": reason.name}) for reason in now if reason not in before)
    events.extend(PendingEvent("LIMIT_CLEARED", {"reason": reason.name}) for reason in before if reason not in now)


def _counted(counts: Mapping[Reason, int], reasons: tuple[Reason, ...]) -> Mapping[Reason, int]:
    if not reasons:
        return counts
    return {**counts, **{reason: counts.get(reason, 0) + 1 for reason in reasons}}


_HANDLERS: dict[type, Callable[..., tuple[State, Outputs]]] = {
    Request: answer,
    MirrorShape: mirror_shape_reported,
    MirrorReport: mirror_fault_reported,
    CameraSettings: camera_reported,
    BenchReport: bench_reported,
    Load: _load,
    Tick: _tick,
}
