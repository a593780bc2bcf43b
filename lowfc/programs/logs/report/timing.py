"""Rates, jitter and latency of a run, and the frames without a step."""

import numpy as np

from lowfc.adapters.logs.columns import rows_of
from lowfc.adapters.logs.history import History
from lowfc.arrays import Long
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import FRAME, TRUTH, Role, wire
from lowfc.programs.logs.report.source import Results, Run

_END_NS = 50_000_000
"""Time before the last frame in which commands may be missing because the log ends."""

PERCENTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99_9": 99.9}


def timing_results(run: Run) -> Results:
    """Intervals and latencies in microseconds, and counts of frames."""
    history = run.history
    return {
        "rate_hz": history.rate_hz or None,
        "interval_us": {name: percentiles_us(values) for name, values in intervals_ns(run).items()},
        "latency_us": {stage: percentiles_us(values) for stage, values in latencies_ns(history).items()},
        "frames": frame_counts(history),
    }


def intervals_ns(run: Run) -> dict[str, Long]:
    """Intervals between the send times of consecutive frames, and of consecutive commands.

    Intervals around a message that the log lacks are left out: they would appear as a pause of the sender.
    """
    history = run.history
    messages = {
        "frames": (history.frame_sequence, history.frame_publish_ns),
        "commands": (history.command_sequence, history.command_publish_ns),
    }
    return {name: np.diff(times_ns)[np.diff(sequence) == 1] for name, (sequence, times_ns) in messages.items()}


def latencies_ns(history: History) -> dict[str, Long]:
    """Durations of the controller's stages, and times from a frame's publication to the mirror's first state for it."""
    rows = rows_of(history.frame_sequence, history.mirror.sequence)
    applied = rows >= 0
    to_mirror = history.mirror.publish_time_ns[rows[applied]] - history.frame_publish_ns[applied]
    return history.stages_ns | {"frame_to_mirror": to_mirror}


def percentiles_us(durations_ns: Long) -> Results:
    """Count, percentiles and maximum; without durations, count 0 and None for each of the others."""
    if not durations_ns.size:
        return {"count": 0, **dict.fromkeys([*PERCENTILES, "max"])}
    values = np.percentile(durations_ns, list(PERCENTILES.values())) * 1e-3
    return {
        "count": int(durations_ns.size),
        **dict(zip(PERCENTILES, map(float, values), strict=True)),
        "max": float(durations_ns.max()) * 1e-3,
    }


def frame_counts(history: History) -> Results:
    """Frames in the log, frames without a step (and thus without a command), and counts of camera and controller.

    Every frame that the controller processes leads to a step and, with a calibration, usually to a command; frames
    that it skipped (too many waited) or missed (never arrived) have neither. The last frames, whose commands may be
    after the end of the log, are counted separately. The controller's own counts begin at its start, which may
    be before the start of the log. Only the simulated camera counts late commands.
    """
    frames, rows = np.unique(history.frame_sequence, return_index=True)
    without_step = rows_of(frames, history.stepped_sequence) < 0
    at_the_end = np.zeros_like(without_step)
    if not without_step.all():
        published_ns = history.frame_publish_ns[rows]
        at_the_end = (frames > history.stepped_sequence.max()) & (published_ns > published_ns[-1] - _END_NS)
    controller = history.health.get(Role.CONTROLLER, wire.Health())
    counts = next((topic for topic in controller.topics if topic.topic == FRAME.key), None)
    return {
        "recorded": int(frames.size),
        "without_command": int((without_step & ~at_the_end).sum()),
        "at_the_end": int(at_the_end.sum()),
        "skipped_by_controller": None if counts is None else counts.skipped,
        "missing_at_controller": None if counts is None else counts.missing,
        "commands_late": history.commands_late if TRUTH.key in history.counts else None,
        "camera_starts": len({start_of(int(sequence)) for sequence in frames}),
    }
