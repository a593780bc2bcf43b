"""Effect of leases on the state: request, renewal, release, end."""

from math import ceil

from lowfc.control.loop.inputs import TICK_NS, Frame, PendingEvent, Request
from lowfc.control.loop.lease import LEASE_OVER, MAX_HOLDER_LENGTH, MAX_S, Lease
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import Settings, State


def lease(settings: Settings, state: State, request: Request) -> tuple[State, str, PendingEvent]:
    """Reserve the loop for the requesting client.

    Raises:
        ValueError: another client holds it, the loop is in safe mode, or the request is invalid.
    """
    before = state.conditions.lease
    if state.mode is LoopMode.SAFE:
        raise ValueError("the loop is in safe mode: `lowfc ctl clear` first, when it is safe")
    if before is not None and not before.ended and before.id != request.lease_id:
        raise ValueError(before.refused_message(request.time_ns))
    granted = _extended(settings, state, request)
    event = PendingEvent("LEASE_TAKEN", {"holder": granted.holder})
    return _with_lease(state, granted), granted.reserved_message(request.time_ns), event


def renew(settings: Settings, state: State, request: Request) -> tuple[State, str]:
    """Extend a lease; ValueError if it is not in force, with the cause of its end, or if the request is invalid."""
    before = state.conditions.lease
    if before is None or before.id != request.lease_id:
        raise ValueError("this lease is not in force: the controller restarted, or another lease was granted")
    if before.ended:
        raise ValueError(f"{LEASE_OVER}{before.ended}")
    renewed = _extended(settings, state, request)._replace(holds=before.holds)
    return _with_lease(state, renewed), renewed.reserved_message(request.time_ns)


def release(settings: Settings, state: State, request: Request) -> tuple[State, str] | tuple[State, str, PendingEvent]:
    """End a lease at its holder's request; a lease of another client stays in force."""
    held = state.conditions.lease
    if held is None or held.ended or held.id != request.lease_id:
        return state, "this lease is not in force"
    after = _with_lease(state, held._replace(ended="its holder released it"))
    return after, "released", PendingEvent("LEASE_RELEASED", {"holder": held.holder_name})


def lease_at_frame(settings: Settings, state: State, frame: Frame) -> State:
    """The state at a new frame, with its lease shortened by the frame periods that passed since the last frame.

    Their number follows from the times of the two frames, whose clock may differ from the lease's. Each frame counts as
    one period if the times do not increase, and after a silence, in which each tick compared the controller's clock
    with the lease. At a start of the camera the lease keeps its remaining periods.
    """
    held, frames = state.conditions.lease, frame.sequence - state.frame_sequence
    if held is None or held.ended or not (settings.rate_hz and held.same_start(state.frame_sequence)):
        return state
    periods = 0
    if held.same_start(frame.sequence):
        period_ns, elapsed_ns = max(1, round(1e9 / settings.rate_hz)), frame.time_ns - state.frame_time_ns
        periods = frame.time_ns // period_ns - state.frame_time_ns // period_ns
        if elapsed_ns <= 0 or (periods > frames and elapsed_ns > 2 * TICK_NS):
            return state
    last_sequence = max(held.last_sequence + frames - periods, frame.sequence - 1)
    return _with_lease(state, held._replace(last_sequence=last_sequence))


def lease_checked(state: State, time_ns: int, frame_sequence: int) -> tuple[State, list[PendingEvent]]:
    """End a lease that has expired at this time or frame (0: not compared); return the state and the event."""
    held = state.conditions.lease
    if held is None or held.ended or not held.expired(time_ns, frame_sequence):
        return state, []
    return lease_ended(state, "its time is over" if held.holds else "it was not renewed in time")


def lease_ended(state: State, why: str) -> tuple[State, list[PendingEvent]]:
    """End the lease in force and the probe sequence; return the state and the event."""
    held = state.conditions.lease
    if held is None or held.ended:
        return state, []
    loop = None if state.loop is None else state.loop.stopped(state.frame_sequence)
    after = _with_lease(state, held._replace(ended=why))._replace(loop=loop)
    return after, [PendingEvent("LEASE_ENDED", {"holder": held.holder_name, "why": why})]


def permit(settings: Settings, state: State, request: Request) -> tuple[State, str, *tuple[PendingEvent, ...]]:
    """Permit a move on the bench; with a duration, the loop is reserved, and a closed loop holds its command.

    Raises:
        ValueError: the move is refused, with the reason; or the request is invalid.
    """
    before, loop, closed = state.conditions.lease, state.loop, state.mode is LoopMode.CLOSED
    if before is not None and not before.ended and before.id != request.lease_id:
        raise ValueError(before.refused_message(request.time_ns))
    play = None if loop is None else loop.play
    if play is not None and not play.finished(state.frame_sequence + 1):
        raise ValueError(
            "a probe sequence is being played, and the move would disturb its measurement; `lowfc ctl stop` ends that"
        )
    if not request.values:
        if closed or state.waits_for_gains:
            what = "is closed" if closed else "closes once its gains are measured"
            raise ValueError(f"the loop {what}, and would follow the move: request a hold, as with `--hold 5`")
        return state, f"granted: the loop is {state.mode.in_words}"
    granted = _extended(settings, state, request)._replace(holds=True)
    what = "holds its command" if closed else f"is {state.mode.in_words} and stays so"
    text = f"granted for {request.values[0]:g} s: the loop {what}"
    return _with_lease(state, granted), text, PendingEvent("LEASE_TAKEN", {"holder": granted.holder})


def _extended(settings: Settings, state: State, request: Request) -> Lease:
    """The lease that a request asks for, from its time on; ValueError if the request is wrong."""
    holder, values = request.text.strip(), request.values
    duration_s = values[0] if len(values) == 1 else 0.0
    if not 0 < duration_s <= MAX_S:
        given = " ".join(map("{:g}".format, values)) or "none"
        raise ValueError(f"{request.name} takes one duration above 0 and of at most {MAX_S:g} s; got {given}")
    if not request.lease_id:
        raise ValueError("a lease needs an identity above 0, got 0")
    if not (0 < len(holder) <= MAX_HOLDER_LENGTH and holder.isprintable()):
        raise ValueError(
            f"a lease names its holder in 1 to {MAX_HOLDER_LENGTH} printable characters, got {holder[:40]!r}"
        )
    last_sequence = state.frame_sequence + ceil(duration_s * settings.rate_hz) if settings.rate_hz else 0
    return Lease(request.lease_id, holder, request.time_ns + round(duration_s * 1e9), last_sequence)


def _with_lease(state: State, lease: Lease) -> State:
    return state._replace(conditions=state.conditions._replace(lease=lease))
