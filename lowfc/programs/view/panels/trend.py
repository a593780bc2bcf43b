"""Trend panel: the residual wavefront since the start of the view, or over a whole log of any length.

It is redrawn whole as line strips, because the viewer drops the oldest samples of a time series when its memory is
full.
"""

from datetime import UTC, datetime
from math import ceil, floor, log, log10

import numpy as np
import rerun as rr

from lowfc.arrays import Array
from lowfc.programs.view.draw.colours import GREEN, GREY
from lowfc.programs.view.draw.plots import Axes, Ticks, at
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.span_means import SpanMeans

TREND = "residual/trend"
WIDTH = 200.0

_FIRST_AXIS_S, _GROWTH = 60.0, 1.4
"""First length of the time axis, and the factor by which it grows when it is full."""
_TICKS_S = (10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 10_800, 21_600, 86_400, 172_800, 604_800, 2_592_000)
_MAX_TICKS, _MAX_TICKS_WITH_SECONDS = 6, 3


class Trend(Panel):
    """Rms over each averaging interval, drawn every two seconds and at the end of a log."""

    def __init__(self) -> None:
        self._means = SpanMeans()
        self._axes = Axes(TREND, WIDTH)

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Add the new data; draw when due."""
        means = self._means
        means.feed(snapshot)
        if not self.due(snapshot) and snapshot.ended is None:
            return
        after_ns, rms_nm = means.wavefront()
        valid = np.isfinite(rms_nm).all(axis=1) & (rms_nm > 0).all(axis=1)
        if not valid.any() or means.begin_ns is None:
            return
        at(stream, snapshot.time_ns)
        after_s, logarithms = after_ns * 1e-9, np.full(rms_nm.shape, np.nan)
        logarithms[valid] = np.log10(rms_nm[valid])
        span_s = max(float(after_s[valid][-1]), 1.0)
        if snapshot.ended is None:
            span_s = _FIRST_AXIS_S * _GROWTH ** max(0, ceil(log(span_s / _FIRST_AXIS_S, _GROWTH)))
        y_ticks = _nm_ticks(float(rms_nm[valid].min()), float(rms_nm[valid].max()))
        y = (y_ticks[0][0], y_ticks[-1][0])
        if len(y_ticks) > _MAX_TICKS:
            y_ticks = [tick for tick in y_ticks if tick[0] == round(tick[0])]
        self._axes.fit(stream, (0.0, span_s), y, _clock_ticks(means.begin_ns, span_s), y_ticks)
        kind = "true" if means.true else "measured"
        names = ("flat mirror", "residual", f"{kind}, {means.span_ns / 1e9:g} s mean")
        self._axes.name(stream, names, (GREY, GREEN, GREY))
        self._axes.draw(stream, after_s, [*logarithms.T[::-1]], (GREY, GREEN), (1.2, 1.8))  # the residual on top


def _nm_ticks(least: float, most: float) -> list[tuple[float, str]]:
    """Ticks (log10) at 1, 2 and 5 times powers of ten, from the last below `least` to the first above `most`."""
    decades = range(floor(log10(least)), ceil(log10(most)) + 1)
    values: Array = np.array([step * 10.0**decade for decade in decades for step in (1, 2, 5)])
    first = int(np.flatnonzero(values <= least * (1 + 1e-9))[-1])
    last = max(first + 1, int(np.flatnonzero(values >= most * (1 - 1e-9))[0]))
    return [(log10(value), f"{value:g}") for value in values[first : last + 1]]


def _clock_ticks(begin_ns: int, span_s: float) -> Ticks:
    """Ticks at round times of day, or at midnights for a trend of days, UTC, in seconds since `begin_ns`."""
    fitting_s = (one for one in _TICKS_S if span_s / one <= (_MAX_TICKS if one >= 60 else _MAX_TICKS_WITH_SECONDS))
    step_s = next(fitting_s, _TICKS_S[-1])
    form = "%m-%d" if step_s >= 86_400 else "%H:%M" if step_s >= 60 else "%H:%M:%S"
    first_s = -(-begin_ns // (step_s * 10**9)) * step_s
    times_s = range(first_s, int(begin_ns * 1e-9 + span_s) + 1, step_s)
    return [(one - begin_ns * 1e-9, f"{datetime.fromtimestamp(one, UTC):{form}}") for one in times_s]
