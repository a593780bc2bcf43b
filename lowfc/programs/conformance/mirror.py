"""What a mirror's driver gets wrong: it is commanded, gently at first, and its states are held against the contract."""

from collections.abc import Generator, Iterator
from itertools import pairwise

import numpy as np

from lowfc.adapters.run import mirror_role
from lowfc.contract.messages import MIRROR_STATE, from_timestamp, wire
from lowfc.programs.conformance.checks import (
    NS,
    Check,
    Heard,
    Status,
    envelope_checks,
    health_check,
    key_check,
    ok,
    sent_on,
    warning,
    wrong,
)
from lowfc.programs.conformance.dialogue import ANSWER_S, Dialogue, Expected, Single, Tell, moved, surface_nm
from lowfc.programs.conformance.limits import limit_checks

IDLE_S = 1.0
EXPIRES_NS = 300_000_000
SLACK_NS = 400_000_000
LONGEST_NS = 2_000_000_000
"""However long a command says that it is valid, a mirror does not hold it longer."""

_FOLLOWING, _EXPIRED = wire.MIRROR_STATUS_FOLLOWING, wire.MIRROR_STATUS_EXPIRED
_LONG_NS = 60 * NS
_REFUSED_EVERY_NS = 50_000_000
_SETTLE_S = 0.05  # of actuators that are reported where they are, not where they are going


def mirror_checks(dialogue: Dialogue, seconds: float, tell: Tell, *, gentle: bool = False) -> Generator[Check]:
    """What is right and wrong with a mirror; it ends where it was.

    Args:
        dialogue: with the mirror; nobody else commands it.
        seconds: for how long it is given ordinary commands.
        tell: told what is being tried.
        gentle: do not try its limits.
    """
    name, expected = dialogue.expected.name, dialogue.expected
    found: list[Check] = []
    base_nm = np.zeros(expected.grid, np.float32)
    begun_ns = dialogue.line.now_ns()
    try:
        tell("idle")
        yield from _keep(found, _idle(dialogue))
        start = dialogue.last
        where_nm = surface_nm(start)
        if start is not None and where_nm is not None and where_nm.shape == expected.grid:
            base_nm = np.where(np.isfinite(where_nm), where_nm, 0).astype(np.float32)
        if not _any_wrong(found, "grid", "state"):
            dialogue.begin(base_nm, start.frame_sequence if start is not None else 0)
            tell("ordinary commands")
            yield from _keep(found, _follow(dialogue, base_nm, seconds))
        if not _any_wrong(found, "grid", "state", "answers"):
            tell("commands that must be refused")
            yield from _keep(found, _refusals(dialogue, base_nm))
            tell("the dead-man")
            yield from _keep(found, _dead_man(dialogue, base_nm))
        reason = "--gentle" if gentle else "something above is wrong"
        if gentle or _any_wrong(found):
            advice = "try them before the loop is closed, without --gentle" if gentle else "put that right first"
            yield warning("limits", "its own stroke, slew and neighbour limits", f"not tried: {reason}", advice)
        else:
            tell("its limits")
            yield from limit_checks(dialogue)
    finally:
        if dialogue.states and not _any_wrong(found, "grid", "state"):
            dialogue.go(base_nm)
    elapsed_s = (dialogue.line.now_ns() - begun_ns) / NS
    states = sent_on(dialogue.messages, MIRROR_STATE.at(name))
    if states:
        yield from envelope_checks(states, dialogue.line.offset_ns)
    yield health_check(dialogue.messages, mirror_role(name), elapsed_s)
    yield key_check(dialogue.messages)


def _keep(found: list[Check], checks: Iterator[Check]) -> Iterator[Check]:
    for check in checks:
        found.append(check)
        yield check


def _any_wrong(found: list[Check], *names: str) -> bool:
    return any(check.status is Status.WRONG and (not names or check.name in names) for check in found)


