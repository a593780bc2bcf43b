"""What must hold of every chaos case, judged by its logs and by how its processes ended."""

import signal
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.adapters.instrument import mirror_limits, settings
from lowfc.contract.envelope import start_of
from lowfc.contract.events import Level
from lowfc.contract.messages import FRAME, Role, wire
from lowfc.control.safety import Limits
from lowfc.programs.chaos.bench import PATIENCE_S, Left
from lowfc.programs.chaos.cases import Case, End
from lowfc.programs.chaos.evidence import Evidence, Shape, Stepped, gaps, residual_nm

WITHIN = 2.0
"""Factor within which the residual comes back."""
FLOOR_NM = 1.0
"""Residuals below are noise: this much is added to what they were."""
FLUSHED_S = 1.0
"""What was recorded longer ago than this before a kill is in the log: it is flushed four times a second."""
SPAN_NS = 1_000_000_000
SHORT_FRAMES = 50
ROUNDING_NM = 0.03
"""The driver rounds to 0.023 nm: a mirror's state may be that far from its command."""
REFUSALS = frozenset(range(wire.REASON_NO_CALIBRATION, wire.REASON_STUCK + 1))
HOST_EVENTS = frozenset({"COMMANDS_LATE", "FRAMES_REFUSED", "FRAMES_MISSING", "REALTIME_REFUSED", "DISK_SLOW"})
"""Warnings for which a busy host is enough."""


class Finding(NamedTuple):
    """One rule: whether it held, and what was found."""

    rule: str
    held: bool
    found: str


def judge(case: Case, left: Left, evidence: Evidence) -> list[Finding]:
    """Every rule of a case."""
    return [
        _limits(left, evidence),
        _bad_frames(case, evidence),
        _recovery(case, left, evidence),
        _events(case, evidence),
        _account(case, left, evidence),
        _processes(case, left),
    ]


def _limits(left: Left, evidence: Evidence) -> Finding:
    config = left.config
    fixed = np.zeros((config.mirror.rows, config.mirror.columns), bool)
    fixed.flat[[*config.mirror.dead, *map(int, config.mirror.stuck_nm)]] = True
    broken = [
        *_broken("command", settings(config).limits, evidence.commands),
        *_broken("mirror", mirror_limits(config), evidence.states, fixed),
        *_jumps(evidence, config.safety.slew_nm),
    ]
    count = f"{len(evidence.commands)} commands, {len(evidence.states)} states"
    return Finding("limits", not broken and bool(evidence.states), "; ".join(broken[:3]) or count)


def _broken(
    what: str, limits: Limits, shapes: list[Shape], fixed: npt.NDArray[np.bool_] | None = None
) -> Iterator[str]:
    """Limits that shapes break; a gap in their counts allows as many moves. Fixed actuators are left out."""
    if not shapes:
        return
    surface = np.array([shape.actuators_nm for shape in shapes], np.float64)
    if fixed is not None:
        surface[:, fixed] = np.nan
    if not np.isfinite(surface[:, ~fixed] if fixed is not None else surface).all():
        yield f"{what} that is not finite"
        return
    starts = np.array([start_of(shape.sequence) for shape in shapes])
    order = np.array([shape.sequence for shape in shapes])
    moves = np.diff(order)
    same = (np.diff(starts) == 0) & (moves > 0)
    slews = np.nanmax(np.abs(np.diff(surface, axis=0)), axis=(1, 2)) / np.maximum(moves, 1)
    apart = max(np.nanmax(np.abs(np.diff(surface, axis=axis)), initial=0) for axis in (1, 2))
    figures = (
        ("stroke", np.nanmax(np.abs(surface)), limits.stroke_nm),
        ("neighbours", apart, limits.neighbour_nm),
        ("slew", slews[same].max(initial=0), limits.slew_nm),
    )
    for name, value, bound in figures:
        if value > bound:
            yield f"{what}: {name} {value:.2f} nm above {bound:g}"


def _jumps(evidence: Evidence, slew_nm: float) -> Iterator[str]:
    """The first command of a controller that was restarted, and where the mirror was."""
    seen: set[int] = set()
    times = np.array([state.log_time_ns for state in evidence.states])
    for command in evidence.commands:
        start_s = start_of(command.sequence)
        if start_s not in seen and seen:
            before = int(np.searchsorted(times, command.log_time_ns)) - 1
            if before >= 0:
                step_nm = float(np.abs(command.actuators_nm - evidence.states[before].actuators_nm).max())
                if step_nm > slew_nm + ROUNDING_NM:
                    yield f"a restarted controller moved the mirror by {step_nm:.2f} nm"
        seen.add(start_s)


