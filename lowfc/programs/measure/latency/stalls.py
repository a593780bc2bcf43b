"""Stalls of a loop, and their causes from the counters of the Linux kernel.

A frame stalls if its command takes longer than a period or is missing. A stall begins when its frame is due. The host
is its cause if a bare loop (a process that only sleeps and wakes) on the same processor was also delayed, if the
hypervisor stole processor time, or if the quota of the control group was used up.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from lowfc.arrays import Array, Long
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.measure.latency.frame_statistics import SPANS, STAGES, WARM_UP_S, FrameOutcomes, percentiles

Cause = Literal["host", "loop", "unknown"]
"""Cause of a stall: "loop" if a process of the loop waited for a processor or pages, and the host is not the cause."""

_MIN_PERIODS = 0.25
"""Shortest delay that explains a stall, in frame periods."""
_FAULT_US = 1.0
"""Approximate time to map a page."""
_CONSECUTIVE = ("frame_to_receive", *STAGES)
"""Spans that make up the time from frame to command."""
_MAX_SHOWN = 20


class Trace(NamedTuple):
    """Columns (wake-ups,) of the bare loop beside one process; counts as in `lowfc.adapters.process.host.Counts`."""

    due_ns: Long
    woke_ns: Long
    stolen_ns: Long
    throttled: Long
    waited_ns: Long
    preempted: Long
    minor_faults: Long
    major_faults: Long


class CountChanges(Result):
    """Changes of the counts from the last wake-up of a bare loop before a stall to the first after it.

    `bare_late_us` is the bare loop's largest wake-up latency in this time, both wake-ups included.
    """

    bare_late_us: float
    stolen_ms: float
    throttled: int
    waited_us: float
    preempted: int
    minor_faults: int
    major_faults: int


class Stall(Result):
    """One frame that stalled; `counted` has the changes of the counts by process."""

    second: float = result_field("at, s", form=".3f")
    frame_to_command_us: float | None = result_field("frame to command, us", form=".0f")
    longest: str = result_field("longest span")
    held_up_by: Cause = result_field("cause")
    signs: str = result_field("evidence")
    counted: dict[str, CountChanges] = result_field()


class BareLoop(Result):
    """A bare loop beside a process of the control loop; `stalled`: number of wake-ups more than a period late."""

    beside: str = result_field("bare loop beside the")
    wakings: int = result_field("wake-ups")
    stalled: int = result_field("more than a period late")
    late_us: dict[str, float] | None = result_field()


class Stalls(Result):
    """The stalls of a run."""

    frames: int = result_field()
    stalled: int = result_field("stalled", "frames: no command, or more than a period from frame to command")
    of_host: int = result_field(
        "  by the host", "frames: a bare loop was delayed too, processor time was stolen, or the quota was used up"
    )
    of_loop: int = result_field(
        "  by the loop", "frames: a process waited for a processor or for pages, and the host is not the cause"
    )
    unknown: int = result_field("  unknown", "frames: no counter explains them")
    bare: list[BareLoop] = result_field()
    stalls: list[Stall] = result_field()

    def text(self) -> str:
        """Counts, the bare loops, and the first stalls."""
        hidden = len(self.stalls) - _MAX_SHOWN
        shown = super(Stalls, self.model_copy(update={"stalls": self.stalls[:_MAX_SHOWN]})).text()
        return shown + (f"\nand {hidden} more" if hidden > 0 else "")


def signs_of(counted: CountChanges, period_us: float) -> tuple[list[str], list[str]]:
    """Evidence that the host caused a stall, and that the loop did; delays shorter than `_MIN_PERIODS` are ignored."""
    long_us = _MIN_PERIODS * period_us
    host = {
        f"bare loop {counted.bare_late_us:.0f} us late": counted.bare_late_us >= long_us,
        f"{counted.stolen_ms:.0f} ms stolen": counted.stolen_ms > 0,
        "quota used up": counted.throttled > 0,
    }
    loop = {
        f"waited {counted.waited_us:.0f} us for the processor": counted.waited_us >= long_us,
        f"{counted.major_faults} pages read": counted.major_faults > 0,
        f"{counted.minor_faults} pages mapped": counted.minor_faults * _FAULT_US >= long_us,
    }
    return [sign for sign, holds in host.items() if holds], [sign for sign, holds in loop.items() if holds]


def stalls_of(frames: FrameOutcomes, period_ns: int, traces: Mapping[str, Trace]) -> Stalls:
    """The stalls among these frames, the warm-up left out; `traces` has the bare loop beside each role's process."""
    command_us = frames.spans_us["frame_to_command"]
    after_warm_up = frames.put_ns - frames.put_ns[:1] >= round(WARM_UP_S * 1e9)
    slow = after_warm_up & (~frames.commanded | (command_us * 1e3 > period_ns))
    end_ns = _ends_ns(frames, period_ns)
    stalls = [_stall(frames, int(index), float(end_ns[index]), period_ns, traces) for index in np.flatnonzero(slow)]
    causes = [stall.held_up_by for stall in stalls]
    return Stalls(
        frames=int(after_warm_up.sum()),
        stalled=len(stalls),
        of_host=causes.count("host"),
        of_loop=causes.count("loop"),
        unknown=causes.count("unknown"),
        bare=[_bare(role, trace, period_ns) for role, trace in traces.items()],
        stalls=stalls,
    )


