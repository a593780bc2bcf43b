"""The one layout of live and recorded views: a tab for the operator, one for the optics, one for engineering."""

from collections.abc import Iterable

import rerun.blueprint as rrb

from lowfc.programs.view import latency, loop, mirror, pointing, science, sensor, spectra, tiles, trend, wavefront
from lowfc.programs.view.marks import TIMELINE
from lowfc.programs.view.tabs import Tab

APPLICATION = "lowfc"
LIVE_WINDOW_S = 20.0
"""Of a live plot."""


def layout(
    active: Tab = Tab.OPERATOR,
    window_s: float | None = LIVE_WINDOW_S,
    *,
    span_ns: tuple[int, int] | None = None,
    still: bool = False,
) -> rrb.Blueprint:
    """The blueprint, opened at a tab.

    Args:
        active: the tab.
        window_s: plots show so many last seconds; None for a log.
        span_ns: plots show what is between these times, of a log; where it is None, too, the viewer chooses.
        still: for one picture of a whole log: the operator's tab has nothing of the last instant alone.
    """
    tabs = {
        Tab.OPERATOR: _night() if still else _operator(),
        Tab.OPTICS: _optics(),
        Tab.ENGINEERING: _engineering(),
    }
    relative, absolute = rrb.TimeRangeBoundary.cursor_relative, rrb.TimeRangeBoundary.absolute
    if window_s is not None:
        _timed(tabs.values(), relative(seconds=-window_s), relative())
    elif span_ns is not None:
        _timed(tabs.values(), absolute(nanos=span_ns[0]), absolute(nanos=span_ns[1]))
    return rrb.Blueprint(
        rrb.Tabs(*tabs.values(), active_tab=list(tabs).index(active)),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),  # of a log, its end
        rrb.TopPanel(state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _operator() -> rrb.Container:
    pictures = rrb.Horizontal(
        sensor.frame_view(),
        sensor.difference_view(),
        mirror.command_view(),
        pointing.pointing_view(),
        science.image_view(),
        column_shares=[1, 1, 1, 1, 2],
    )
    courses = rrb.Horizontal(trend.trend_view(), wavefront.rms_view(), wavefront.tilt_view(), science.contrast_view())
    below = rrb.Horizontal(loop.mode_view(), latency.percentiles_view(), loop.log_view(), column_shares=[2, 3, 4])
    return rrb.Vertical(tiles.tiles_view(), pictures, courses, below, row_shares=[10, 9, 9, 7], name=Tab.OPERATOR)


def _night() -> rrb.Container:
    """Everything against time, and the events."""
    courses = rrb.Horizontal(trend.trend_view(), wavefront.tilt_view(), science.contrast_view())
    rates = rrb.Horizontal(loop.light_view(), mirror.stroke_view(), latency.percentiles_view(), latency.counts_view())
    below = rrb.Horizontal(loop.mode_view(), loop.log_view(worst=True), column_shares=[3, 5])
    return rrb.Vertical(tiles.tiles_view(), courses, rates, below, row_shares=[11, 10, 8, 9], name=Tab.OPERATOR)


def _optics() -> rrb.Container:
    return rrb.Vertical(
        rrb.Horizontal(sensor.frame_view(), sensor.difference_view(), sensor.reference_view(), sensor.raw_view()),
        rrb.Horizontal(mirror.command_view(), mirror.surface_view(), science.image_view(), column_shares=[1, 1, 2]),
        name=Tab.OPTICS,
    )


def _engineering() -> rrb.Container:
    return rrb.Horizontal(
        rrb.Vertical(*wavefront.mode_views(), row_shares=[5, 2, 2, 2]),  # room for the names of the modes
        rrb.Vertical(wavefront.groups_view(), *spectra.spectra_views(), mirror.stroke_view(), row_shares=[2, 4, 4, 2]),
        rrb.Vertical(
            latency.histogram_view(),
            latency.stages_view(),
            latency.counts_view(),
            rrb.Horizontal(loop.light_view(), loop.saturated_view()),
        ),
        name=Tab.ENGINEERING,
    )


def _timed(parts: Iterable[rrb.Container | rrb.View], start: rrb.TimeRangeBoundary, end: rrb.TimeRangeBoundary) -> None:
    """Let the plots among the parts show what is between these times."""
    for part in parts:
        if isinstance(part, rrb.Container):
            _timed(part.contents, start, end)
        elif isinstance(part, rrb.TimeSeriesView | rrb.StateTimelineView):
            part.properties["VisibleTimeRanges"] = rrb.VisibleTimeRanges(
                [rrb.VisibleTimeRange(TIMELINE, start=start, end=end)]
            )
            part.properties["TimeAxis"] = rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end))