def restart_step_nm(evidence: Evidence) -> float | None:
    """Largest move of an actuator by the first command of a restarted controller; None where none was."""
    first: dict[int, Shape] = {}
    for command in evidence.commands:
        first.setdefault(start_of(command.sequence), command)
    times = np.array([state.log_time_ns for state in evidence.states])
    found = []
    for command in list(first.values())[1:]:
        before = int(np.searchsorted(times, command.log_time_ns)) - 1
        if before >= 0:
            found.append(float(np.abs(command.actuators_nm - evidence.states[before].actuators_nm).max()))
    return max(found, default=None)


def recovered_s(left: Left, evidence: Evidence) -> float | None:
    """From the first frame that a restarted controller used to a residual as before; None where there was none.

    A residual is that of the next 50 frames.
    """
    started = [
        step for step in evidence.steps if step.used and start_of(step.sequence) > start_of(evidence.steps[0].sequence)
    ]
    if not started or "quiet" not in left.marks:
        return None
    begun_ns, quiet_ns = started[0].log_time_ns, left.marks["quiet"]
    most_nm = WITHIN * residual_nm(evidence.truths, quiet_ns - SPAN_NS, quiet_ns) + FLOOR_NM
    later = evidence.truths.log_time_ns >= begun_ns
    times_ns, squares = evidence.truths.log_time_ns[later], evidence.truths.residual_nm[later] ** 2
    if squares.size < SHORT_FRAMES:
        return None
    rms_nm = np.sqrt(np.convolve(squares, np.full(SHORT_FRAMES, 1 / SHORT_FRAMES), "valid"))
    good = np.flatnonzero(rms_nm <= most_nm)
    return float((times_ns[good[0]] - begun_ns) * 1e-9) if good.size else None


def _bad_frames(case: Case, evidence: Evidence) -> Finding:
    """A refused frame holds the command; what is bad is refused; nothing is used twice or after a newer one."""
    wrong = []
    by_step = {(start_of(command.sequence), command.taken): at for at, command in enumerate(evidence.commands)}
    refused = 0
    for step in evidence.steps:
        if not REFUSALS.intersection(step.reasons):
            continue
        refused += 1
        at = by_step.get((start_of(step.sequence), step.taken), 0)
        held = at and start_of(evidence.commands[at - 1].sequence) == start_of(step.sequence)
        if held and step.mode != wire.LOOP_MODE_SAFED:
            now, before = evidence.commands[at], evidence.commands[at - 1]
            adjacent = now.sequence == before.sequence + 1
            if adjacent and not np.array_equal(now.actuators_nm, before.actuators_nm):
                wrong.append(f"a command was made from frame {step.frame_sequence & 0xFFFFFFFF}, which was refused")
    wrong += _used_twice(evidence.steps)
    if case.bad is not None:
        struck = [step for step in evidence.steps if case.bad(step.frame_sequence & 0xFFFFFFFF)]
        wrong += [f"bad frame {step.frame_sequence & 0xFFFFFFFF} was used" for step in struck if step.used]
        if not struck:
            wrong.append("no bad frame came")
    return Finding("bad frames", not wrong, "; ".join(wrong[:3]) or f"{refused} refused, {len(evidence.steps)} steps")


def _used_twice(steps: Iterable[Stepped]) -> Iterator[str]:
    newest: dict[int, int] = {}
    for step in steps:
        start_s = start_of(step.sequence)
        if step.used:
            if step.frame_sequence <= newest.get(start_s, -1):
                yield f"frame {step.frame_sequence & 0xFFFFFFFF} was used after a newer one, or twice"
            newest[start_s] = max(step.frame_sequence, newest.get(start_s, -1))