def _idle(dialogue: Dialogue) -> Iterator[Check]:
    """Before the first command: does it say where it is?"""
    expected, key = dialogue.expected, MIRROR_STATE.at(dialogue.expected.name)
    states = dialogue.listen(IDLE_S)
    want = f"{key}: lowfc.v1.MirrorState ten times a second without commands"
    if dialogue.unreadable:
        got = f"{dialogue.unreadable} states are no lowfc.v1.MirrorState"
        yield wrong("state", want, got, "encode the message with its declaration")
        return
    if not states:
        others = ", ".join(sorted({one.key for one in dialogue.messages})) or "nothing"
        advice = (
            "publish it: a controller that starts waits a second to learn where the mirror is, then takes it for flat"
        )
        yield wrong("idle state", want, f"none in {IDLE_S:g} s; heard: {others}", advice)
        return
    if len(states) / IDLE_S < 4:
        got = f"{len(states) / IDLE_S:.1f} a second"
        yield warning("idle state", want, got, "publish it ten times a second: a controller waits for one as it starts")
    else:
        yield ok("idle state", want, f"{len(states) / IDLE_S:.0f} a second")
    state = states[-1]
    size, want = 4 * state.rows * state.columns, f"{expected.grid[0]} x {expected.grid[1]} finite float32"
    got = f"{state.rows} x {state.columns}, {len(state.actuators)} bytes"
    where_nm = surface_nm(state)
    if (state.rows, state.columns) != expected.grid:
        advice = "set mirror.rows and mirror.columns of the configuration, or the driver's grid"
        yield wrong("grid", want, got, advice)
    elif where_nm is None:
        yield wrong("grid", want, got, f"send float32, row by row: {size} bytes")
    elif not np.isfinite(where_nm).all():
        advice = "NaN is never a value: report 0 for an actuator that is not there"
        yield wrong("grid", want, f"{np.count_nonzero(~np.isfinite(where_nm))} not finite", advice)
    else:
        yield ok("grid", want, got)


def _follow(dialogue: Dialogue, base_nm: Single, seconds: float) -> Iterator[Check]:
    """Small commands, one after the other: are they answered, and followed?"""
    expected, line = dialogue.expected, dialogue.line
    want = f"a state with each command's frame_sequence within {ANSWER_S * 1e3:.0f} ms"
    answers: list[wire.MirrorState] = []
    told_nm = base_nm
    took_ns: list[int] = []
    times = unanswered = 0
    end_ns, sign = line.now_ns() + round(seconds * NS), 1
    while line.now_ns() < end_ns and (answers or unanswered < 3):
        sign = -sign
        wanted_nm = base_nm + np.float32(sign) * expected.pattern_nm
        state, sent_ns, duration_ns = dialogue.ask(wanted_nm)
        if state is None:
            unanswered += 1
            continue
        answers.append(state)
        told_nm = wanted_nm
        took_ns.append(duration_ns)
        times += from_timestamp(state.timestamp) == sent_ns
        line.wait(max(0.0, (sent_ns + expected.period_ns - line.now_ns()) / NS))
    total = len(answers) + unanswered
    if not answers:
        got = f"none to {total} commands" + (
            f"; states say {dialogue.last.frame_sequence}" if dialogue.last is not None else ""
        )
        advice = "subscribe the command's key, and publish a state for each with the command's frame_sequence"
        yield wrong("answers", want, got, advice)
        return
    if unanswered:
        got = f"{unanswered} of {total} commands without an answer"
        severity = warning if unanswered <= total // 50 else wrong
        yield severity("answers", want, got, "publish a state for every command that is followed")
    else:
        p50_ms, worst_ms = (float(value) / 1e6 for value in np.percentile(took_ns, (50, 100)))
        got = f"{total} answered after {p50_ms:.2g} ms, the slowest {worst_ms:.2g} ms"
        if p50_ms * 1e6 > expected.period_ns / 2:
            advice = f"more than half of the period, {expected.period_ns / 1e6:g} ms: each adds to the loop's delay"
            yield warning("answers", want, got, advice)
        else:
            yield ok("answers", want, got)
    last = answers[-1]
    dialogue.listen(_SETTLE_S)
    settled = [state for _, state in dialogue.states if state.frame_sequence == last.frame_sequence]
    yield _applied(expected, base_nm, told_nm, settled[-1])
    want, got = "FOLLOWING", wire.MirrorStatus.Name(last.status).removeprefix("MIRROR_STATUS_")
    if last.status == _FOLLOWING:
        yield ok("status", want, got)
    else:
        yield wrong("status", want, got, "say FOLLOWING while a command is in force")
    want = "the time of the command that was followed"
    if times == len(answers):
        yield ok("time", want, "the same")
    else:
        age_ms = (from_timestamp(last.timestamp) - line.now_ns()) / 1e6
        got = f"{len(answers) - times} of {len(answers)} another, the last {age_ms:.3g} ms from now"
        yield warning("time", want, got, "copy the command's timestamp: logs are joined by it")
    want, got = "command_nm of the command that was followed", f"{len(last.command_nm)} values"
    if list(last.command_nm) == [0.5, -0.25]:
        yield ok("modal command", want, got)
    else:
        advice = (
            "copy it, and leave it out where your limits changed the command: a restarted controller goes on from it"
        )
        yield warning("modal command", want, got, advice)


