"""Rates, jitter and latency of a run, and the frames that got no command."""

import numpy as np

from lowfc.adapters.logs.columns import STAGES, rows_of
from lowfc.adapters.logs.history import History
from lowfc.arrays import Long
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import FRAME, Role
from lowfc.programs.logs.report.source import Figures, Run

_END_NS = 50_000_000
"""Before the last frame, in which a command may still be on its way when the log ends."""

PERCENTILES = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99_9": 99.9}
FRAME_TO_MIRROR = "frame_to_mirror"


def timing_figures(run: Run) -> Figures:
    """Intervals and latencies in microseconds, and counts of frames."""
    history = run.history
    return {
        "rate_hz": history.rate_hz or None,
        "interval_us": {name: percentiles_us(values) for name, values in intervals_ns(run).items()},
        "latency_us": {stage: percentiles_us(values) for stage, values in latencies_ns(history).items()},
        "frames": frame_counts(history),
    }


def intervals_ns(run: Run) -> dict[str, Long]:
    """Times between frames and between commands, as they were sent; not across a restart of the camera.

    There is none between frames where frames were left out of the log.
    """
    history = run.history
    published = history.frame_publish_ns[: None if history.log.selection.has_every_frame else 0]
    starts = history.frame_sequence[: published.size] >> np.uint64(32)
    frames = np.diff(published)[np.diff(starts) == 0] if published.size else published
    return {"frames": frames, "commands": np.diff(run.history.command_publish_ns)}


def latencies_ns(history: History) -> dict[str, Long]:
    """Durations of the controller's stages, and from the camera's put to the first state of the mirror under it."""
    rows = rows_of(history.frame_sequence, history.mirror.sequence)
    followed = rows >= 0
    to_mirror = history.mirror.publish_time_ns[rows[followed]] - history.frame_publish_ns[followed]
    return {**{stage: history.stages_ns[stage] for stage in STAGES}, FRAME_TO_MIRROR: to_mirror}


def percentiles_us(durations_ns: Long) -> Figures:
    """Count, percentiles and the longest; None for each where there are no durations."""
    if not durations_ns.size:
        return {"count": 0, **dict.fromkeys([*PERCENTILES, "max"])}
    values = np.percentile(durations_ns, list(PERCENTILES.values())) * 1e-3
    return {
        "count": int(durations_ns.size),
        **dict(zip(PERCENTILES, map(float, values), strict=True)),
        "max": float(durations_ns.max()) * 1e-3,
    }


def frame_counts(history: History) -> Figures:
    """Frames in the log, those without a command, and what camera and controller counted themselves.

    A step is made of every frame that reaches the controller, and a command of every step once there is a calibration;
    what the controller skipped (a newer one came before it was used) or missed (it never came) has neither. Of the last
    frames the command may be after the end of the log: they are counted apart. The processes' own counts go from the
    start of a process, which may be before the log's.
    """
    frames, rows = np.unique(history.frame_sequence, return_index=True)
    without = rows_of(frames, history.steps.sequence) < 0
    at_the_end = np.zeros_like(without)
    if not without.all():
        published_ns = history.frame_publish_ns[rows]
        at_the_end = (frames > history.steps.sequence.max()) & (published_ns > published_ns[-1] - _END_NS)
    counted: dict[str, int | None] = {"skipped": None, "missing": None}
    controller = history.health.get(Role.CONTROLLER)
    if controller is not None:
        for topic in controller.topics:
            if topic.topic == FRAME.key:
                counted = {"skipped": topic.skipped, "missing": topic.missing}
    camera = history.health.get(Role.CAMERA)
    return {
        "recorded": int(frames.size),
        "without_command": int((without & ~at_the_end).sum()),
        "at_the_end": int(at_the_end.sum()),
        "skipped_by_controller": counted["skipped"],
        "missing_at_controller": counted["missing"],
        "commands_late": camera.commands_late if camera is not None else None,
        "camera_starts": len({start_of(int(sequence)) for sequence in frames}),
    }
