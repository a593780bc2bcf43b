"""How the loop runs: its mode as a band, the light, saturated pixels, and what every process said."""

from datetime import UTC, datetime

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lowfc.contract.events import Level
from lowfc.contract.messages import from_timestamp
from lowfc.contract.printable import printable
from lowfc.control.safety import LoopMode
from lowfc.programs.view.colours import BLUE, GREEN, GREY, ORANGE, RED, Colour
from lowfc.programs.view.marks import at, curves, name_curves
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel

MODE, FLUX, SATURATED, LOG = "loop/mode", "loop/flux", "loop/saturated", "log"
MODE_COLOURS: dict[LoopMode, Colour] = {
    LoopMode.IDLE: GREY,
    LoopMode.OPEN: BLUE,
    LoopMode.CLOSED: GREEN,
    LoopMode.SAFED: RED,
}
MODE_NAMES = {mode: "safe" if mode is LoopMode.SAFED else mode.name.lower() for mode in MODE_COLOURS}
_NAMES = {mode.value: mode.name for mode in LoopMode}
_LEVELS: dict[int, rr.TextLogLevel] = {
    Level.DEBUG: rr.TextLogLevel.DEBUG,
    Level.INFO: rr.TextLogLevel.INFO,
    Level.WARNING: rr.TextLogLevel.WARN,
    Level.ERROR: rr.TextLogLevel.ERROR,
    Level.FATAL: rr.TextLogLevel.CRITICAL,
}


class Loop(Panel):
    """Mode changes, light, saturation, events."""

    def __init__(self) -> None:
        self._mode = 0

    def begin(self, stream: rr.RecordingStream) -> None:
        """Name what is drawn."""
        style = rr.StateConfiguration(
            values=[mode.name for mode in MODE_COLOURS],
            labels=list(MODE_NAMES.values()),
            colors=[(*colour, 255) for colour in MODE_COLOURS.values()],
        )
        stream.log(MODE, style, static=True)
        name_curves(stream, FLUX, ["light on the sensor, % of expected"], [ORANGE])
        name_curves(stream, SATURATED, ["pixels at full well"], [RED])

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Add what is new."""
        steps, state = moment.steps, moment.controller
        if not self._mode and state is not None and state.mode in _NAMES and state.HasField("mode_timestamp"):
            since_ns = from_timestamp(state.mode_timestamp)
            if not steps.time_ns.size or since_ns < steps.time_ns[0]:  # before the view began
                self._change(stream, state.mode, since_ns)
        for row in np.flatnonzero(np.diff(steps.mode.astype(int), prepend=self._mode)):
            self._change(stream, int(steps.mode[row]), int(steps.time_ns[row]))
        if steps.sequence.size and moment.calibration is not None:
            light = np.stack([100 * steps.flux_dn / moment.calibration.flux_dn, steps.saturated_pixels], axis=1)
            light[~np.isfinite(steps.error_nm).all(axis=1)] = np.nan  # of a refused frame neither is measured
            curves(stream, FLUX, steps.time_ns, light[:, 0])
            curves(stream, SATURATED, steps.time_ns, light[:, 1])
        for event in moment.events:
            time_ns = from_timestamp(event.timestamp)
            clock = datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%H:%M:%S")  # rerun's own column is cut
            at(stream, time_ns)
            level = _LEVELS.get(event.level, rr.TextLogLevel.INFO)
            name, message = printable(event.name), printable(event.message)
            stream.log(f"{LOG}/{name}", rr.TextLog(f"{clock}  {name}: {message}", level=level))

    def _change(self, stream: rr.RecordingStream, mode: int, time_ns: int) -> None:
        self._mode = mode
        at(stream, time_ns)
        stream.log(MODE, rr.StateChange(state=_NAMES.get(mode, f"mode {mode}")))


def mode_view() -> rrb.View:
    """The band."""
    return rrb.StateTimelineView(origin=MODE, name="Loop mode")


def light_view() -> rrb.View:
    """Light."""
    return rrb.TimeSeriesView(origin=FLUX, name="Light, % of expected")


def saturated_view() -> rrb.View:
    """Saturated pixels."""
    return rrb.TimeSeriesView(origin=SATURATED, name="Pixels at full well")


def log_view(*, worst: bool = False) -> rrb.View:
    """Events; or the warnings and errors among them."""
    shown = [rr.TextLogLevel.WARN, rr.TextLogLevel.ERROR, rr.TextLogLevel.CRITICAL]
    return rrb.TextLogView(
        origin=LOG,
        name="Warnings and errors" if worst else "Events",
        rows=rrb.TextLogRows(filter_by_log_level=shown) if worst else None,
        columns=rrb.TextLogColumns(text_log_columns=["loglevel", "body"]),
    )
