"""Rules that hold in every chaos case, checked in its logs and in how its processes ended."""

import signal
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from lowfc.adapters.files.factory import mirror_limits, settings
from lowfc.arrays import Mask
from lowfc.contract.events import Level
from lowfc.contract.messages import COMMAND, EVENT, FRAME, MIRROR_STATE, STEP, Role, wire
from lowfc.control.loop.safety import Limits, Rejection, mode_name
from lowfc.programs.reliability.chaos.bench import PATIENCE_S, Outcome
from lowfc.programs.reliability.chaos.case import Case
from lowfc.programs.reliability.chaos.evidence import Entry, Evidence

MAX_RATIO = 2.0
"""Largest ratio of the residual after recovery to that before the fault."""
FLOOR_NM = 1.0
"""Allowance for the noise of the residual, added to the limit from `MAX_RATIO`."""
FLUSHED_S = 1.0
"""Messages recorded earlier than this before a kill must be in the log, which is flushed four times a second."""
SPAN_NS = 1_000_000_000
"""Time over which the residual is averaged before the fault and at the end."""
RMS_FRAMES = 50
"""Frames over which the residual is averaged to find the time of recovery."""
ROUNDING_NM = 0.03
"""Largest difference of a mirror state from its command: the driver rounds to 0.023 nm."""
HOLDING = frozenset(Rejection) - {Rejection.NO_MIRROR}
"""Rejections that hold the command unless a channel moves; `NO_MIRROR` sets the command to the mirror's last shape."""


class Finding(NamedTuple):
    """Result of one rule: whether it held, and what was found."""

    rule: str
    held: bool
    found: str


def _finding(rule: str, wrong: list[str], if_held: str) -> Finding:
    """A rule that held if nothing is wrong; at most three violations are named."""
    return Finding(rule, not wrong, "; ".join(wrong[:3]) or if_held)


def judge(case: Case, outcome: Outcome, evidence: Evidence) -> list[Finding]:
    """Check every rule of a case."""
    return [
        _limits(outcome, evidence),
        _bad_frames(case, evidence),
        _recovery(case, outcome, evidence),
        _events(case, evidence),
        _account(outcome, evidence),
        _processes(case, outcome),
    ]


def _limits(outcome: Outcome, evidence: Evidence) -> Finding:
    """Commands are within the limits of the controller, mirror states within those of the mirror."""
    config = outcome.config
    commands, states = evidence.entries[COMMAND], evidence.entries[MIRROR_STATE]
    moving = np.ones((config.mirror.rows, config.mirror.columns), bool)
    moving.flat[[*config.mirror.dead, *map(int, config.mirror.stuck_nm)]] = False
    wrong = [
        *_violations("command", settings(config).limits, commands, np.ones_like(moving)),
        *_violations("mirror", mirror_limits(config), states, moving),
    ]
    wrong += [
        f"a restarted controller moved the mirror by {step_nm:.2f} nm"
        for step_nm in restart_steps_nm(evidence)
        if step_nm > config.safety.slew_nm + ROUNDING_NM
    ]
    count = f"{len(commands)} commands, {len(states)} states"
    return _finding("limits", wrong if states else [*wrong, count], count)


def _violations(source: str, limits: Limits, shapes: list[Entry], moving: Mask) -> Iterator[str]:
    """Limits that shapes violate at the `moving` actuators; across n missing messages n + 1 slew steps are allowed."""
    if not shapes:
        return
    surface = np.array([shape.actuators_nm for shape in shapes], np.float64)
    if not np.isfinite(surface[:, moving]).all():
        yield f"{source} that is not finite"
        return
    surface[:, ~moving] = np.nan
    messages_apart = np.diff([shape.sequence for shape in shapes])
    same_publisher = (np.diff([shape.start_s for shape in shapes]) == 0) & (messages_apart > 0)
    slews = np.nanmax(np.abs(np.diff(surface, axis=0)), axis=(1, 2)) / np.maximum(messages_apart, 1)
    neighbours = max(np.nanmax(np.abs(np.diff(surface, axis=axis)), initial=0) for axis in (1, 2))
    for name, value, bound in (
        ("stroke", np.nanmax(np.abs(surface)), limits.stroke_nm),
        ("neighbours", neighbours, limits.neighbour_nm),
        ("slew", slews[same_publisher].max(initial=0), limits.slew_nm),
    ):
        if value > bound:
            yield f"{source}: {name} {value:.2f} nm, above the limit of {bound:g} nm"