def _applied(expected: Expected, base_nm: Single, told_nm: Single, state: wire.MirrorState) -> Check:
    """Is the reported surface the commanded one? If not, by what does it differ?"""
    where_nm = surface_nm(state)
    name, want = "applied", f"the commanded surface within a step of the driver, {expected.step_nm:.3g} nm"
    if where_nm is None or where_nm.shape != expected.grid or not np.isfinite(where_nm).all():
        got = f"{state.rows} x {state.columns}, {len(state.actuators)} bytes"
        return wrong(name, want, got, "report the actuators' heights, rows x columns finite float32")
    off_nm = np.abs(where_nm - told_nm)
    off_nm[~expected.moving] = 0
    away = int(np.count_nonzero(off_nm > expected.tolerance_nm))
    if not away:
        return ok(name, want, f"within {float(off_nm.max()):.2g} nm")
    got = f"{away} of {off_nm.size} actuators off, by {float(off_nm.max()):.3g} nm at most"
    if away <= off_nm.size // 10:
        rows, columns = np.nonzero(off_nm > expected.tolerance_nm)
        which = ", ".join(
            str(row * expected.grid[1] + column) for row, column in zip(rows[:8], columns[:8], strict=True)
        )
        return warning(name, want, got, f"are they dead? Name them in mirror.dead: {which}")
    return wrong(name, want, got, _difference(base_nm, told_nm, where_nm))


def _difference(base_nm: Single, told_nm: Single, where_nm: Single) -> str:
    """What kind of mistake turns the one shape into the other."""
    asked, got = told_nm.astype(np.float64) - base_nm, where_nm.astype(np.float64) - base_nm
    turns = {
        "as commanded": got,
        "with rows and columns exchanged": got.T,
        "upside down": got[::-1],
        "left to right": got[:, ::-1],
        "turned by 180 degrees": got[::-1, ::-1],
    }
    alike = {
        how: float((asked * one).sum() / max(np.linalg.norm(asked) * np.linalg.norm(one), 1e-30))
        for how, one in turns.items()
        if one.shape == asked.shape
    }
    how = max(alike, key=lambda one: abs(alike[one]))
    if abs(alike[how]) < 0.9:
        return "it is another shape altogether: in which order does the driver take the actuators?"
    scale = float((asked * turns[how]).sum() / (asked**2).sum())
    advice = f"it is the shape {how}, times {scale:.3g}"
    if abs(scale - 2) < 0.02:
        advice += ": report surface, not wavefront"
    elif abs(scale - 1e-3) < 1e-4:
        advice += ": report nm, not um"
    elif scale < 0:
        advice += ": up is up, in nm of surface"
    return advice


