"""Latencies of frames as columns, and the figures made of them: percentiles, histograms, ratios, medians of repeats."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters.history import STAGES as TIMED
from lowfc.adapters.history import rows_of
from lowfc.contract.messages import FRAME, wire
from lowfc.control.safety import Reason
from lowfc.programs.watch import topic_count

Whole = npt.NDArray[np.int64]
Sequences = npt.NDArray[np.uint64]
Double = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

UNKNOWN = -1
WARM_UP_S = 0.5
"""Frames put so soon after the first one are left out."""
STAGES = TIMED[1:-1]
"""What receive to command is made of, as in ControlTiming."""
LOOP_SPANS = ("frame_to_receive", "receive_to_command", "frame_to_command", "command_to_mirror", "frame_to_mirror")
PERCENTILES = {"p50": 500, "p90": 900, "p99": 990, "p99_9": 999, "max": 1000}
"""Each in thousandths, so that its place among the values is exact."""

_BINS_PER_OCTAVE = 8
_LOWEST_US, _OCTAVES = 1.0, 20
_MOMENTS = 200
_BURST = 0.5


@dataclass(frozen=True, slots=True)
class Frames:
    """What became of each frame that was sent, in the order in which they were put; (frames,).

    Attributes:
        put_ns: just before the camera's put.
        due_ns: when it ought to have been put; None where there was no schedule.
        commanded: whether there is a command made from it.
        transport_ns: from the put to its reception by the controller; `UNKNOWN` where nothing says.
        command_ns: from the put to when the command was handed to the mirror's socket, or to the bus;
            `UNKNOWN` where nothing says.
        stages_ns: of `STAGES`, each (frames,); `UNKNOWN` where nothing says.
        mirror_ns: when the mirror said that it had applied the command; `UNKNOWN` where it did not.
    """

    put_ns: Whole
    due_ns: Whole | None
    commanded: Flags
    transport_ns: Whole
    command_ns: Whole
    stages_ns: Mapping[str, Whole]
    mirror_ns: Whole

    def only(self, wanted: Flags) -> "Frames":
        """Those frames alone."""
        return Frames(
            self.put_ns[wanted],
            None if self.due_ns is None else self.due_ns[wanted],
            self.commanded[wanted],
            self.transport_ns[wanted],
            self.command_ns[wanted],
            {stage: column[wanted] for stage, column in self.stages_ns.items()},
            self.mirror_ns[wanted],
        )


def join(
    sequence: Sequences,
    put_ns: Whole,
    due_ns: Whole | None,
    timing: tuple[Sequences, Mapping[str, Whole]],
    mirror: tuple[Sequences, Whole],
    commanded: Sequences | None = None,
) -> Frames:
    """Frames that were sent, and what was heard of each.

    Args:
        sequence: of each frame sent.
        put_ns: see `Frames`.
        due_ns: see `Frames`.
        timing: sequences, and the controller's stages, ns, as in ControlTiming.
        mirror: frame sequence and time of each state; the first of a frame counts.
        commanded: frame sequences of the commands; when None, what was timed or followed by the mirror had one.
    """
    timed, stages_ns = timing
    row, mirror_row = rows_of(sequence, timed), rows_of(sequence, mirror[0])
    return Frames(
        put_ns,
        due_ns,
        (row >= 0) | (mirror_row >= 0) if commanded is None else rows_of(sequence, commanded) >= 0,
        _taken(stages_ns["transport"], row),
        _taken(stages_ns["frame_to_command"], row),
        {stage: _taken(stages_ns[stage], row) for stage in STAGES},
        _taken(mirror[1], mirror_row),
    )


def warmed_up(frames: Frames, seconds: float = WARM_UP_S) -> Frames:
    """Frames without those of the first seconds."""
    if not frames.put_ns.size:
        return frames
    return frames.only(frames.put_ns >= frames.put_ns[0] + round(seconds * 1e9))


def spans_us(frames: Frames) -> dict[str, Double]:
    """Each span (frames,) in us, NaN where it is not known; those from the moment due only where there is one."""
    transport, command = _microseconds(frames.transport_ns), _microseconds(frames.command_ns)
    mirror = np.where(frames.mirror_ns == UNKNOWN, np.nan, (frames.mirror_ns - frames.put_ns) / 1e3)
    spans = {
        "frame_to_receive": transport,
        "receive_to_command": command - transport,
        **{stage: _microseconds(column) for stage, column in frames.stages_ns.items()},
        "frame_to_command": command,
        "command_to_mirror": mirror - command,
        "frame_to_mirror": mirror,
    }
    if frames.due_ns is not None:
        late = (frames.put_ns - frames.due_ns) / 1e3
        spans |= {"due_to_frame": late, "due_to_command": late + command, "due_to_mirror": late + mirror}
    return spans


def percentiles(values: npt.NDArray[Any]) -> dict[str, float] | None:
    """Values that these fractions do not exceed (each is one of the values); None where none is known."""
    known = np.sort(values[np.isfinite(values)])
    if not known.size:
        return None
    places = {name: -(-known.size * thousandths // 1000) - 1 for name, thousandths in PERCENTILES.items()}
    return {name: round(float(known[place]), 3) for name, place in places.items()}


def edges_us() -> Double:
    """Edges of the histograms' bins; what lies beyond them is in the outermost bins."""
    return np.asarray(_LOWEST_US * 2.0 ** (np.arange(_OCTAVES * _BINS_PER_OCTAVE + 1) / _BINS_PER_OCTAVE))


