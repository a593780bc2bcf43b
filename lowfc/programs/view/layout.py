"""The one layout of live and recorded views: a tab for the operator, one for the optics, one for engineering."""

import rerun.blueprint as rrb

from lowfc.programs.view import latency, loop, mirror, pointing, science, sensor, spectra, tiles, wavefront
from lowfc.programs.view.marks import TIMELINE
from lowfc.programs.view.tabs import Tab

APPLICATION = "lowfc"
LIVE_WINDOW_S = 20.0
"""Of a live plot."""


def layout(active: Tab = Tab.OPERATOR, window_s: float | None = LIVE_WINDOW_S) -> rrb.Blueprint:
    """The blueprint, opened at a tab; plots show the last seconds, or everything where `window_s` is None."""
    tabs = {Tab.OPERATOR: _operator(window_s), Tab.OPTICS: _optics(), Tab.ENGINEERING: _engineering(window_s)}
    return rrb.Blueprint(
        rrb.Tabs(*tabs.values(), active_tab=list(tabs).index(active)),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),  # of a log, its end
        rrb.TopPanel(state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _operator(window_s: float | None) -> rrb.Container:
    pictures = rrb.Horizontal(
        sensor.frame_view(),
        sensor.difference_view(),
        mirror.command_view(),
        pointing.pointing_view(),
        science.image_view(),
        column_shares=[1, 1, 1, 1, 2],
    )
    courses = rrb.Horizontal(wavefront.rms_view(), wavefront.tilt_view(), science.contrast_view())
    below = rrb.Horizontal(loop.mode_view(), latency.percentiles_view(), loop.log_view(), column_shares=[2, 3, 4])
    rows = rrb.Vertical(tiles.tiles_view(), pictures, courses, below, row_shares=[8, 10, 9, 7], name=Tab.OPERATOR)
    return _timed(rows, window_s)


def _optics() -> rrb.Container:
    return rrb.Vertical(
        rrb.Horizontal(sensor.frame_view(), sensor.difference_view(), sensor.reference_view(), sensor.raw_view()),
        rrb.Horizontal(mirror.command_view(), mirror.surface_view(), science.image_view(), column_shares=[1, 1, 2]),
        name=Tab.OPTICS,
    )


def _engineering(window_s: float | None) -> rrb.Container:
    columns = rrb.Horizontal(
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
    return _timed(columns, window_s)


def _timed(container: rrb.Container, window_s: float | None) -> rrb.Container:
    """The container, its plots over the last seconds only."""
    if window_s is None:
        return container
    start, end = rrb.TimeRangeBoundary.cursor_relative(seconds=-window_s), rrb.TimeRangeBoundary.cursor_relative()
    for part in container.contents:
        if isinstance(part, rrb.Container):
            _timed(part, window_s)
        elif isinstance(part, rrb.TimeSeriesView | rrb.StateTimelineView):
            part.properties["VisibleTimeRanges"] = rrb.VisibleTimeRanges(
                [rrb.VisibleTimeRange(TIMELINE, start=start, end=end)]
            )
            part.properties["TimeAxis"] = rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end))
    return container