def restart_steps_nm(evidence: Evidence) -> list[float]:
    """Largest move of an actuator by the first command of each restarted controller, from the mirror's last state."""
    first: dict[int, Entry] = {}
    for command in evidence.entries[COMMAND]:
        first.setdefault(command.start_s, command)
    states = evidence.entries[MIRROR_STATE]
    times = np.array([state.log_time_ns for state in states])
    pairs = [(command, int(np.searchsorted(times, command.log_time_ns)) - 1) for command in list(first.values())[1:]]
    moves = [np.subtract(command.actuators_nm, states[before].actuators_nm) for command, before in pairs if before >= 0]
    return [float(np.abs(move).max()) for move in moves]


def recovered_s(outcome: Outcome, evidence: Evidence) -> float | None:
    """Time from the first frame used by a restarted controller until the residual is within its limit again.

    The residual is the rms of the next 50 frames. None without a restart or recovery.
    """
    steps = evidence.entries[STEP]
    started = [step for step in steps if step.message.error_nm and step.start_s > steps[0].start_s]
    if not started or not outcome.settled_ns:
        return None
    begun_ns, settled_ns = started[0].log_time_ns, outcome.settled_ns
    limit_nm = MAX_RATIO * evidence.residual_nm(settled_ns - SPAN_NS, settled_ns) + FLOOR_NM
    times_ns, residuals_nm = evidence.residuals_nm()
    later = times_ns >= begun_ns
    times_ns, squares = times_ns[later], residuals_nm[later] ** 2
    if squares.size < RMS_FRAMES:
        return None
    rms_nm = np.sqrt(np.convolve(squares, np.full(RMS_FRAMES, 1 / RMS_FRAMES), "valid"))
    good = np.flatnonzero(rms_nm <= limit_nm)
    return float((times_ns[good[0]] - begun_ns) * 1e-9) if good.size else None


def _bad_frames(case: Case, evidence: Evidence) -> Finding:
    """A refused frame holds the command; bad frames are refused; no frame is used twice or after a newer one."""
    commands, steps = evidence.entries[COMMAND], evidence.entries[STEP]
    numbers = {(command.start_s, command.message.input_number): number for number, command in enumerate(commands)}
    refused = [step for step in steps if HOLDING.intersection(step.message.reasons)]
    wrong = []
    for step in refused:
        number = numbers.get((step.start_s, step.message.input_number), 0)
        if number and step.message.mode != wire.LOOP_MODE_SAFE:
            before, now = commands[number - 1 : number + 1]
            adjacent = now.sequence == before.sequence + 1  # which implies the same controller
            if adjacent and not np.array_equal(now.actuators_nm, before.actuators_nm):
                wrong.append(f"a command was made from frame {step.frame}, which was refused")
    newest: dict[int, int] = {}
    for step in steps:
        if step.message.error_nm:
            last = newest.get(step.start_s, -1)
            if step.message.frame_sequence <= last:
                wrong.append(f"frame {step.frame} was used after a newer one, or twice")
            newest[step.start_s] = max(step.message.frame_sequence, last)
    if case.is_bad is not None:
        bad = [step for step in steps if case.is_bad(step.frame)]
        wrong += [f"bad frame {step.frame} was used" for step in bad if step.message.error_nm]
        wrong += [] if bad else ["no bad frame was received"]
    return _finding("bad frames", wrong, f"{len(refused)} refused, {len(steps)} steps")


def _recovery(case: Case, outcome: Outcome, evidence: Evidence) -> Finding:
    """At the end the loop is closed with about the former residual or, if the case requires it, safe and flat."""
    before = evidence.residual_nm(outcome.settled_ns - SPAN_NS, outcome.settled_ns)
    after = evidence.residual_nm(outcome.end_ns - SPAN_NS, outcome.end_ns)
    if np.isnan(after) and outcome.failure and outcome.residuals_nm:  # the recording ended before the loop did
        after = float(np.sqrt(np.mean(np.square(outcome.residuals_nm))))
    mode = mode_name(outcome.mode)
    if outcome.notes:
        return Finding("recovery", False, "; ".join(outcome.notes))
    if not case.ends_safe:
        held = outcome.mode == wire.LOOP_MODE_CLOSED and after <= MAX_RATIO * before + FLOOR_NM
        return Finding("recovery", held, f"residual {before:.2f} -> {after:.2f} nm, {mode}")
    states = evidence.entries[MIRROR_STATE]
    flat_nm = float(np.abs(states[-1].actuators_nm).max()) if states else float("inf")
    held = outcome.mode == wire.LOOP_MODE_SAFE and flat_nm < 1
    return Finding("recovery", held, f"{mode}, mirror within {flat_nm:.2f} nm of flat")