def combine(repeats: Sequence[Stalls]) -> Stalls:
    """The stalls of several repeats; the percentiles of a bare loop's lateness are those of the worst repeat."""
    names = "frames", "stalled", "of_host", "of_loop", "unknown"
    bare = []
    for loops in zip(*(repeat.bare for repeat in repeats), strict=True):
        worst = max(loops, key=lambda loop: (loop.late_us or {}).get("max", 0.0))
        sums = {name: sum(getattr(loop, name) for loop in loops) for name in ("wakings", "stalled")}
        bare.append(worst.model_copy(update=sums))
    counts = {name: sum(getattr(repeat, name) for repeat in repeats) for name in names}
    return Stalls(**counts, bare=bare, stalls=[stall for repeat in repeats for stall in repeat.stalls])


def _ends_ns(frames: FrameOutcomes, period_ns: int) -> Array:
    """Time, ns, of each frame's command or, without one, of the next command; at most a period after the last frame."""
    sent_ns = frames.put_ns + frames.spans_us["frame_to_command"] * 1e3
    next_ns = np.fmin.accumulate(sent_ns[::-1])[::-1]  # without the NaN of frames that have no command
    return np.where(np.isfinite(sent_ns), sent_ns, np.fmin(next_ns, frames.put_ns.max(initial=0) + period_ns))


def _stall(frames: FrameOutcomes, index: int, end_ns: float, period_ns: int, traces: Mapping[str, Trace]) -> Stall:
    due_to_frame_us = frames.spans_us.get("due_to_frame", np.zeros_like(frames.spans_us["frame_to_command"]))
    begin_ns = int(frames.put_ns[index] - due_to_frame_us[index] * 1e3)
    spans_us = {SPANS[span].strip(): float(frames.spans_us[span][index]) for span in _CONSECUTIVE}
    command_us = float(frames.spans_us["frame_to_command"][index])
    timed = bool(np.isfinite(command_us))
    counted = {role: _counted(trace, begin_ns, end_ns) for role, trace in traces.items() if trace.woke_ns.size}
    signs = {role: signs_of(changes, period_ns / 1e3) for role, changes in counted.items()}
    by_host, by_loop = (any(each[which] for each in signs.values()) for which in (0, 1))
    evidence = [f"{role}: {', '.join([*host, *loop])}" for role, (host, loop) in signs.items() if host or loop]
    return Stall(
        second=round(int(frames.put_ns[index] - frames.put_ns[0]) / 1e9, 4),
        frame_to_command_us=command_us if timed else None,
        longest=max(spans_us, key=lambda name: spans_us[name]) if timed else "no command",
        held_up_by="host" if by_host else "loop" if by_loop else "unknown",
        signs="; ".join(evidence) or "none",
        counted=counted,
    )


def _counted(trace: Trace, begin_ns: int, end_ns: float) -> CountChanges:
    """Changes of the counts in a bare loop's trace over a stall, `begin_ns` to `end_ns`."""
    last = trace.woke_ns.size - 1
    before = max(int(np.searchsorted(trace.woke_ns, begin_ns, side="right")) - 1, 0)
    after = min(int(np.searchsorted(trace.woke_ns, end_ns)), last)
    changes = {name: int(column[after] - column[before]) for name, column in trace._asdict().items()}
    late_ns = (trace.woke_ns - trace.due_ns)[before : after + 1]
    return CountChanges(
        bare_late_us=float(late_ns.max(initial=0)) / 1e3,
        stolen_ms=changes["stolen_ns"] / 1e6,
        waited_us=changes["waited_ns"] / 1e3,
        **{name: changes[name] for name in ("throttled", "preempted", "minor_faults", "major_faults")},
    )


def _bare(role: str, trace: Trace, period_ns: int) -> BareLoop:
    """Wake-ups of the bare loop beside the process with this role, and how late they were."""
    late_ns = trace.woke_ns - trace.due_ns
    late_us = percentiles(late_ns / 1e3)
    return BareLoop(beside=role, wakings=late_ns.size, stalled=int(np.sum(late_ns > period_ns)), late_us=late_us)
