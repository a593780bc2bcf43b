"""Latencies of frames as columns, and the statistics of one repeat: percentiles, histograms, counts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.logs.columns import STAGES as ALL_STAGES
from lowfc.adapters.logs.columns import rows_of
from lowfc.arrays import Array, Long, Mask, Sequences
from lowfc.contract.messages import FRAME, wire
from lowfc.control.loop.safety import reason_name
from lowfc.programs.launch.watch import topic_count

WARM_UP_S = 0.5
"""Frames published within this time after the first one are left out."""
STAGES = ALL_STAGES[1:-1]
"""Stages from receive to command, as in ControlTiming."""
LOOP_SPANS = ("frame_to_receive", "receive_to_command", "frame_to_command", "command_to_mirror", "frame_to_mirror")
PERCENTILES = {"p50": 500, "p90": 900, "p99": 990, "p99_9": 999, "max": 1000}
"""Percentiles in thousandths: integers, so that their index among the values is exact."""

SPANS = {
    "frame_to_receive": "frame to receive",
    "receive_to_command": "receive to command",
    "wakeup": "  waking",
    "compute": "  computing",
    "publish": "  publishing",
    "frame_to_command": "frame to command",
    "command_to_mirror": "command to mirror",
    "frame_to_mirror": "frame to mirror",
    "due_to_frame": "  due to frame",
    "due_to_command": "  due to command",
    "due_to_mirror": "  due to mirror",
}
"""Labels of the spans, by their names in latency_us."""
REFERENCES = {
    "echo_us": "half a bare echo",
    "step_us": "control step alone",
    "hot_step_us": "  back to back",
    "timer_us": "timer wake-up",
}
"""Labels of the host's reference times, by their names in the results."""
RATIOS = {"ratio": ("step_us", ""), "ratio_hot": ("hot_step_us", ", timed back to back")}
"""Ratios of the latency from frame to command over half a bare echo plus one control step.

For each name of a ratio: the name of the step's duration in `REFERENCES`, and the end of the ratio's label.
"""
RATIOS_AT = ("p50", "p99")  # percentiles
COUNTS = {
    "frames": "frames",
    "frames_without_command": "without a command",
    "frames_crowded_out": "of these superseded by the next frame",
    "frames_untimed": "with a command of unknown timing",
    "frames_without_mirror_state": "without a mirror state",
    "frames_sent_late": "sent more than a period after they were due",
    "frames_skipped": "skipped by the controller",
    "frames_missing": "missing at the controller",
    "warm_up_frames": "left out for warm-up",
    "commands_late": "commands late for the next exposure",
    "echo_lost": "frames of the bare echo without an answer",
    "messages_lost": "messages lost by the recorder",
}
"""Labels of the counts of a repeat, by their names in the results; a count is None if it does not apply."""

_BINS_PER_OCTAVE = 8
_LOWEST_US, _OCTAVES = 1.0, 20
_TIME_PARTS = 200  # largest number of parts of a repeat in which latency is given against time
_PAUSE = 1000
"""Interval between frames, in median periods, above which the camera counts as paused, as if waiting for a trigger."""
_BURST = 0.5
"""Fraction of the mean period; frames less than this apart came in a burst."""


@dataclass(frozen=True, slots=True)
class FrameOutcomes:
    """Outcome of each frame, in the order of publication; all arrays are (frames,).

    Attributes:
        put_ns: time just before the frame was published.
        commanded: whether the frame's command was timed by the controller or applied by the mirror.
        spans_us: durations by the names of `SPANS`; NaN if unknown; with a schedule, also those from the due time.
    """

    put_ns: Long
    commanded: Mask
    spans_us: Mapping[str, Array]


def frame_outcomes(
    sequence: Sequences,
    put_ns: Long,
    due_ns: Long | None,
    timing: tuple[Sequences, Mapping[str, Long]],
    mirror: tuple[Sequences, Long],
) -> FrameOutcomes:
    """Published frames with their outcomes.

    Args:
        sequence: sequence of each frame.
        put_ns: time just before the frame was published.
        due_ns: time at which the frame was due; None without a schedule.
        timing: frame sequences, and the durations of the controller's stages, ns, by name as in ControlTiming.
        mirror: frame sequence and publication time, ns, of each mirror state; the first state of a frame counts.
    """
    timing_row, mirror_row = rows_of(sequence, timing[0]), rows_of(sequence, mirror[0])
    stages_us = {stage: np.append(column / 1e3, np.nan)[timing_row] for stage, column in timing[1].items()}
    transport_us, command_us = stages_us["transport"], stages_us["frame_to_command"]
    mirror_us = np.where(mirror_row < 0, np.nan, (np.append(mirror[1], 0)[mirror_row] - put_ns) / 1e3)
    spans_us = {
        "frame_to_receive": transport_us,
        "receive_to_command": command_us - transport_us,
        **{stage: stages_us[stage] for stage in STAGES},
        "frame_to_command": command_us,
        "command_to_mirror": mirror_us - command_us,
        "frame_to_mirror": mirror_us,
    }
    if due_ns is not None:
        late_us = (put_ns - due_ns) / 1e3
        spans_us |= {
            "due_to_frame": late_us,
            "due_to_command": late_us + command_us,
            "due_to_mirror": late_us + mirror_us,
        }
    return FrameOutcomes(put_ns, (timing_row >= 0) | (mirror_row >= 0), spans_us)


