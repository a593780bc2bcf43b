"""Checks of a mirror driver: send commands, small shapes first, and compare the mirror's states with the contract."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from lowfc.arrays import Mask, Single
from lowfc.contract.messages import SEQUENCE_BOUND, from_timestamp, wire
from lowfc.control.loop.wording import counted
from lowfc.device.mirror_protection import MAX_VALID_NS
from lowfc.programs.commissioning.checks import Check, Status, judged, ok, warning, wrong
from lowfc.programs.commissioning.conformance.connection import NS_PER_S
from lowfc.programs.commissioning.conformance.dialogue import ANSWER_S, ATTEMPTS, MODAL_NM, Dialogue, Show
from lowfc.programs.commissioning.conformance.publisher import PROCESS, PUBLISHER

IDLE_S = 1.0  # time for which the mirror is observed before the first command
EXPIRES_NS = 300_000_000  # validity of the command that is left to expire
SLACK_NS = 400_000_000  # time by which the mirror may report the timeout late

_FOLLOWING, _EXPIRED = wire.MIRROR_STATUS_FOLLOWING, wire.MIRROR_STATUS_EXPIRED
_LONG_NS = 60 * NS_PER_S  # validity that the driver must shorten
_REFUSED_EVERY_NS = 50_000_000  # time between two invalid commands while a valid one expires
_RAISED_NM = 10.0  # height by which the mirror is raised before the command timeout
_REFUSAL_S = 0.15  # time in which a command would show in the states
_NEAR, _BEYOND, _FAR = 0.9, 1.05, 2.0  # commanded heights or moves relative to a limit
_SETTLE_S = 0.05  # settling time of drivers that report measured actuator heights, not the targets


def mirror_checks(mirror: Dialogue, seconds: float, show: Show, *, gentle: bool = False) -> list[Check]:
    """All checks of a mirror; at the end the mirror returns to its initial shape."""
    found: list[Check] = []
    base_nm = np.zeros(mirror.expected.grid, np.float32)
    begun_ns = mirror.connection.now_ns()
    try:
        show("idle")
        found += _idle(mirror)
        last = mirror.last
        if (reported_nm := mirror.surface_nm(last)) is not None:
            base_nm = reported_nm
        if not _any_wrong(found, "grid", "state"):
            mirror.begin(base_nm, 0 if last is None else last.frame_sequence)
            show("ordinary commands")
            found += _ordinary_commands(mirror, base_nm, seconds)
        if not _any_wrong(found, "grid", "state", "answers"):
            show("commands that must be refused")
            found += _with_failed_attempts(mirror, _refusals(mirror, base_nm))
            show("the command timeout")
            raised_by_nm = 0.0 if gentle else min(_RAISED_NM, mirror.expected.move_nm)
            found += _with_failed_attempts(mirror, _timeout(mirror, base_nm, raised_by_nm))
        if gentle or _any_wrong(found):
            not_tested = warning("not tested: another check failed", "correct that first")
            if gentle:
                not_tested = warning(
                    "not tested: --gentle", "test the limits, without --gentle, before closing the loop"
                )
            found.append(not_tested._replace(name="limits", expected="stroke, slew and neighbour limits of the driver"))
        else:
            show("limits")
            found += _with_failed_attempts(mirror, _limit_checks(mirror))
    finally:
        if mirror.states and not _any_wrong(found, "grid", "state"):
            mirror.go(base_nm)
    mirror.seconds = (mirror.connection.now_ns() - begun_ns) / NS_PER_S
    return [*found, *PUBLISHER.run(mirror), *PROCESS.run(mirror)]


def _with_failed_attempts(mirror: Dialogue, checks: Iterator[Check]) -> Iterator[Check]:
    """Add to the result of each check the number of failed attempts since the previous check."""
    for check in checks:
        failed, mirror.failed = mirror.failed, 0
        yield check._replace(got=f"{check.got} ({counted(failed, 'failed attempt')} before)") if failed else check


def _any_wrong(found: list[Check], *names: str) -> bool:
    return any(check.status is Status.WRONG and (not names or check.name in names) for check in found)


def _idle(mirror: Dialogue) -> Iterator[Check]:
    states = mirror.listen(IDLE_S)
    expected = f"{mirror.key}: lowfc.v1.MirrorState ten times a second without commands"
    if mirror.unreadable:
        got = f"{mirror.unreadable} states are not a lowfc.v1.MirrorState"
        yield wrong(got, "encode the message as declared")._replace(name="state", expected=expected)
        return
    if states and (sequence := states[-1].frame_sequence) >= SEQUENCE_BOUND:
        advice = "report the frame_sequence of the applied command, 0 before the first one"
        yield wrong(f"frame_sequence {sequence}", advice)._replace(name="state", expected="a valid frame_sequence")
    rate_hz = len(states) / IDLE_S
    check = ok(f"{rate_hz:.0f} a second")
    if not states:
        advice = "publish it: a controller sends no command before it has received the mirror's shape"
        check = wrong(f"none in {IDLE_S:g} s; received: {mirror.keys}", advice)
    elif rate_hz < 4:
        advice = "publish it ten times a second: a starting controller waits for one"
        check = warning(f"{rate_hz:.1f} a second", advice)
    yield check._replace(name="idle state", expected=expected)
    if states:
        rows, columns = mirror.expected.grid
        yield _grid(mirror, states[-1])._replace(name="grid", expected=f"{rows} x {columns} finite float32")


def _grid(mirror: Dialogue, state: wire.MirrorState) -> Check:
    size, got = 4 * state.rows * state.columns, f"{state.rows} x {state.columns}, {len(state.actuators)} bytes"
    if (state.rows, state.columns) != mirror.expected.grid:
        return wrong(got, "set mirror.rows and mirror.columns of the configuration, or the driver's grid")
    if len(state.actuators) != size:
        return wrong(got, mirror.driver_failure or f"send float32, row by row: {size} bytes")
    odd = np.count_nonzero(~np.isfinite(np.frombuffer(state.actuators, "<f4")))
    if odd:
        return wrong(f"{odd} not finite", "report 0, not NaN, for a missing actuator")
    if mirror.surface_nm(state) is None:
        advice = "report nm of surface from flat; mirror.stroke_nm of the configuration is the full range"
        return wrong(f"actuators beyond the full stroke of {2 * mirror.expected.limits.stroke_nm:g} nm", advice)
    return ok(got)


def _ordinary_commands(mirror: Dialogue, base_nm: Single, seconds: float) -> Iterator[Check]:
    """Send small shapes of alternating sign, one per period, and check the answers; end if the first has no answer.

    If an answer was lost, `ANSWER_S` is added to the duration, `seconds`.
    """
    connection, period_ns = mirror.connection, mirror.expected.period_ns
    answers: list[wire.MirrorState] = []
    commanded_nm = base_nm
    durations_ns: list[int] = []
    same_time = unanswered = 0
    end_ns, sign = connection.now_ns() + round(seconds * NS_PER_S), 1
    while connection.now_ns() < end_ns + ANSWER_S * NS_PER_S * (mirror.failed > 0) and (answers or not unanswered):
        sign = -sign
        target_nm = base_nm + np.float32(sign) * mirror.expected.pattern_nm
        state, sent_ns, duration_ns = mirror.ask(target_nm)
        if state is None:
            unanswered += 1
            continue
        answers.append(state)
        commanded_nm = target_nm
        durations_ns.append(duration_ns)
        same_time += from_timestamp(state.timestamp) == sent_ns
        connection.wait(max(0.0, (sent_ns + period_ns - connection.now_ns()) / NS_PER_S))
    expected = f"a state with each command's frame_sequence within {ANSWER_S * 1e3:.0f} ms"
    unanswered, mirror.failed = unanswered + mirror.failed, 0
    yield _answers(mirror, durations_ns, unanswered)._replace(name="answers", expected=expected)
    if not answers:
        return
    last = answers[-1]
    mirror.listen(_SETTLE_S)
    settled = [state for _, state in mirror.states if state.frame_sequence == last.frame_sequence]
    expected = f"the commanded surface within one driver step, {mirror.expected.step_nm:.3g} nm"
    yield _applied(mirror, base_nm, commanded_nm, settled[-1])._replace(name="applied", expected=expected)
    names = {number: name.removeprefix("MIRROR_STATUS_") for name, number in wire.MirrorStatus.items()}
    got, advice = names.get(last.status, str(last.status)), "report FOLLOWING while a command is in force"
    yield judged("status", "FOLLOWING", last.status == _FOLLOWING, got, advice)
    different, expected = len(answers) - same_time, "timestamp of the applied command"
    age_ms = (connection.now_ns() - from_timestamp(last.timestamp)) / 1e6
    got = f"{different} of {len(answers)} differ, the last is {age_ms:.3g} ms old"
    advice = "copy the command's timestamp: it joins commands and states in logs"
    yield judged("time", expected, not different, "the same", advice, got, warning)
    got, expected = f"{len(last.command_nm)} values", "command_nm of the applied command"
    advice = "copy it, or omit it if your limits changed the command: a restarted controller continues from it"
    yield judged("modal command", expected, tuple(last.command_nm) == MODAL_NM, got, advice, severity=warning)


def _answers(mirror: Dialogue, durations_ns: list[int], unanswered: int) -> Check:
    total = len(durations_ns) + unanswered
    if not durations_ns:
        got = f"none to {total} commands"
        if mirror.last is not None:
            got += f"; states have frame_sequence {mirror.last.frame_sequence}"
        advice = "subscribe to the command's key, and publish a state for each with the command's frame_sequence"
        return wrong(got, advice)
    if unanswered:
        got = f"{unanswered} of {total} commands without an answer"
        severity = warning if unanswered <= max(1, total // 50) else wrong
        return severity(got, "publish a state for every applied command")
    p50_ns, worst_ns = np.percentile(durations_ns, (50, 100)).tolist()
    got = f"{total} answered after {p50_ns / 1e6:.2g} ms, the slowest {worst_ns / 1e6:.2g} ms"
    period_ns = mirror.expected.period_ns
    if p50_ns > period_ns / 2:
        return warning(got, f"more than half the period of {period_ns / 1e6:g} ms: this adds to the loop's delay")
    return ok(got)


def _applied(mirror: Dialogue, base_nm: Single, commanded_nm: Single, state: wire.MirrorState) -> Check:
    """Compare the reported surface with the commanded one; the advice names the difference."""
    expected, reported_nm = mirror.expected, mirror.surface_nm(state)
    if reported_nm is None:
        got = f"{state.rows} x {state.columns}, {len(state.actuators)} bytes"
        return wrong(got, "report the actuators' heights, rows x columns finite float32")
    difference_nm = np.where(expected.moving, np.abs(reported_nm - commanded_nm), 0)
    differing = np.flatnonzero(difference_nm > expected.tolerance_nm)
    if not differing.size:
        return ok(f"within {float(difference_nm.max()):.2g} nm")
    got = f"{differing.size} of {difference_nm.size} actuators off, by {float(difference_nm.max()):.3g} nm at most"
    if differing.size <= difference_nm.size // 10:
        indices = ", ".join(map(str, differing[:8]))
        return warning(got, f"are they dead? Exclude them in the map mirror.active: {indices}")
    moved = (np.abs(reported_nm - base_nm) > expected.tolerance_nm) & expected.moving
    if moved.any() and not moved.flat[differing].any():
        return wrong(got, "they do not move, the others do: exclude those without a channel in the map mirror.active")
    return wrong(got, _difference(base_nm, commanded_nm, reported_nm, moved=bool(moved.any())))


def _difference(base_nm: Single, commanded_nm: Single, reported_nm: Single, *, moved: bool) -> str:
    """Advice that names the transformation of the commanded shape into the reported one.

    `moved`: whether an actuator moved by more than a step of the driver.
    """
    commanded, reported = commanded_nm.astype(np.float64) - base_nm, reported_nm.astype(np.float64) - base_nm
    turns = {
        "with the right orientation": reported,
        "with rows and columns exchanged": reported.T,
        "with rows reversed": reported[::-1],
        "with columns reversed": reported[:, ::-1],
        "rotated by 180 degrees": reported[::-1, ::-1],
    }
    similarity = {
        orientation: float((commanded * turned).sum() / max(np.linalg.norm(commanded) * np.linalg.norm(turned), 1e-30))
        for orientation, turned in turns.items()
        if turned.shape == commanded.shape
    }
    best = max(similarity, key=lambda name: abs(similarity[name]))
    if abs(similarity[best]) < 0.9:
        if not moved:
            return (
                f"none moves: does the driver send the values? If its step is above {np.abs(commanded).max():.3g} nm, "
                "set mirror.driver_bits"
            )
        return "the reported and the commanded shape are unrelated: check the driver's order of the actuators"
    scale = float((commanded * turns[best]).sum() / (commanded**2).sum())
    advice = f"the reported shape is the commanded one {best}, times {scale:.3g}"
    if abs(scale - 2) < 0.02:
        advice += ": report surface, not wavefront"
    elif abs(scale - 1e-3) < 1e-4:
        advice += ": report nm, not um"
    elif scale < 0:
        advice += ": the sign is wrong; a positive command raises the surface"
    elif best == "with the right orientation" and abs(scale - 1) < 0.05:
        advice += ": does the driver round? Set mirror.driver_bits so that stroke_nm / 2^driver_bits is its step"
    return advice


def _refusals(mirror: Dialogue, base_nm: Single) -> Iterator[Check]:
    """Send invalid commands, which the mirror must refuse, and valid commands in between, which it must apply."""
    rows, columns = mirror.expected.grid
    other_nm = base_nm + np.float32(0.5) * mirror.expected.pattern_nm[::-1]
    nan_nm, infinite_nm, lost_commands = other_nm.copy(), other_nm.copy(), 0
    nan_nm[rows // 2, columns // 2], infinite_nm[rows // 2, columns // 2] = np.nan, np.inf
    for name, defect, target_nm, cut in (
        ("NaN refused", "one actuator NaN", nan_nm, 0),
        ("infinity refused", "one actuator infinite", infinite_nm, 0),
        ("wrong grid refused", "one row too many", np.zeros((rows + 1, columns), np.float32), 0),
        ("short command refused", "four bytes missing", other_nm, 4),
        ("old command refused", "the frame_sequence before the last", other_nm, 0),
    ):
        expected = f"a command with {defect} changes nothing, and the next valid one is applied"
        state, _, _ = mirror.ask(base_nm)
        lost_commands += mirror.failed > 0
        before_nm = mirror.surface_nm(state)
        if state is None or before_nm is None:
            got = "a valid command before it is not answered"
            yield judged(name, expected, False, got, "continue after a refused command")
            return
        earlier = max(0, state.frame_sequence - 1) if name == "old command refused" else None
        sequence, _ = mirror.put(target_nm, sequence=earlier, cut=cut)
        after = mirror.listen(_REFUSAL_S)
        bad = [each for each in after if mirror.moved(before_nm, each) or each.frame_sequence == sequence]
        got = "it was applied" if bad and mirror.surface_nm(bad[-1]) is not None else "the state is not a finite grid"
        advice = "before any move, check shape, byte count, isfinite, and frame_sequence not below the last"
        yield judged(name, expected, not bad, "nothing changed", advice, got)
    state, _, _ = mirror.ask(base_nm)
    if state is None or (mirror.failed and lost_commands >= 4):  # one after each: no stall of this host
        expected, advice = "valid commands are applied after invalid ones", "catch decoding errors, and continue"
        got = "no more answers" if state is None else "the first valid command after each invalid one is lost"
        yield judged("after bad commands", expected, False, got, advice)
        return
    mirror.listen(_SETTLE_S)
    earlier, clear_id = max(0, state.frame_sequence - 1), mirror.connection.now_ns()
    followed = mirror.ask(base_nm, sequence=earlier, clear_id=clear_id)[0] is not None
    expected = "a command with a new clear_id is applied, although its frame_sequence is below the last"
    advice = "reset the newest frame_sequence on a new clear_id: otherwise an operator's clear has no effect"
    yield judged("clear", expected, followed, "it was applied", advice, "it was not applied", warning)


def _timeout(mirror: Dialogue, base_nm: Single, raised_by_nm: float) -> Iterator[Check]:
    """Raise the mirror, let the command expire while invalid commands arrive; then let a long valid command expire."""
    raised_nm, nan_nm = base_nm + np.float32(raised_by_nm), np.full(mirror.expected.grid, np.nan, np.float32)
    for attempt in range(ATTEMPTS):
        mirror.go(base_nm)
        mirror.failed += attempt > 0
        _, sent_ns, _ = mirror.ask(raised_nm, EXPIRES_NS)
        mirror.listen(EXPIRES_NS / 2e9)
        for _ in range(round((EXPIRES_NS / 2 + SLACK_NS) / _REFUSED_EVERY_NS)):
            mirror.put(nan_nm, valid_ns=_LONG_NS)
            mirror.listen(_REFUSED_EVERY_NS / NS_PER_S)
        expired_ns = _expired_ns(mirror, sent_ns)
        if held := expired_ns is not None and expired_ns - sent_ns >= 0.8 * EXPIRES_NS:
            break
    expected = f"EXPIRED after valid_for_ns, here {EXPIRES_NS / 1e6:.0f} ms; refused commands do not extend it"
    got = f"not within {(EXPIRES_NS + SLACK_NS) / 1e6:.0f} ms"
    advice = "count valid_for_ns on the mirror's clock from a command's arrival; then hold or relax, report EXPIRED"
    if expired_ns is not None:
        got, advice = f"after {(expired_ns - sent_ns) / 1e6:.0f} ms", "hold the command while it is valid"
    yield judged("dead-man", expected, held, got, advice)
    expired = [state for _, state in mirror.since(sent_ns) if state.status == _EXPIRED]
    empty = not any(mirror.moved(raised_nm, state) and state.command_nm for state in expired)
    expected, got = "command_nm is empty while the mirror relaxes", "command_nm is empty"
    advice = "clear command_nm while relaxing: a starting controller would adopt the difference as a shape to keep"
    yield judged("relaxing", expected, empty, got, advice, "command_nm is set while the mirror relaxes")
    mirror.go(base_nm)
    state, _, _ = mirror.ask(base_nm, _LONG_NS)
    sent_ns, applied = mirror.connection.now_ns(), state is not None and state.status != _EXPIRED
    expected, advice = "a valid command is applied again", "apply a new command after the timeout"
    yield judged("after the dead-man", expected, applied, "applied", advice, "not applied")
    mirror.listen((MAX_VALID_NS + SLACK_NS) / NS_PER_S)
    expected = f"EXPIRED after at most {MAX_VALID_NS / 1e9:g} s, whatever valid_for_ns"
    late, bounded = f"not within {(MAX_VALID_NS + SLACK_NS) / 1e9:g} s", _expired_ns(mirror, sent_ns) is not None
    advice = "limit valid_for_ns in the driver: a sender's mistake must not hold the mirror for ever"
    yield judged("longest command", expected, bounded, "EXPIRED", advice, late, warning)
    times_ns = sent_ns, *(message.receive_time_ns for message, _ in mirror.since(sent_ns)), mirror.connection.now_ns()
    longest_s = max(later - earlier for earlier, later in pairwise(times_ns)) / 1e9
    expected, got = "ten states a second also without commands", f"longest time without a state {longest_s:.2g} s"
    advice, severity = "publish the state ten times a second, also when idle", wrong if longest_s > 1.0 else warning
    yield judged("silence", expected, longest_s <= 0.25, got, advice, severity=severity)


def _expired_ns(mirror: Dialogue, since_ns: int) -> int | None:
    arrivals = (message.receive_time_ns for message, state in mirror.since(since_ns) if state.status == _EXPIRED)
    return next(arrivals, None)


def _limit_checks(mirror: Dialogue) -> Iterator[Check]:
    """Test stroke and slew limits with all actuators, the neighbour limit with one; the mirror ends flat."""
    limits, flat_nm = mirror.expected.limits, np.zeros(mirror.expected.grid, np.float32)
    uniform = np.ones_like(flat_nm)
    peak, neighbours = _peak(mirror.expected.moving)
    stroke_nm, slew_nm, neighbour_nm = limits.stroke_nm, limits.slew_nm, limits.neighbour_nm
    too_far_nm = min(_FAR * slew_nm, _NEAR * stroke_nm)
    fits = _BEYOND * neighbour_nm / 2 <= _NEAR * stroke_nm and mirror.reachable(_BEYOND * neighbour_nm)
    reached = _reaches_stroke(mirror)
    for name, requirement, reason, limit_nm, commanded_nm, shape, possible in (
        ("stroke", "no actuator above", wire.REASON_STROKE, stroke_nm, _BEYOND * stroke_nm, uniform, reached),
        ("slew", "no move above", wire.REASON_SLEW, slew_nm, too_far_nm, uniform, too_far_nm >= _BEYOND * slew_nm),
        ("neighbours", "no step above", wire.REASON_NEIGHBOUR, neighbour_nm, _BEYOND * neighbour_nm, peak, fits),
    ):
        expected = f"{requirement} {limit_nm:g} nm, with {commanded_nm:.4g} nm commanded"
        check = warning("not tested: out of reach", "do mirror.stroke_nm (full range) and the limits match the mirror?")
        if possible:
            target_nm = np.float32(commanded_nm) * shape
            state = mirror.ask(target_nm)[0] if name == "slew" else mirror.go(target_nm)
            reported_nm = mirror.surface_nm(state)
            if state is None or reported_nm is None:
                check = wrong("no answer", "apply the command as far as the limits allow: a refusal stops the loop")
            else:
                reached_nm = (
                    _highest_nm(mirror, reported_nm) if shape is uniform else float(np.ptp(reported_nm[neighbours]))
                )
                check = _within_limit(state, reason, reached_nm, limit_nm + mirror.expected.tolerance_nm)
        yield check._replace(name=name, expected=expected)
        mirror.go(flat_nm)


def _within_limit(state: wire.MirrorState, reason: wire.Reason, reached_nm: float, max_nm: float) -> Check:
    got = f"{reached_nm:.4f} nm"
    if reached_nm > max_nm:
        return wrong(got, "clip every command in the driver: do not rely on the controller's limits")
    if reason in state.limits_hit:
        return ok(got)
    advice = f"add {wire.Reason.Name(reason)} to limits_hit, so that logs and views show that a limit acted"
    return warning(f"{got}, but limits_hit does not name the limit", advice)


def _reaches_stroke(mirror: Dialogue) -> bool:
    """Move the mirror to 90 % of its stroke, in moves of half the slew limit; return whether it reached 85 %."""
    stroke_nm = mirror.expected.limits.stroke_nm
    mirror.go(np.zeros(mirror.expected.grid, np.float32))
    if not mirror.reachable(stroke_nm):
        return False
    reported_nm = mirror.surface_nm(mirror.go(np.full(mirror.expected.grid, _NEAR * stroke_nm, np.float32)))
    return reported_nm is not None and _highest_nm(mirror, reported_nm) >= (_NEAR - 0.05) * stroke_nm


def _peak(moving: Mask) -> tuple[Single, tuple[int, list[int]]]:
    """A shape with one actuator at 0.5 and all others at -0.5; row and columns of this actuator and its two neighbours.

    This actuator is the nearest to the centre among those that move and whose two neighbours move, else among all.
    """
    good = np.zeros_like(moving)
    good[:, 1:-1] = moving[:, 1:-1] & moving[:, :-2] & moving[:, 2:]
    places = np.argwhere(good if good.any() else np.ones_like(good))
    row, column = map(int, places[np.argmin(((places - (np.array(moving.shape) - 1) / 2) ** 2).sum(axis=1))])
    peak = np.full(moving.shape, -0.5, np.float32)
    peak[row, column] = 0.5
    return peak, (row, [column - 1, column, column + 1])


def _highest_nm(mirror: Dialogue, surface_nm: Single) -> float:
    return float(np.abs(surface_nm[mirror.expected.moving]).max(initial=0))
