"""The slow trend: the residual wavefront since the view began, or over a whole log, however long that is.

It is drawn anew each time, as lines: of curves the viewer forgets the oldest when its memory is full.
"""

from datetime import UTC, datetime
from itertools import pairwise
from math import log10

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lowfc.arrays import Array, Mask
from lowfc.programs.view.draw.colours import GREEN, GREY, Colour
from lowfc.programs.view.draw.plots import BOX_HEIGHT, LABEL, Axes, at, lines, words
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.course import Course, round_125

TREND = "residual/trend"
PERIOD_NS = 2_000_000_000
WIDTH = 200.0
BOUNDS = rrb.VisualBounds2D(x_range=[-20, WIDTH + 8], y_range=[-17, BOX_HEIGHT + 11])

_SPANS_S = (60, 120, 300, 600, 1200, 1800, *(3600 * hours for hours in (1, 2, 3, 4, 6, 8, 12, 24, 48, 96, 168)))
_TICKS_S = (10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 10_800, 21_600, 86_400)
_MOST_TICKS = 6
_LEGEND_Y = -4.0
_NAMES = ("flat mirror", "residual")
_COLOURS = (GREY, GREEN)  # the residual last, on top
_WIDTHS = (1.2, 1.8)


class Trend(Panel):
    """Rms of each span, every other second and at the end of a log."""

    def __init__(self) -> None:
        self._course = Course()
        self._axes = Axes(TREND, WIDTH)
        self._drawn_ns = 0

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Add what is new; now and then, draw."""
        self._course.feed(snapshot)
        if 0 <= snapshot.time_ns - self._drawn_ns < PERIOD_NS and snapshot.ended is None:
            return
        self._drawn_ns = snapshot.time_ns
        after_ns, rms_nm = self._course.wavefront()
        there = np.asarray(np.isfinite(rms_nm).all(axis=1) & (rms_nm > 0).all(axis=1))
        if not there.any() or self._course.begin_ns is None:
            return
        at(stream, snapshot.time_ns)
        whole_s = float(after_ns[there][-1]) * 1e-9
        span_s = whole_s if snapshot.ended is not None else next((one for one in _SPANS_S if one >= whole_s), whole_s)
        self._fit(stream, self._course.begin_ns, max(span_s, 1.0), rms_nm[there])
        self._show(stream, after_ns * 1e-9, rms_nm, there)

    def _fit(self, stream: rr.RecordingStream, begin_ns: int, span_s: float, rms_nm: Array) -> None:
        low, high = round_125(float(rms_nm.min()), up=False), round_125(float(rms_nm.max()), up=True)
        high = max(high, round_125(1.9 * low, up=True))
        y_ticks = [(log10(low), f"{low:g}")]
        while y_ticks[-1][0] < log10(high) - 1e-9:
            value = round_125(10 ** y_ticks[-1][0] * 1.1, up=True)
            y_ticks.append((log10(value), f"{value:g}"))
        if len(y_ticks) > _MOST_TICKS:
            y_ticks = [tick for tick in y_ticks if tick[1].strip("0.") == "1"]
        step_s = next((one for one in _TICKS_S if span_s / one <= (_MOST_TICKS if one >= 60 else 3)), _TICKS_S[-1])
        first_s = -(-begin_ns // (step_s * 10**9)) * step_s  # of the day, where the step divides it
        form = "%H:%M" if step_s >= 60 else "%H:%M:%S"
        x_ticks = [
            (tick_s - begin_ns * 1e-9, f"{datetime.fromtimestamp(tick_s, UTC):{form}}")
            for tick_s in range(first_s, int(begin_ns * 1e-9 + span_s) + 1, step_s)
        ]
        self._axes.fit(stream, (0.0, span_s), (log10(low), log10(high)), x_ticks, y_ticks)

    def _show(self, stream: rr.RecordingStream, after_s: Array, rms_nm: Array, there: Mask) -> None:
        edges = np.flatnonzero(np.diff(there.astype(int), prepend=0, append=0))
        strips: list[tuple[Array, Colour, float]] = []
        for values, colour, width in zip(rms_nm.T[::-1], _COLOURS, _WIDTHS, strict=True):
            logarithms = np.log10(np.where(there, values, 1.0))
            for begin, end in list(pairwise(edges))[::2]:
                rows = [*range(begin, end)] * (2 if end - begin == 1 else 1)  # a line has two ends
                strips.append((self._axes.places(after_s[rows], logarithms[rows]), colour, width))
        stream.log(f"{TREND}/lines", lines(*zip(*strips, strict=True)))
        kind = "true" if self._course.true else "measured"
        names = [f"{name}, {kind}" for name in _NAMES] + [f"mean of {self._course.span_ns / 1e9:g} s"]
        places = [(WIDTH * share, _LEGEND_Y - LABEL - 3) for share in (0.2, 0.52, 0.84)]
        stream.log(f"{TREND}/names", words(places, names, [*_COLOURS, GREY]))