def percentiles(values: npt.NDArray[Any]) -> dict[str, float] | None:
    """The `PERCENTILES` of the finite values, not interpolated: each is one of the values; None if none is finite."""
    finite = np.sort(values[np.isfinite(values)])
    if not finite.size:
        return None
    indices = {name: -(-finite.size * thousandths // 1000) - 1 for name, thousandths in PERCENTILES.items()}
    return {name: round(float(finite[index]), 3) for name, index in indices.items()}


def edges_us() -> Array:
    """Edges of the histograms' bins; the outermost bins include values beyond them."""
    return np.asarray(_LOWEST_US * 2.0 ** (np.arange(_OCTAVES * _BINS_PER_OCTAVE + 1) / _BINS_PER_OCTAVE))


def histogram(values_us: Array) -> Long:
    """Counts in the bins of `edges_us`."""
    edges = edges_us()
    finite = values_us[np.isfinite(values_us)]
    return np.histogram(np.clip(finite, edges[0], edges[-1]), edges)[0].astype(np.int64)


def repeat_statistics(frames: FrameOutcomes) -> dict[str, Any]:
    """Statistics of one repeat, the warm-up left out.

    A frame without a command counts as crowded out (superseded) if the next frame was published within half the mean
    period. Untimed frames have a command but no timing.
    """
    after_warm_up = frames.put_ns - frames.put_ns[:1] >= round(WARM_UP_S * 1e9)
    put_ns, commanded = frames.put_ns[after_warm_up], frames.commanded[after_warm_up]
    spans = {span: column[after_warm_up] for span, column in frames.spans_us.items()}
    count = put_ns.size
    between_ns = np.diff(put_ns)
    until_next_ns = np.append(between_ns, np.iinfo(np.int64).max)[:count]
    usual_ns = between_ns[between_ns <= _PAUSE * np.median(between_ns)] if count > 1 else between_ns
    period_ns = float(usual_ns.mean()) if usual_ns.any() else 0.0
    latency_us = {span: percentiles(values) for span, values in spans.items()}
    return {
        "latency_us": {span: values for span, values in latency_us.items() if values is not None},
        "histogram": {span: histogram(values).tolist() for span, values in spans.items()},
        "over_time": _over_time(put_ns, spans["frame_to_command"]),
        "rate_hz": round(1e9 / period_ns, 3) if period_ns else 0.0,
        "frames": count,
        "warm_up_frames": frames.put_ns.size - count,
        "frames_without_command": int(np.sum(~commanded)),
        "frames_crowded_out": int(np.sum(~commanded & (until_next_ns < _BURST * period_ns))),
        "frames_untimed": int(np.sum(commanded & np.isnan(spans["frame_to_command"]))),
        "frames_without_mirror_state": int(np.sum(np.isnan(spans["frame_to_mirror"]))),
        "frames_sent_late": int(np.sum(spans["due_to_frame"] > period_ns / 1e3)) if "due_to_frame" in spans else None,
    }


def controller_counts(health: wire.Health) -> dict[str, Any]:
    """The controller's counts of the whole run: frames_skipped, frames_missing, and frames by refusal or limit."""
    frames = topic_count(health, FRAME.key)
    return {
        "frames_skipped": frames.skipped,
        "frames_missing": frames.missing,
        "reasons": {
            reason_name(entry.reason): entry.count for entry in health.counts if entry.reason != wire.REASON_NO_FRAME
        },
    }


def _over_time(put_ns: Long, command_us: Array) -> dict[str, list[float]]:
    """Start, median and maximum of `frame_to_command` in each of up to `_TIME_PARTS` parts of equally many frames."""
    finite = np.flatnonzero(np.isfinite(command_us))
    parts = np.array_split(finite, min(_TIME_PARTS, finite.size)) if finite.size else []
    return {
        "seconds": [round(float(put_ns[part[0]] - put_ns[0]) / 1e9, 6) for part in parts],
        "p50_us": [round(float(np.median(command_us[part])), 3) for part in parts],
        "max_us": [round(float(command_us[part].max()), 3) for part in parts],
    }
