"""Operators' requests: the effect of each on the state, and its reply.

A request is applied completely, between two frames, or refused with a reason and no change.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lowfc.arrays import Single
from lowfc.control.laws.margins import check_law
from lowfc.control.loop import interlocks
from lowfc.control.loop.command_channels import EXTERNAL, FLAT, MIRROR, CommandChannels, Play, play_table
from lowfc.control.loop.gains import change_integrator, check_offset, offset_remark, per_mode, prepare_gains
from lowfc.control.loop.inputs import Outputs, PendingEvent, Reply, Request
from lowfc.control.loop.lease import ENDED_BY, Lease, refusal, request_cause
from lowfc.control.loop.loading import (
    holding_cause,
    in_mode,
    loaded,
    misfit_cause,
    mode_events,
    safe_pending,
    uncalibrated_cause,
)
from lowfc.control.loop.reservation import lease, lease_checked, lease_ended, permit, release, renew
from lowfc.control.loop.safety import MAX_LIMIT_NM, Limits, LoopMode, Rejection, neighbour_difference_nm, request_mode
from lowfc.control.loop.state import ActiveLoop, LawRunner, Settings, State
from lowfc.control.loop.wording import AUTO, MAX_NOTE_LENGTH, PAUSED, counted

MAX_STEPS = 1 << 32  # largest number of frames of a request `step`
MAX_REPLY_LENGTH = 1000
"""Largest number of characters of a reply."""


def answer(settings: Settings, state: State, request: Request) -> tuple[State, Outputs]:
    """The state after a request, and its reply; a refused request changes nothing but is counted."""
    request = prepared(settings, request)
    now, expiry_events = lease_checked(state, request.time_ns, 0)
    lease_before = now.conditions.lease
    try:
        after, text, *events = _handler(request, lease_before)(settings, now, request)
    except ValueError as error:
        why = str(error)
        why = why if len(why) <= MAX_REPLY_LENGTH else f"{why[: MAX_REPLY_LENGTH - 3]}..."
        refused = Reply(False, why, state.frame_sequence + 1)
        return state._replace(), Outputs(reply=refused)  # a copy, since the same object is not counted
    by_another = lease_before is not None and lease_before.id != request.lease_id
    if request.name == "safe" or (request.name in ENDED_BY and by_another):
        after, lease_events = lease_ended(after, request_cause(lease_before, request))
        events += lease_events
        text += "".join(f"; this ended the reservation for {event.details['holder']}" for event in lease_events)
    events += mode_events(state, after)
    changed, reply = after is not state, Reply(True, text, state.frame_sequence + 1)
    outputs = Outputs(reply=reply, events=(*expiry_events, *events), changed=changed)
    return (after if changed else state._replace()), outputs


def _handler(request: Request, lease_before: Lease | None) -> "Handler":
    """Handler of a request; ValueError with the reason if a lease or `prepared` refuses it, or its name is unknown."""
    if request.name not in _HANDLERS:
        raise ValueError(f"unknown request {request.name[:40]!r}; there are {', '.join(REQUESTS)}")
    refused = refusal(lease_before, request.name, request.lease_id, request.time_ns) or request.refusal
    if refused:
        raise ValueError(refused)
    return _HANDLERS[request.name]


def prepared(settings: Settings, request: Request) -> Request:
    """Do the slow checks of a request that need no state; the process calls this where no frame waits for it.

    A fault becomes the request's `refusal`. A request that is prepared already is returned unchanged.
    """
    if request.prepared:
        return request
    try:
        if request.law is not None:
            check_law(request.law, settings.delay_frames, settings.rate_hz)
        if request.name in ("gain", "leak"):
            prepare_gains(settings, request)
        if request.name == "play":
            request = replace(request, played=play_table(request.text, request.table, request.actuators_nm.reshape(-1)))
    except ValueError as error:
        request = replace(request, refusal=str(error))
    return replace(request, prepared=True)


Handled = tuple[State, str, *tuple[PendingEvent, ...]]  # the state after a request, its reply, events
Handler = Callable[[Settings, State, Request], Handled]


def _status(settings: Settings, state: State, request: Request) -> Handled:
    return state, state.mode.in_words


def _mode(settings: Settings, state: State, request: Request) -> Handled:
    """Requests open, close, safe, clear and pause; a paused loop is open, and holds its command until closed again."""
    name = "open" if request.name == "pause" else request.name
    after = _granted(state, name)
    if request.name == "clear":  # resets the newest sequence here and, by `clear_id`, in the mirror
        conditions = state.conditions._replace(clear_id=request.time_ns)
        state = state._replace(frame_sequence=0, conditions=conditions)
    reply, paused = _REPLIES[request.name], state.conditions.mode_cause == PAUSED
    cause = request_cause(state.conditions.lease, request)
    if request.name == "pause" and state.mode is LoopMode.OPEN and not paused:
        reply = "the loop is open already, and holds the command"
    if request.name == "close" and state.mode is LoopMode.CLOSED and not state.steps_left:
        reply = "the loop stays closed"
    if request.name == "close" and request.text.startswith(f"{AUTO}: ") and not state.waits_for_gains:
        raise ValueError("the loop no longer waits for its gains")
    # In both cases the mode is open already, so `in_mode` would keep the former cause.
    if (request.name == "open" and paused) or (after is LoopMode.OPEN and state.waits_for_gains):
        state = state._replace(conditions=state.conditions._replace(mode_cause=cause))
    if after is LoopMode.CLOSED and state.loop is not None and state.loop.calibration.provisional:
        reply += (
            "; its calibration is the first one of a commissioning and has no verdict: `lowfc commission --resume` "
            "makes the next, `lowfc ctl load FILE` puts another one in use"
        )
    if after is LoopMode.IDLE:
        reply = f"loop idle: {uncalibrated_cause(state)}"
    return in_mode(state, after, request.time_ns, cause), reply


def _granted(state: State, name: str) -> LoopMode:
    """The mode after a request; ValueError with the reason if it is refused."""
    missing = uncalibrated_cause(state)
    after, why = request_mode(state.mode, name, calibrated=not missing)
    if why := why or interlocks.refusal(state.conditions.acting, name):
        raise ValueError(missing if name == "close" and missing else why)
    if after is LoopMode.CLOSED:
        _check_closable(state)
    return after


_REPLIES = {
    "open": "loop open",
    "pause": "loop paused: the command is held until `lowfc ctl close`",
    "close": "loop closed",
    "safe": "loop in safe mode",
    "clear": "loop open",
}


def _check_closable(state: State) -> None:
    """Refuse to close a loop that would only hold its command."""
    _check_camera(state)
    why = holding_cause(state)
    if why and state.refused in (Rejection.OUT_OF_ORDER, Rejection.REPEATED):
        why += " (`lowfc ctl safe` and then `lowfc ctl clear` reset the newest sequence)"
    if why:
        raise ValueError(f"{why}: correct this first, the closed loop would only hold its command")


def _check_camera(state: State) -> None:
    wrong = misfit_cause(state)
    if wrong:
        raise ValueError(
            f"the camera does not fit the calibration ({wrong}): set it back, or load a calibration made with it"
        )
    if state.conditions.camera_awaited:
        raise ValueError("the camera restarted, and its settings have not been received yet: try again")


def _step(settings: Settings, state: State, request: Request) -> Handled:
    frames = request.values[0] if len(request.values) == 1 else 0.0
    if not (1 <= frames <= MAX_STEPS and frames == int(frames)):
        given = " ".join(map("{:g}".format, request.values)) or "none"
        raise ValueError(f"step takes one whole number of frames from 1 to {MAX_STEPS}; got {given}")
    state = in_mode(state, _granted(state, "close"), request.time_ns, request_cause(state.conditions.lease, request))
    return state._replace(steps_left=int(frames)), f"loop closed for {counted(int(frames), 'frame')}"


def _reset(settings: Settings, state: State, request: Request) -> Handled:
    loop = _calibrated_loop(state)
    if state.mode is LoopMode.SAFE:
        raise ValueError("the loop is in safe mode: the mirror relaxes to flat anyway")
    if loop.law_runner is not None:
        loop = loop._replace(law_runner=loop.law_runner.restarted())
    return state._replace(loop=loop, returning_to_zero=True), "the modal command goes to zero"


def _integrator(settings: Settings, state: State, request: Request) -> Handled:
    """Requests gain, leak and limit."""
    loop, text, *events = change_integrator(settings, _calibrated_loop(state), request)
    return state._replace(loop=loop), text, *events


def _offset(settings: Settings, state: State, request: Request) -> Handled:
    loop = _calibrated_loop(state)
    channels = loop.channels_or_empty()
    with_values = request if request.values else replace(request, values=(0.0,))
    values = per_mode(loop.calibration.noll, with_values, channels.offset_nm)
    check_offset(loop, np.abs(values))
    text = " ".join(f"{value:g}" for value in values.tolist())
    after = _with_channels(state, loop, channels._replace(offset_nm=values))
    return after, f"offset is now {text} nm{offset_remark(loop, values)}"


def _channel(settings: Settings, state: State, request: Request) -> Handled:
    loop = _active_loop(state)
    if state.mode is LoopMode.SAFE and request.text not in (FLAT, EXTERNAL):
        raise ValueError("the loop is in safe mode: `lowfc ctl clear` first, when it is safe")
    grid = loop.calibration.grid
    shape_nm = np.zeros(grid, np.float32)
    if request.actuators_nm.size:
        if request.actuators_nm.size != shape_nm.size:
            raise ValueError(f"a channel has {grid[0]} x {grid[1]} actuators, got {request.actuators_nm.size}")
        shape_nm = request.actuators_nm.reshape(grid)
    _check_shape(None if request.text == EXTERNAL else settings.limits, shape_nm)
    before = loop.channels_or_empty()
    channels = before.with_shape(request.text, shape_nm, loop.to_modes)
    if not request.actuators_nm.size and before.channel(request.text) is None:
        names = ", ".join(channel.name for channel in before.channels)
        raise ValueError(f"there is no channel {request.text!r} to remove; there are {names or 'none'}")
    commanded = (channel.shape_nm for channel in channels.channels if channel.commanded)
    _check_shape(settings.limits, sum(commanded, np.zeros(grid, np.float32)), "with the other channels, ")
    rms_nm = float(np.sqrt(np.mean(np.square(shape_nm, dtype=np.float64))))
    return _with_channels(state, loop, channels), f"channel {request.text}: {rms_nm:.3g} nm rms of surface"


def _play(settings: Settings, state: State, request: Request) -> Handled:
    loop = _active_loop(state)
    if state.mode is LoopMode.SAFE:
        raise ValueError("the loop is in safe mode: `lowfc ctl clear` first, when it is safe")
    if not state.frame_sequence:
        raise ValueError("a probe sequence starts at a frame, and no frame has arrived yet")
    if state.conditions.mirror_fault:
        raise ValueError(f"the mirror {state.conditions.mirror_fault}: it would not follow a probe sequence")
    channels = loop.channels_or_empty()
    if channels.play is not None and not channels.play.finished(state.frame_sequence + 1):
        raise ValueError("a probe sequence is being played already: `lowfc ctl stop` ends it")
    table = request.played
    assert table is not None  # noqa: S101  # `prepared` has made it
    if table.target == MIRROR:
        grid = loop.calibration.grid
        if table.basis.shape[1] != grid[0] * grid[1]:
            actuators = f"{grid[0]} x {grid[1]} actuators per column of its table"
            raise ValueError(f"a probe sequence needs {actuators}, got {table.basis.shape[1]}")
        if table.reach_nm > settings.limits.stroke_nm:
            stroke = f"the stroke of {settings.limits.stroke_nm:g} nm"
            raise ValueError(f"the probe sequence may exceed {stroke}: an actuator may go to {table.reach_nm:.4g} nm")
    else:
        modes = len(loop.calibration.noll)
        if len(table.largest) != modes:
            raise ValueError(
                f"a probe sequence on the offset has {modes} columns, one per mode; got {len(table.largest)}"
            )
        check_offset(loop, table.largest)
    frames = len(table.rows)
    play = Play(table, state.frame_sequence + 1, frames)
    after = _with_channels(state, loop, channels._replace(play=play))
    return after, f"playing {counted(frames, 'frame')} on the {table.target}"


def _stop(settings: Settings, state: State, request: Request) -> Handled:
    loop = state.loop
    play = None if loop is None else loop.play
    if loop is None or play is None or play.finished(state.frame_sequence + 1):
        return state, "no probe sequence is being played"
    remaining = play.remaining(state.frame_sequence + 1)
    text = f"probe sequence stopped on the {play.table.target}: {remaining} of {play.frames} frames were left"
    return state._replace(loop=loop.stopped(state.frame_sequence)), text


def _law(settings: Settings, state: State, request: Request) -> Handled:
    loop = _calibrated_loop(state)
    if request.law is None:
        return state._replace(loop=loop._replace(law_runner=None)), "the integrator drives the mirror"
    _check_camera(state)
    law = request.law
    if law.noll != loop.calibration.noll:
        raise ValueError(f"the law is for modes {list(law.noll)}, the loop has {list(loop.calibration.noll)}")
    loop = loop._replace(law_runner=LawRunner.at_rest(law, guarded=settings.guard))
    return state._replace(loop=loop), f"the law {law.name!r} takes over from the integrator"


def _load(settings: Settings, state: State, request: Request) -> Handled:
    if request.calibration is None:
        raise ValueError("the request has no calibration")
    if state.mode is LoopMode.CLOSED:
        raise ValueError("the loop is closed: open it before loading another calibration")
    before = state.loop
    if before is not None and before.calibration.grid != request.calibration.grid:
        raise ValueError(
            f"the calibration is for a mirror of {request.calibration.grid} actuators, this one has "
            f"{before.calibration.grid}"
        )
    if not safe_pending(settings, state):  # an idle loop opens, whatever the configured mode
        settings = replace(settings, start_mode=LoopMode.OPEN)
    after, events = loaded(settings, state, request.calibration, "operator", request.time_ns)
    loop = _active_loop(after)  # an offset may exceed a limit that was lowered later: this is no reason to refuse
    check_offset(loop, np.minimum(np.abs(loop.channels_or_empty().offset_nm), loop.integrator.limit_nm))
    return after, f"calibration {request.calibration.id[:12]}", *events


def _note(settings: Settings, state: State, request: Request) -> Handled:
    text = request.text.strip()
    if not 0 < len(text) <= MAX_NOTE_LENGTH:
        raise ValueError(f"a note has 1 to {MAX_NOTE_LENGTH} characters, got {len(text)}")
    return state, "noted", PendingEvent("NOTE", {"text": text})


def _active_loop(state: State) -> ActiveLoop:
    """The active loop, with or without a calibration."""
    if state.loop is None:
        raise ValueError("no mirror has reported its shape yet, and no calibration is loaded")
    return state.loop


def _calibrated_loop(state: State) -> ActiveLoop:
    if state.loop is None or not state.loop.calibration.noll:
        raise ValueError("no calibration is loaded, so there are no modes yet")
    return state.loop


def _with_channels(state: State, loop: ActiveLoop, command_channels: CommandChannels) -> State:
    return state._replace(loop=loop._replace(command_channels=command_channels))


def _check_shape(limits: Limits | None, shape_nm: Single, prefix: str = "") -> None:
    """Refuse a channel, or a sum of channels, that exceeds the mirror's limits even without a command of the law."""
    if not (np.abs(shape_nm) <= MAX_LIMIT_NM).all():
        raise ValueError(f"every actuator of a channel must be finite, and at most {MAX_LIMIT_NM:g} nm from flat")
    if limits is None:  # the shape is already on the mirror
        return
    largest_nm, difference_nm = float(np.abs(shape_nm).max()), neighbour_difference_nm(shape_nm)
    if largest_nm > limits.kept_stroke_nm:
        raise ValueError(f"{prefix}an actuator is {largest_nm:.4g} nm from flat, the limit is {limits.stroke_nm:g} nm")
    if difference_nm > limits.neighbour_nm - limits.margin_nm:
        limit_nm = limits.neighbour_nm
        raise ValueError(f"{prefix}neighbours differ by {difference_nm:.4g} nm, the limit is {limit_nm:g} nm")


_HANDLERS: dict[str, Handler] = {
    "status": _status,
    "open": _mode,
    "close": _mode,
    "pause": _mode,
    "step": _step,
    "safe": _mode,
    "clear": _mode,
    "reset": _reset,
    "gain": _integrator,
    "leak": _integrator,
    "limit": _integrator,
    "offset": _offset,
    "channel": _channel,
    "play": _play,
    "stop": _stop,
    "law": _law,
    "load": _load,
    "note": _note,
    "lease": lease,
    "renew": renew,
    "release": release,
    "permit": permit,
}

CONFIGURATION = "configuration"
"""The only request that `answer` does not handle: the process, which has the configuration, replies to it."""
REQUESTS = (*_HANDLERS, CONFIGURATION)