def _events(case: Case, evidence: Evidence) -> Finding:
    """The log has the case's events, and no other event of the level ERROR than the case allows."""
    events = [event.message for event in evidence.entries[EVENT]]
    wrong = [
        f"no event {expected!r}"
        for expected in case.expected
        if not any(event.message.startswith(expected) for event in events)
    ]
    names = [(event.message.partition(" ")[0], event.level) for event in events]
    allowed = {*(text.partition(" ")[0] for text in case.expected), *case.allowed}
    warnings = Counter(name for name, level in names if level >= Level.WARNING)
    errors = {name for name, level in names if level >= Level.ERROR}
    wrong += [f"{warnings[name]} unexpected {name}" for name in sorted(errors - allowed)]
    counts = ", ".join(f"{name} {count}" for name, count in sorted(warnings.items()))
    return Finding("events", not wrong, "; ".join(wrong) or counts or "none above info")


def _account(outcome: Outcome, evidence: Evidence) -> Finding:
    """Missing messages are counted as lost; the log of a killed recorder ends less than `FLUSHED_S` before the kill."""
    wrong = list(evidence.unreadable)
    missing: Counter[str] = Counter()
    keys = (*evidence.lost, *outcome.lost)
    counted = {key: max(evidence.lost.get(key, 0), outcome.lost.get(key, 0)) for key in keys}
    for publication, received in evidence.received.items():
        _, key, _ = publication
        missing[key] += received.missing
        if key != FRAME.key:  # a camera with an injected fault repeats or drops frames
            missing[key] += max(0, evidence.sent.get(publication, 0) - received.next)
    wrong += [
        f"{key}: {count} missing, {counted.get(key, 0)} counted as lost"
        for key, count in missing.items()
        if count > counted.get(key, 0)
    ]
    unfinished = [last_ns for last_ns, finished in evidence.log_ends if not finished]
    wrong += [
        f"nothing was flushed within {FLUSHED_S:g} s before the recorder was killed"
        for killed_ns in outcome.killed_ns
        if not any(abs(killed_ns - last_ns) < FLUSHED_S * 1e9 for last_ns in unfinished)
    ]
    lost = sum(counted.values())
    if outcome.failure and not lost:
        wrong.append(f"the recording failed ({outcome.failure}), but no message is counted as lost")
    if not evidence.messages:
        wrong.append("there is no log")
    return _finding("account", wrong, f"{evidence.messages} recorded, {lost} counted as lost")


def _processes(case: Case, outcome: Outcome) -> Finding:
    """Processes ended in time, with an allowed status and without a traceback; none is left."""
    wrong = [f"{name} is still running" for name in outcome.alive]
    for ended in outcome.ended:
        allowed = {0, -signal.SIGTERM, case.statuses.get(ended.name, 0)}
        allowed |= {-signal.SIGKILL} if ended.requested else set()
        if ended.after_s >= PATIENCE_S and ended.status == -signal.SIGKILL:
            wrong.append(f"{ended.name} did not end within {PATIENCE_S:g} s")
        elif ended.status not in allowed:
            by_itself = "" if ended.requested else ", by itself"
            wrong.append(f"{ended.name} ended with status {ended.status}{by_itself}")
        elif not ended.requested and ended.status == 0:
            wrong.append(f"{ended.name} ended by itself")
    outputs = [] if case.prints_tracebacks else sorted(outcome.folder.glob("*.stderr"))
    wrong += [f"a traceback in {path.name}" for path in outputs if "Traceback" in path.read_text(errors="replace")]
    if not {ended.name for ended in outcome.ended} & set(map(str, Role)):
        wrong.append("no process ended")
    slowest_s = max((ended.after_s for ended in outcome.ended), default=0.0)
    return _finding("processes", wrong, f"ended within {slowest_s:.1f} s")
