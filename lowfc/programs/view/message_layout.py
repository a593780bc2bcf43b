"""A layout for a log as rerun opens it by itself: the project's own messages plotted, with nothing converted.

Rerun decodes every message into one struct; a mapping takes a field out of it. A viewer applies a layout to whatever
has its application id, and that of a log is the name of its file, so that a layout is for one log.
"""

from collections.abc import Mapping, Sequence

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.components import VisualizerComponentMapping
from rerun.blueprint.encodings import ComponentSourceKind

from lowfc.adapters.logs.columns import STAGES
from lowfc.contract.codecs.codec import wire_mode
from lowfc.contract.messages import EVENT, FRAME, STEP, SURFACE, TIMING, TRUTH, Topic, wire
from lowfc.optics.chain.zernike import NOLLS_14, mode_name
from lowfc.programs.view.draw.colours import distinct
from lowfc.programs.view.panels.loop import MODE_COLOURS, MODE_NAMES

TIMELINE = "message_publish_time"
"""Of the timelines that rerun gives to a log, the one by which messages were sent."""

_MIRROR = "dm"
_MODE_NAMES = tuple(map(mode_name, NOLLS_14))
_STATES = rr.StateConfiguration(
    values=[wire.LoopMode.Name(wire_mode(mode)) for mode in MODE_COLOURS],
    labels=list(MODE_NAMES.values()),
    colors=[(*colour, 255) for colour in MODE_COLOURS.values()],
)


def message_layout() -> rrb.Blueprint:
    """Views of a log's images, events and messages, with the names of the default's modes and mirror."""
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"])
    mode = _STATES.visualizer(mappings=[_field(STEP, "StateChange:state", "mode.name")])
    truth = {f"{name}_rms_nm": [name] for name in ("disturbance", "residual")}
    stages = {f"{stage}_ns[0]": [stage.replace("_", " ")] for stage in STAGES}
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial2DView(origin=f"/{FRAME.key}", name="frame, DN"),
                rrb.Spatial2DView(origin=f"/{SURFACE.at(_MIRROR)}", name="mirror surface, nm"),
                rrb.TextLogView(origin=f"/{EVENT.key}", name="events", columns=columns),
            ),
            rrb.Vertical(
                rrb.StateTimelineView(origin=f"/{STEP.key}", name="loop mode", overrides={f"/{STEP.key}": mode}),
                _plot(TRUTH, "true wavefront rms, nm", truth),
                _plot(STEP, "flux, DN", {"flux_dn": ["flux"]}),
                _plot(TIMING, "stages of one frame in each batch, ns", stages),
                row_shares=[1, 2, 2, 2],
            ),
            rrb.Vertical(
                _plot(STEP, "measured error, nm", {"error_nm[]": _MODE_NAMES}),
                _plot(STEP, "command, nm", {"command_nm[]": _MODE_NAMES}, legend=False),
                _plot(STEP, "pseudo-open-loop, nm", {"pol_nm[]": _MODE_NAMES}, legend=False),
                _plot(TRUTH, "true residual, nm", {"residual_nm[]": _MODE_NAMES}, legend=False),
                row_shares=[3, 2, 2, 2],
            ),
            column_shares=[2, 3, 3],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


def _plot(topic: Topic, name: str, series: Mapping[str, Sequence[str]], *, legend: bool = True) -> rrb.TimeSeriesView:
    """Plot of fields of a topic's messages, each with the names of its lines."""
    colours = iter(distinct(sum(map(len, series.values()))))
    lines = [
        rr.SeriesLines(names=list(names), colors=[next(colours) for _ in names]).visualizer(
            mappings=[_field(topic, "Scalars:scalars", selector)]
        )
        for selector, names in series.items()
    ]
    return rrb.TimeSeriesView(
        origin=f"/{topic.key}",
        name=name,
        overrides={f"/{topic.key}": lines},
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
    )


def _field(topic: Topic, target: str, selector: str) -> VisualizerComponentMapping:
    return VisualizerComponentMapping(
        target,
        ComponentSourceKind.SourceComponent,
        source_component=f"{topic.message.DESCRIPTOR.full_name}:message",
        selector=f".{selector}",
    )