def histogram(values_us: Double) -> Whole:
    """Counts in the bins of `edges_us`."""
    edges = edges_us()
    known = values_us[np.isfinite(values_us)]
    return np.histogram(np.clip(known, edges[0], edges[-1]), edges)[0].astype(np.int64)


def repeat_figures(frames: Frames) -> dict[str, Any]:
    """Figures of one repeat, the warm-up left out.

    Returns:
        latency_us (percentiles by span), histogram (counts by span), over_time (seconds, p50_us and max_us of frame to
        command), rate_hz as sent, and numbers of frames: frames, warm_up_frames, frames_without_command, of these
        frames_crowded_out (the next one was put within half the mean period), frames_untimed (there is a command, but
        no word of how long it took), frames_without_mirror_state and frames_sent_late (by more than a period).
    """
    measured = warmed_up(frames)
    count = measured.put_ns.size
    spans = spans_us(measured)
    span_ns = int(measured.put_ns[-1] - measured.put_ns[0]) if count > 1 else 0
    period_ns = span_ns / (count - 1) if span_ns else 0.0
    next_ns = np.append(np.diff(measured.put_ns), np.iinfo(np.int64).max)
    found = {span: percentiles(values) for span, values in spans.items()}
    return {
        "latency_us": {span: figures for span, figures in found.items() if figures is not None},
        "histogram": {span: histogram(values).tolist() for span, values in spans.items()},
        "over_time": _over_time(measured.put_ns, spans["frame_to_command"]),
        "rate_hz": round(1e9 / period_ns, 3) if period_ns else 0.0,
        "frames": count,
        "warm_up_frames": frames.put_ns.size - count,
        "frames_without_command": int(np.sum(~measured.commanded)),
        "frames_crowded_out": int(np.sum(~measured.commanded & (next_ns < _BURST * period_ns))),
        "frames_untimed": int(np.sum(measured.commanded & (measured.command_ns == UNKNOWN))),
        "frames_without_mirror_state": int(np.sum(measured.mirror_ns == UNKNOWN)),
        "frames_sent_late": int(np.sum(spans["due_to_frame"] > period_ns / 1e3)) if "due_to_frame" in spans else None,
    }


def controllers_account(health: wire.Health) -> dict[str, Any]:
    """Of the whole run, by the controller: frames_skipped, frames_missing, and reasons given for a frame, counted."""
    frames = topic_count(health, FRAME.key)
    reasons = {Reason(one.reason): one.count for one in health.counts}
    return {
        "frames_skipped": frames.skipped,
        "frames_missing": frames.missing,
        "reasons": {reason.name: count for reason, count in reasons.items() if reason is not Reason.NO_FRAME},
    }


def median_of(repeats: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Median over the repeats of each percentile; of the largest values, the largest."""
    return {
        name: float(max(column) if name == "max" else np.median(column)) for name, column in _by_name(repeats).items()
    }


def spread_of(repeats: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Lowest and highest over the repeats of each percentile."""
    return {name: [float(min(column)), float(max(column))] for name, column in _by_name(repeats).items()}


def ratio(repeat: Mapping[str, Any], at: str, step: str = "step_us") -> float:
    """Frame to command over what it is made of: half the round trip of the bare echo, and one control step alone."""
    command_us: float = repeat["latency_us"]["frame_to_command"][at]
    made_of_us: float = repeat["echo_us"][at] / 2 + repeat[step][at]
    return command_us / made_of_us


def _by_name(repeats: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    return {name: [repeat[name] for repeat in repeats] for name in repeats[0]} if repeats else {}


def _taken(column: Whole, row: Whole) -> Whole:
    """Values of these rows; `UNKNOWN` for row -1."""
    return np.append(column, UNKNOWN)[row]


def _microseconds(duration_ns: Whole) -> Double:
    return np.where(duration_ns == UNKNOWN, np.nan, duration_ns / 1e3)


def _over_time(put_ns: Whole, command_us: Double) -> dict[str, list[float]]:
    """Median and largest in each of up to `_MOMENTS` equal parts, by the time of the first frame of each."""
    known = np.isfinite(command_us)
    parts = np.array_split(np.flatnonzero(known), min(_MOMENTS, max(1, int(known.sum()))))
    parts = [part for part in parts if part.size]
    return {
        "seconds": [round(float(put_ns[part[0]] - put_ns[0]) / 1e9, 6) for part in parts],
        "p50_us": [round(float(np.median(command_us[part])), 3) for part in parts],
        "max_us": [round(float(command_us[part].max()), 3) for part in parts],
    }