def _recovery(case: Case, left: Left, evidence: Evidence) -> Finding:
    quiet_ns, end_ns = left.marks.get("quiet", 0), left.marks["end"]
    before = residual_nm(evidence.truths, quiet_ns - SPAN_NS, quiet_ns)
    after = residual_nm(evidence.truths, end_ns - SPAN_NS, end_ns)
    if np.isnan(after) and left.failure and left.residuals_nm:  # the recording ended before the loop did
        after = float(np.sqrt(np.mean(np.square(left.residuals_nm))))
    last = left.mode
    where = wire.LoopMode.Name(last).removeprefix("LOOP_MODE_").lower()
    found = f"residual {before:.2f} -> {after:.2f} nm, {where}"
    if left.notes:
        return Finding("recovery", False, "; ".join(left.notes))
    if case.end is End.RECOVERS:
        held = last == wire.LOOP_MODE_CLOSED and after <= WITHIN * before + FLOOR_NM
        return Finding("recovery", held, found)
    flat_nm = float(np.abs(evidence.states[-1].actuators_nm).max()) if evidence.states else float("inf")
    held = last == wire.LOOP_MODE_SAFED and flat_nm < 1
    return Finding("recovery", held, f"{where}, mirror at {flat_nm:.2f} nm")


def _events(case: Case, evidence: Evidence) -> Finding:
    wrong = [
        f"no event {expected!r}"
        for expected in case.expected
        if not any(event.text.startswith(expected) for event in evidence.events)
    ]
    allowed = {*(text.partition(" ")[0] for text in case.expected), *case.allowed, *HOST_EVENTS}
    loud = Counter(event.name for event in evidence.events if event.level >= Level.WARNING)
    bad = {event.name for event in evidence.events if event.level >= Level.ERROR}
    wrong += [f"{loud[name]} unexpected {name}" for name in sorted(bad - allowed)]
    rest = ", ".join(f"{name} {count}" for name, count in sorted(loud.items()))
    return Finding("events", not wrong, "; ".join(wrong) or rest or "none above info")


def _account(case: Case, left: Left, evidence: Evidence) -> Finding:
    wrong = list(evidence.unreadable)
    missing: Counter[str] = Counter()
    counted = {key: max(evidence.lost.get(key, 0), left.lost.get(key, 0)) for key in (*evidence.lost, *left.lost)}
    for key, count in gaps(evidence.counts):
        missing[key] += count
    for (number, key, start_s), published in evidence.stopped.items():
        there = evidence.counts.get((number, key, start_s))
        if there and key != FRAME.key:  # of which a faulty camera sends more, or fewer, than it numbers
            missing[key] += max(0, published - max(there) - 1)
    wrong += [
        f"{count} of {key} missing, {counted.get(key, 0)} counted as lost"
        for key, count in missing.items()
        if count > counted.get(key, 0)
    ]
    for killed_ns in left.killed_ns:
        ages_s = [(killed_ns - last_ns) * 1e-9 for last_ns, finished in evidence.last_ns if not finished]
        if not any(-FLUSHED_S < age_s < FLUSHED_S for age_s in ages_s):
            wrong.append(f"nothing was flushed within {FLUSHED_S:g} s before the recorder was killed")
    lost = sum(counted.values())
    if left.failure and not lost:
        wrong.append(f"the recording failed ({left.failure}), and nothing is counted as lost")
    if not evidence.messages:
        wrong.append("there is no log")
    return Finding(
        "account", not wrong, "; ".join(wrong[:3]) or f"{evidence.messages} recorded, {lost} counted as lost"
    )


def _processes(case: Case, left: Left) -> Finding:
    wrong = [f"{name} lives on" for name in left.alive]
    good = {0, -signal.SIGTERM}
    for ended in left.ended:
        allowed = good | case.statuses.get(ended.name, frozenset()) | ({-signal.SIGKILL} if ended.meant else set())
        if ended.after_s >= PATIENCE_S and ended.status == -signal.SIGKILL:
            wrong.append(f"{ended.name} did not end within {PATIENCE_S:g} s")
        elif ended.status not in allowed:
            wrong.append(f"{ended.name} ended with {ended.status}" + ("" if ended.meant else ", by itself"))
        elif not ended.meant and ended.status == 0:
            wrong.append(f"{ended.name} ended by itself")
    said = [] if case.noisy else sorted(left.folder.glob("*.stderr"))
    wrong += [f"a traceback in {one.name}" for one in said if "Traceback" in one.read_text(errors="replace")]
    slowest_s = max((ended.after_s for ended in left.ended), default=0.0)
    roles = len({ended.name for ended in left.ended if ended.name in set(map(str, Role))})
    return Finding("processes", not wrong and roles > 0, "; ".join(wrong[:3]) or f"ended within {slowest_s:.1f} s")
