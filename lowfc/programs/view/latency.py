"""How fast the loop is: percentiles of the last second, their histogram, and what was skipped or lost."""

from collections import deque

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.adapters.history import STAGES
from lowfc.contract.messages import FRAME, Role
from lowfc.programs.view.colours import BLUE, GREEN, GREY, ORANGE, RED, distinct
from lowfc.programs.view.marks import at, curves, name_curves
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel
from lowfc.programs.view.scale import Scale
from lowfc.programs.watch import topic_count

WHOLE, PARTS, HISTOGRAM = "latency/frame_to_command", "latency/stages", "latency/histogram"
COUNTS, LOST = "latency/frames", "latency/lost"
FIGURES = ("p50", "p99", "max")
PERIOD_NS = 500_000_000
WINDOW_NS = 1_000_000_000
BINS = 40
"""Bars of the histogram; whatever took longer than its axis is in the last."""

_LEAST_US = 100.0
_BODY = 99.0
"""Percentile that the histogram's axis has to hold: a single late frame does not squeeze all others into one bar."""

Double = npt.NDArray[np.float64]


class Latency(Panel):
    """From a frame to its command, and the stages of it."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, Double]] = deque()
        self._scale = Scale(_LEAST_US)
        self._drawn_ns = 0

    def begin(self, stream: rr.RecordingStream) -> None:
        """Name what is drawn."""
        name_curves(stream, WHOLE, list(FIGURES), [BLUE, ORANGE, RED])
        name_curves(stream, PARTS, STAGES[:-1], distinct(len(STAGES) - 1))
        name_curves(stream, COUNTS, ["skipped: a newer one was there", "missing: never arrived"], [ORANGE, RED])
        name_curves(stream, LOST, ["messages lost by the recorder"], [GREY])

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Keep a second; twice in it, draw."""
        if moment.timings[STAGES[-1]].size:
            stages_us = np.stack([moment.timings[stage] for stage in STAGES], axis=1) / 1e3
            self._recent.append((moment.time_ns, stages_us))
        while self._recent and not 0 <= moment.time_ns - self._recent[0][0] < WINDOW_NS:
            self._recent.popleft()
        if 0 <= moment.time_ns - self._drawn_ns < PERIOD_NS:
            return
        self._drawn_ns = moment.time_ns
        now = np.array([moment.time_ns])
        us = np.concatenate([stages_us for _, stages_us in self._recent] or [np.zeros((0, len(STAGES)))])
        if len(us):
            whole_us = us[:, -1]
            curves(stream, WHOLE, now, np.array([[*np.percentile(whole_us, [50, 99]), whole_us.max()]]))
            curves(stream, PARTS, now, np.percentile(us[:, :-1], 99, axis=0)[None])
        self._draw_histogram(stream, moment.time_ns, us[:, -1])
        if (controller := moment.health.get(Role.CONTROLLER)) is not None:
            frames = topic_count(controller.health, FRAME.key)
            curves(stream, COUNTS, now, np.array([[frames.skipped, frames.missing]], float))
        if (recorder := moment.health.get(Role.RECORDER)) is not None:
            curves(stream, LOST, now, np.array([[recorder.health.recording.lost]], float))

    def _draw_histogram(self, stream: rr.RecordingStream, time_ns: int, us: Double) -> None:
        """Bars of even width from 0 to the axis' end, which changes seldom."""
        if us.size:
            self._scale.fit(np.percentile(us, [_BODY]), time_ns)
        width_us = max(self._scale.limit, _LEAST_US) / BINS
        places = np.minimum(us // width_us, BINS - 1).astype(int)
        counts = np.bincount(places, minlength=BINS)
        middles_us = (np.arange(BINS) + 0.5) * width_us
        at(stream, time_ns)
        bars = rr.BarChart(counts, color=GREEN, abscissa=middles_us, widths=np.full(BINS, width_us, np.float32))
        stream.log(HISTOGRAM, bars)


def percentiles_view() -> rrb.View:
    """From a frame to its command."""
    return rrb.TimeSeriesView(origin=WHOLE, name="Frame to command, last second, us", plot_legend=rrb.Corner2D.LeftTop)


def stages_view() -> rrb.View:
    """Every stage of it."""
    return rrb.TimeSeriesView(
        origin=PARTS, name="Stages of it, p99 of the last second, us", plot_legend=rrb.Corner2D.LeftTop
    )


def histogram_view() -> rrb.View:
    """How many frames took how long."""
    return rrb.BarChartView(
        origin=HISTOGRAM,
        name="Frame to command, us; last bar: or longer",
        plot_legend=rrb.PlotLegend(visible=False),
    )


def counts_view() -> rrb.View:
    """Frames and messages that are not where they should be."""
    return rrb.TimeSeriesView(
        origin="latency",
        contents=[COUNTS, LOST],
        name="Frames skipped and missing, messages lost, since the start",
        plot_legend=rrb.Corner2D.LeftTop,
    )
