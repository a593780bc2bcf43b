"""Layout of the view, live or of a log: tabs for the operator, the optics and engineering."""

from collections.abc import Iterable
from functools import partial

import rerun as rr
import rerun.blueprint as rrb

from lowfc.programs.view.draw.plots import TIMELINE, bounds
from lowfc.programs.view.draw.tabs import Tab
from lowfc.programs.view.panels import (
    latency,
    loop,
    mirror,
    pointing,
    science,
    sensor,
    spectra,
    tiles,
    trend,
    wavefront,
)

APPLICATION = "lowfc"
_CONTRAST = partial(science.CONTRAST.view, axis_y=science.CONTRAST_AXIS)
_MODE = partial(rrb.StateTimelineView, origin=loop.MODE, name="Loop mode")
LIVE_WINDOW_S = 20.0
"""Time span that a live plot shows."""

_PICTURES: dict[str, tuple[str, rrb.VisualBounds2D | None]] = {
    tiles.TILES: ("Status", None),
    sensor.FRAME: ("Sensor frame, DN", None),
    sensor.DIFFERENCE: ("I - I0, DN", None),
    sensor.REFERENCE: ("Reference I0, DN", None),
    sensor.RAW: ("Raw frame, DN", None),
    mirror.ACTUATORS: ("Mirror, nm (yellow: at limit)", None),
    mirror.SURFACE: ("Mirror over the pupil, nm", None),
    pointing.TRAIL: ("Residual pointing, mas", pointing.BOUNDS),
    science.IMAGE: (
        "Computed science image: contrast; numbers: mean over the inner 2 λ/D of the dark zone",
        science.BOUNDS,
    ),
    trend.TREND: ("Trend of the residual wavefront, nm rms", bounds(trend.WIDTH)),
    spectra.TILTS: ("Power spectrum of tip and tilt, nm²/Hz", bounds(spectra.WIDTH)),
    spectra.OTHERS: ("Power spectrum of the other modes, nm²/Hz", bounds(spectra.WIDTH)),
}
"""Title and bounds of each picture, by its path."""


def layout(
    active: Tab = Tab.OPERATOR,
    window_s: float | None = LIVE_WINDOW_S,
    *,
    span_ns: tuple[int, int] | None = None,
    still: bool = False,
) -> rrb.Blueprint:
    """The layout as rerun's blueprint, with the tab `active` in front.

    Plots show the last `window_s` seconds or, for a log, the interval `span_ns`; if both are None, the viewer chooses.
    In a `still` picture of a whole log, the operator's tab shows curves, warnings and errors of the whole log in place
    of pictures of its last instant.
    """
    tabs = {
        Tab.OPERATOR: _whole_log() if still else _operator(),
        Tab.OPTICS: _optics(),
        Tab.ENGINEERING: _engineering(),
    }
    relative, absolute = rrb.TimeRangeBoundary.cursor_relative, rrb.TimeRangeBoundary.absolute
    if window_s is not None:
        _set_time_range(tabs.values(), relative(seconds=-window_s), relative())
    elif span_ns is not None:
        _set_time_range(tabs.values(), absolute(nanos=span_ns[0]), absolute(nanos=span_ns[1]))
    return rrb.Blueprint(
        rrb.Tabs(*tabs.values(), active_tab=list(tabs).index(active)),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),  # a log opens at its end
        rrb.TopPanel(state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _operator() -> rrb.Container:
    pictures = rrb.Horizontal(
        *map(_picture, (sensor.FRAME, sensor.DIFFERENCE, mirror.ACTUATORS, pointing.TRAIL, science.IMAGE)),
        column_shares=[1, 1, 1, 1, 2],
    )
    curves = rrb.Horizontal(_picture(trend.TREND), wavefront.RMS.view(), wavefront.TILT.view(), _CONTRAST())
    below = rrb.Horizontal(_MODE(), latency.TOTAL.view(), _events(), column_shares=[2, 3, 4])
    return rrb.Vertical(_picture(tiles.TILES), pictures, curves, below, row_shares=[10, 9, 9, 7], name=Tab.OPERATOR)


def _whole_log() -> rrb.Container:
    curves = rrb.Horizontal(_picture(trend.TREND), wavefront.TILT.view(), _CONTRAST())
    rates = rrb.Horizontal(loop.FLUX.view(), mirror.STROKE.view(), latency.TOTAL.view(), latency.COUNTS.view())
    below = rrb.Horizontal(_MODE(), _events(problems=True), column_shares=[3, 5])
    return rrb.Vertical(_picture(tiles.TILES), curves, rates, below, row_shares=[11, 10, 8, 9], name=Tab.OPERATOR)


def _optics() -> rrb.Container:
    return rrb.Vertical(
        rrb.Horizontal(*map(_picture, (sensor.FRAME, sensor.DIFFERENCE, sensor.REFERENCE, sensor.RAW))),
        rrb.Horizontal(*map(_picture, (mirror.ACTUATORS, mirror.SURFACE, science.IMAGE)), column_shares=[1, 1, 2]),
        name=Tab.OPTICS,
    )


def _engineering() -> rrb.Container:
    histogram = rrb.BarChartView(
        origin=latency.HISTOGRAM,
        name="Frame to command, us; last bar: overflow",
        plot_legend=rrb.PlotLegend(visible=False),
    )
    spectrum_views = (_picture(path) for path in (spectra.TILTS, spectra.OTHERS))
    return rrb.Horizontal(
        rrb.Vertical(*(plot.view() for plot in wavefront.MODES), row_shares=[5, 2, 2, 2]),  # room for the modes' names
        rrb.Vertical(wavefront.GROUPS.view(), *spectrum_views, mirror.STROKE.view(), row_shares=[2, 4, 4, 2]),
        rrb.Vertical(
            histogram,
            latency.STAGE_DURATIONS.view(),
            latency.COUNTS.view(),
            rrb.Horizontal(loop.FLUX.view(), loop.SATURATED.view()),
        ),
        name=Tab.ENGINEERING,
    )


def _picture(path: str) -> rrb.View:
    title, visual_bounds = _PICTURES[path]
    return rrb.Spatial2DView(origin=path, name=title, visual_bounds=visual_bounds)


def _events(*, problems: bool = False) -> rrb.View:
    levels = [rr.TextLogLevel.WARN, rr.TextLogLevel.ERROR, rr.TextLogLevel.CRITICAL]
    return rrb.TextLogView(
        origin=loop.LOG,
        name="Warnings and errors" if problems else "Events",
        rows=rrb.TextLogRows(filter_by_log_level=levels) if problems else None,
        columns=rrb.TextLogColumns(text_log_columns=["loglevel", "body"]),
    )


def _set_time_range(
    parts: Iterable[rrb.Container | rrb.View], start: rrb.TimeRangeBoundary, end: rrb.TimeRangeBoundary
) -> None:
    """Set the time range of all plots among the parts."""
    for part in parts:
        if isinstance(part, rrb.Container):
            _set_time_range(part.contents, start, end)
        elif isinstance(part, rrb.TimeSeriesView | rrb.StateTimelineView):
            part.properties["VisibleTimeRanges"] = rrb.VisibleTimeRanges(
                [rrb.VisibleTimeRange(TIMELINE, start=start, end=end)]
            )
            part.properties["TimeAxis"] = rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end))
