"""Latency panel: percentiles and histogram of the last second, frames skipped and missing, messages lost."""

from collections import deque

import numpy as np
import rerun as rr

from lowfc.adapters.logs.columns import STAGES
from lowfc.arrays import Array
from lowfc.contract.messages import FRAME, Role
from lowfc.programs.launch.watch import topic_count
from lowfc.programs.view.draw.colours import BLUE, GREEN, GREY, ORANGE, RED, distinct
from lowfc.programs.view.draw.pictures import Scale
from lowfc.programs.view.draw.plots import Plot, at
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot

HISTOGRAM = "latency/histogram"
TOTAL = Plot("latency/frame_to_command", "Frame to command, last second, us", {"p50": BLUE, "p99": ORANGE, "max": RED})
STAGE_DURATIONS = Plot(
    "latency/stages",
    "Stages, p99 of the last second, us",
    dict(zip(STAGES[:-1], distinct(len(STAGES) - 1), strict=True)),
)
COUNTS = Plot(
    "latency/frames",
    "Frames skipped and missing, messages lost, since each process started",
    {"skipped: a newer one was waiting": ORANGE, "missing: never arrived": RED, "messages lost by the recorder": GREY},
)
WINDOW_NS = 1_000_000_000
BINS = 40
"""Bars of the histogram; the last one includes all longer latencies."""

_MIN_US = 100.0
_AXIS_PERCENTILE = 99.0
"""Percentile at the end of the histogram's axis: a single late frame does not squeeze all others into one bar."""


class Latency(Panel):
    """Latency from a frame to its command, and its stages."""

    plots = (TOTAL, STAGE_DURATIONS, COUNTS)
    period_ns = 500_000_000

    def __init__(self) -> None:
        self._recent: deque[tuple[int, Array]] = deque()
        self._scale = Scale(_MIN_US)

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Keep the durations of one second; draw twice a second."""
        now_ns = snapshot.time_ns
        if snapshot.timings[STAGES[-1]].size:
            stages_us = np.stack([snapshot.timings[stage] for stage in STAGES], axis=1) / 1e3
            self._recent.append((now_ns, stages_us))
        while self._recent and not 0 <= now_ns - self._recent[0][0] < WINDOW_NS:
            self._recent.popleft()
        if not self.due(snapshot):
            return
        us = np.concatenate([stages_us for _, stages_us in self._recent] or [np.zeros((0, len(STAGES)))])
        if len(us):
            TOTAL.add_one(stream, now_ns, *np.percentile(us[:, -1], [50, 99, 100]))
            STAGE_DURATIONS.add_one(stream, now_ns, *np.percentile(us[:, :-1], 99, axis=0))
            self._scale.fit(np.percentile(us[:, -1], [_AXIS_PERCENTILE]), now_ns)
        self._draw_histogram(stream, now_ns, us[:, -1])
        controller, recorder = (snapshot.health.get(role) for role in (Role.CONTROLLER, Role.RECORDER))
        if controller is not None:
            frames = topic_count(controller.health, FRAME.key)
            lost = recorder.health.recording.lost if recorder is not None else np.nan
            COUNTS.add_one(stream, now_ns, frames.skipped, frames.missing, lost)

    def _draw_histogram(self, stream: rr.RecordingStream, time_ns: int, us: Array) -> None:
        """Draw bars of equal width from 0 to the end of the axis, which changes rarely."""
        width_us = max(self._scale.limit, _MIN_US) / BINS
        counts = np.bincount(np.minimum(us // width_us, BINS - 1).astype(int), minlength=BINS)
        middles_us = (np.arange(BINS) + 0.5) * width_us
        at(stream, time_ns)
        bars = rr.BarChart(counts, color=GREEN, abscissa=middles_us, widths=np.full(BINS, width_us, np.float32))
        stream.log(HISTOGRAM, bars)