def _refusals(dialogue: Dialogue, base_nm: Single) -> Iterator[Check]:
    """Commands that no mirror may follow; between them good ones, which it must."""
    expected = dialogue.expected
    other_nm = base_nm + np.float32(0.5) * expected.pattern_nm[::-1]
    broken_nm = other_nm.copy()
    broken_nm[tuple(size // 2 for size in expected.grid)] = np.nan
    infinite_nm = np.where(np.isnan(broken_nm), np.float32(np.inf), broken_nm)
    large_nm = np.zeros((expected.grid[0] + 1, expected.grid[1]), np.float32)
    cases: tuple[tuple[str, Single, dict[str, int], str], ...] = (
        ("NaN refused", broken_nm, {}, "one actuator NaN"),
        ("infinity refused", infinite_nm, {}, "one actuator infinite"),
        ("wrong grid refused", large_nm, {}, "one row more"),
        ("short command refused", other_nm, {"cut": 4}, "four bytes missing"),
        ("old command refused", other_nm, {"sequence": -1}, "the frame_sequence before the last"),
    )
    for name, wanted_nm, how, what in cases:
        want = f"a command with {what} changes nothing, and the next good one is followed"
        state, _, _ = dialogue.ask(base_nm)
        before_nm = surface_nm(state)
        if state is None or before_nm is None:
            yield wrong(name, want, "a good command before it is not answered", "go on after a command that is refused")
            return
        if "sequence" in how:
            how = {"sequence": max(0, state.frame_sequence - 1)}
        sequence, _ = dialogue.put(wanted_nm, **how)
        after = dialogue.listen(0.15)
        bad = [one for one in after if moved(expected, before_nm, one) or one.frame_sequence == sequence]
        if bad:
            where_nm = surface_nm(bad[-1])
            finite = where_nm is None or bool(np.isfinite(where_nm).all())
            got = "it was followed" if finite else "the state is not finite"
            advice = "check it before anything moves: shape, byte count, isfinite, frame_sequence not below the last"
            yield wrong(name, want, got, advice)
        else:
            yield ok(name, want, "nothing changed")
    state, _, _ = dialogue.ask(base_nm)
    if state is None:
        want = "good commands are followed after bad ones"
        yield wrong("after bad commands", want, "no answer any more", "catch what cannot be read, and go on")
        return
    want = "a command with a new clear_id is followed, though its frame_sequence is below the last"
    dialogue.listen(0.05)
    sequence, _ = dialogue.put(base_nm, sequence=max(0, state.frame_sequence - 1), clear_id=dialogue.line.now_ns())
    if any(one.frame_sequence == sequence for one in dialogue.listen(0.15)):
        yield ok("clear", want, "it was followed")
    else:
        advice = "on a new clear_id forget the newest frame_sequence: else an operator's clear cannot bring it back"
        yield warning("clear", want, "it was not", advice)


def _dead_man(dialogue: Dialogue, base_nm: Single) -> Iterator[Check]:
    """Does a command expire, in its time, and come back?"""
    advice = (
        "watch valid_for_ns by the mirror's own clock, from the command's arrival; then hold or relax, and say EXPIRED"
    )
    want = f"EXPIRED after valid_for_ns, {EXPIRES_NS / 1e6:.0f} ms here; refused commands in between renew nothing"
    dialogue.ask(base_nm, EXPIRES_NS)
    sent_ns = dialogue.line.now_ns()
    early = dialogue.listen(EXPIRES_NS / 2e9)
    broken_nm = np.full(dialogue.expected.grid, np.nan, np.float32)
    for _ in range(round((EXPIRES_NS / 2 + SLACK_NS) / _REFUSED_EVERY_NS)):
        dialogue.put(broken_nm, valid_ns=_LONG_NS)
        dialogue.listen(_REFUSED_EVERY_NS / NS)
    first = next((heard for heard, state in _since(dialogue, sent_ns) if state.status == _EXPIRED), None)
    if first is None:
        yield wrong("dead-man", want, f"not within {(EXPIRES_NS + SLACK_NS) / 1e6:.0f} ms", advice)
    else:
        after_ns = first.receive_time_ns - sent_ns
        got = f"after {after_ns / 1e6:.0f} ms"
        if after_ns < 0.8 * EXPIRES_NS or any(state.status == _EXPIRED for state in early):
            yield wrong("dead-man", want, got, "hold the command for as long as it is valid")
        else:
            yield ok("dead-man", want, got)
    want = f"EXPIRED after {LONGEST_NS / 1e9:g} s, however long a command says that it is valid"
    dialogue.go(base_nm)
    state, _, _ = dialogue.ask(base_nm, _LONG_NS)
    sent_ns = dialogue.line.now_ns()
    if state is not None and state.status != _EXPIRED:
        yield ok("after the dead-man", "a good command is followed again", "it is")
    else:
        yield wrong(
            "after the dead-man", "a good command is followed again", "it is not", "let a new command take over"
        )
    dialogue.listen((LONGEST_NS + SLACK_NS) / NS)
    if any(state.status == _EXPIRED for _, state in _since(dialogue, sent_ns)):
        yield ok("longest command", want, "EXPIRED")
    else:
        advice = "bound valid_for_ns yourself: a sender's mistake must not hold the mirror for ever"
        yield warning("longest command", want, f"not within {(LONGEST_NS + SLACK_NS) / 1e9:g} s", advice)
    silences = [
        later.receive_time_ns - earlier.receive_time_ns
        for (earlier, _), (later, _) in pairwise(_since(dialogue, sent_ns))
    ]
    longest_s = max(silences, default=LONGEST_NS) / 1e9
    want = "states all the time, ten a second, while no command comes"
    if longest_s > 1.0:
        yield wrong("silence", want, f"{longest_s:.2g} s without one", "publish the state when it is idle, too")
    elif longest_s > 0.25:
        yield warning("silence", want, f"{longest_s:.2g} s without one", "publish the state ten times a second")
    else:
        yield ok("silence", want, f"{longest_s:.2g} s at most without one")


def _since(dialogue: Dialogue, time_ns: int) -> list[tuple[Heard, wire.MirrorState]]:
    return [(heard, state) for heard, state in dialogue.states if heard.receive_time_ns >= time_ns]
