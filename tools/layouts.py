"""Layouts for rerun, in deploy/layouts: for a log opened directly in rerun, and for the drawings of `lowfc view`.

Rerun decodes every message into one struct; a mapping selects a field of it. Rerun applies a layout to data with the
layout's application id. That of a log is its file name without suffix; `rerun rrd route` writes it into the layout.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.components import VisualizerComponentMapping
from rerun.blueprint.encodings import ComponentSourceKind

from lowfc.adapters.logs.columns import STAGES
from lowfc.contract.codecs.codec import wire_mode
from lowfc.contract.messages import EVENT, FRAME, STEP, SURFACE, TIMING, TRUTH, Topic, wire
from lowfc.optics.chain.zernike import NOLLS_14, mode_name
from lowfc.programs.view.draw.colours import distinct
from lowfc.programs.view.layout import APPLICATION, layout
from lowfc.programs.view.panels.loop import MODE_COLOURS, MODE_NAMES
from tools.shared import ROOT

LAYOUTS = ROOT / "deploy" / "layouts"
TIMELINE = "message_publish_time"
"""Rerun's timeline of publish times."""

MIRROR = "dm"
MODES = tuple(map(mode_name, NOLLS_14))
RMS = {
    "residual_rms_nm": ["residual, as exposures start"],
    "continuous_residual_rms_nm": ["residual, over the period"],
    "disturbance_rms_nm": ["disturbance, as exposures start"],
    "continuous_disturbance_rms_nm": ["disturbance, over the period"],
}


def make(folder: Path = LAYOUTS) -> None:
    """Write both layouts; their bytes differ at every call."""
    layout().save(APPLICATION, folder / "lowfc.rbl")
    _log_layout().save(APPLICATION, folder / "log.rbl")


def _log_layout() -> rrb.Blueprint:
    """Views of a log's images, events and messages, with the default configuration's modes and mirror."""
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"])
    states = rr.StateConfiguration(
        values=[wire.LoopMode.Name(wire_mode(mode)) for mode in MODE_COLOURS],
        labels=list(MODE_NAMES.values()),
        colors=[(*colour, 255) for colour in MODE_COLOURS.values()],
    ).visualizer(mappings=[_field(STEP, "StateChange:state", "mode.name")])
    stages = {f"{stage}_ns[0]": [stage.replace("_", " ")] for stage in STAGES}
    images = rrb.Vertical(
        rrb.Spatial2DView(origin=f"/{FRAME.key}", name="frame, DN"),
        rrb.Spatial2DView(origin=f"/{SURFACE.at(MIRROR)}", name="mirror surface, nm"),
        rrb.TextLogView(origin=f"/{EVENT.key}", name="events", columns=columns),
    )
    loop = rrb.Vertical(
        rrb.StateTimelineView(origin=f"/{STEP.key}", name="loop mode", overrides={f"/{STEP.key}": states}),
        _plot(TRUTH, "true wavefront rms, nm", RMS),
        _plot(STEP, "flux, DN", {"flux_dn": ["flux"]}),
        _plot(TIMING, "stages of one frame in each batch, ns", stages),
        row_shares=[1, 2, 2, 2],
    )
    modes = rrb.Vertical(
        _plot(STEP, "measured error, nm", {"error_nm[]": MODES}),
        _plot(STEP, "command, nm", {"command_nm[]": MODES}, legend=False),
        _plot(STEP, "pseudo-open-loop, nm", {"pol_nm[]": MODES}, legend=False),
        _plot(TRUTH, "true residual, nm", {"residual_nm[]": MODES}, legend=False),
        row_shares=[3, 2, 2, 2],
    )
    panel = rrb.TimePanel(timeline=TIMELINE, state="collapsed")
    return rrb.Blueprint(rrb.Horizontal(images, loop, modes, column_shares=[2, 3, 3]), panel, collapse_panels=True)


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
    message = f"{topic.message.DESCRIPTOR.full_name}:message"
    return VisualizerComponentMapping(
        target, ComponentSourceKind.SourceComponent, source_component=message, selector=f".{selector}"
    )
