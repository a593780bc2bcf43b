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
            labels=[mode.name.lower() for mode in MODE_COLOURS],
            colors=[(*colour, 255) for colour in MODE_COLOURS.values()],
        )
        stream.log(MODE, style, static=True)
        name_curves(stream, FLUX, ["light on the sensor, % of expected"], [ORANGE])
        name_curves(stream, SATURATED, ["pixels at full well"], [RED])

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Add what is new."""
        steps = moment.steps
        for row in np.flatnonzero(np.diff(steps.mode.astype(int), prepend=self._mode)):
            self._mode = int(steps.mode[row])
            at(stream, int(steps.time_ns[row]))
            stream.log(MODE, rr.StateChange(state=_NAMES.get(self._mode, f"mode {self._mode}")))
        if steps.sequence.size and moment.calibration is not None:
            curves(stream, FLUX, steps.time_ns, 100 * steps.flux_dn / moment.calibration.flux_dn)
            curves(stream, SATURATED, steps.time_ns, steps.saturated_pixels.astype(float))
        for event in moment.events:
            time_ns = from_timestamp(event.timestamp)
            clock = datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%H:%M:%S")  # rerun's own column is cut
            at(stream, time_ns)
            level = _LEVELS.get(event.level, rr.TextLogLevel.INFO)
            name, message = printable(event.name), printable(event.message)
            stream.log(f"{LOG}/{name}", rr.TextLog(f"{clock}  {name}: {message}", level=level))


def mode_view() -> rrb.View:
    """The band."""
    return rrb.StateTimelineView(origin=MODE, name="Loop mode")


def light_view() -> rrb.View:
    """Light."""
    return rrb.TimeSeriesView(origin=FLUX, name="Light, % of expected")


def saturated_view() -> rrb.View:
    """Saturated pixels."""
    return rrb.TimeSeriesView(origin=SATURATED, name="Pixels at full well")


def log_view() -> rrb.View:
    """Events."""
    return rrb.TextLogView(
        origin=LOG,
        name="Events",
        columns=rrb.TextLogColumns(text_log_columns=["loglevel", "body"]),
    )
