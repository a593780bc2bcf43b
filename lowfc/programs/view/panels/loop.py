"""Loop panel: loop mode as a band, flux, saturated pixels, and the events of all processes."""

import numpy as np
import rerun as rr

from lowfc.contract.events import Level
from lowfc.contract.messages import from_timestamp
from lowfc.contract.printable import printable
from lowfc.control.loop.safety import LoopMode
from lowfc.programs.view.draw.colours import BLUE, GREEN, GREY, ORANGE, RED, Colour
from lowfc.programs.view.draw.plots import Plot, at
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.tile import clock

MODE, LOG = "loop/mode", "log"
FLUX = Plot("loop/flux", "Light, % of expected", {"light on the sensor, % of expected": ORANGE}, legend=None)
SATURATED = Plot("loop/saturated", "Pixels at full well", {"pixels at full well": RED}, legend=None)
MODE_COLOURS: dict[LoopMode, Colour] = {
    LoopMode.IDLE: GREY,
    LoopMode.OPEN: BLUE,
    LoopMode.CLOSED: GREEN,
    LoopMode.SAFE: RED,
}
MODE_NAMES = {mode: mode.name.lower() for mode in MODE_COLOURS}
_NAMES = {mode.value: mode.name for mode in LoopMode}
_LEVELS: dict[int, rr.TextLogLevel] = {
    Level.DEBUG: rr.TextLogLevel.DEBUG,
    Level.INFO: rr.TextLogLevel.INFO,
    Level.WARNING: rr.TextLogLevel.WARN,
    Level.ERROR: rr.TextLogLevel.ERROR,
    Level.FATAL: rr.TextLogLevel.CRITICAL,
}


class Loop(Panel):
    """Mode changes, flux, saturation, events."""

    plots = (FLUX, SATURATED)

    def __init__(self) -> None:
        self._mode = 0

    def begin(self, stream: rr.RecordingStream) -> None:
        """Send the names and colours of modes and curves."""
        style = rr.StateConfiguration(
            values=[mode.name for mode in MODE_COLOURS],
            labels=list(MODE_NAMES.values()),
            colors=[(*colour, 255) for colour in MODE_COLOURS.values()],
        )
        stream.log(MODE, style, static=True)
        super().begin(stream)

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Add the new data."""
        new, state = snapshot.new_exposures, snapshot.controller
        steps, used = snapshot.steps.at(new), snapshot.used[new]
        if not self._mode and state is not None and state.mode in _NAMES and state.HasField("mode_timestamp"):
            since_ns = from_timestamp(state.mode_timestamp)
            if not steps.time_ns.size or since_ns < steps.time_ns[0]:  # the mode began before the first step
                self._change(stream, state.mode, since_ns)
        for row in np.flatnonzero(np.diff(steps.mode.astype(int), prepend=self._mode)):
            self._change(stream, int(steps.mode[row]), int(steps.time_ns[row]))
        if snapshot.calibration is not None:
            percent = 100 * steps.flux_dn / snapshot.calibration.flux_dn
            for plot, values in ((FLUX, percent), (SATURATED, steps.saturated_pixels)):
                plot.add(stream, steps.time_ns, np.where(used, values, np.nan))
        for event in snapshot.events:
            time_ns = from_timestamp(event.timestamp)
            at(stream, time_ns)
            level = _LEVELS.get(event.level, rr.TextLogLevel.INFO)
            name, message = printable(event.name), printable(event.message)
            text = f"{clock(time_ns)}  {name}: {message}"  # rerun truncates its own time column
            stream.log(f"{LOG}/{name}", rr.TextLog(text, level=level))

    def _change(self, stream: rr.RecordingStream, mode: int, time_ns: int) -> None:
        self._mode = mode
        at(stream, time_ns)
        stream.log(MODE, rr.StateChange(state=_NAMES.get(mode, f"mode {mode}")))
