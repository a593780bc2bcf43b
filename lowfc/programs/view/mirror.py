"""The mirror's pictures: the surface at each actuator, which of them are at a limit, and the surface over the pupil."""

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.contract.codec import actuators
from lowfc.programs.view.colours import YELLOW, diverging
from lowfc.programs.view.marks import Pictures, at, caption, curves, name_curves
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel
from lowfc.programs.view.scale import Scale

COMMAND, SURFACE, STROKE = "mirror/command", "mirror/surface", "mirror/stroke"
_LIMITED = "at_limit"
_LEAST_NM = 1.0
_NEAR = 0.995
"""Share of the stroke from which on an actuator counts as at its limit: the driver's step and margins lie above."""


class Mirror(Panel):
    """The newest state, as a picture."""

    pictures = True

    def __init__(self) -> None:
        self._scales = {path: Scale(_LEAST_NM) for path in (COMMAND, SURFACE)}
        self._pictures = {path: Pictures(path) for path in (COMMAND, SURFACE)}
        self._limited = False

    def begin(self, stream: rr.RecordingStream) -> None:
        """Name what is drawn."""
        name_curves(stream, STROKE, ["largest stroke used, % of the limit"], [YELLOW])

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Show where the mirror is."""
        if moment.mirror is not None:
            surface_nm = actuators(moment.mirror)
            if surface_nm is not None:
                self._show(stream, COMMAND, moment.time_ns, surface_nm)
                self._mark(stream, moment, surface_nm)
        if moment.surface is not None:
            self._show(stream, SURFACE, moment.time_ns, moment.surface)

    def _show(self, stream: rr.RecordingStream, path: str, time_ns: int, values_nm: npt.NDArray[np.float32]) -> None:
        scale = self._scales[path]
        changed = scale.fit(values_nm, time_ns)
        self._pictures[path].show(stream, time_ns, diverging(values_nm / scale.limit))
        if changed:
            text = f"blue -{scale.limit:g}, orange +{scale.limit:g} nm"
            caption(stream, path, text, values_nm.shape)

    def _mark(self, stream: rr.RecordingStream, moment: Moment, surface_nm: npt.NDArray[np.float32]) -> None:
        """A ring round each actuator at its stroke."""
        stroke_nm = moment.controller.settings.stroke_nm if moment.controller is not None else 0.0
        if not stroke_nm:
            return
        largest = max(float(surface_nm.max()), -float(surface_nm.min())) / stroke_nm
        limited = largest >= _NEAR
        if limited or self._limited:
            rows, columns = np.nonzero(np.abs(surface_nm) >= _NEAR * stroke_nm)
            places = np.stack([columns + 0.5, rows + 0.5], axis=1)
            at(stream, moment.time_ns)
            stream.log(f"{COMMAND}/{_LIMITED}", rr.Points2D(places, radii=0.3, colors=[YELLOW]))
        self._limited = limited
        if moment.whole:
            curves(stream, STROKE, np.array([moment.time_ns]), np.array([100 * largest]))


def command_view() -> rrb.View:
    """Actuators."""
    return rrb.Spatial2DView(origin=COMMAND, name="Mirror, nm (ring: at limit)")


def surface_view() -> rrb.View:
    """Surface over the pupil."""
    return rrb.Spatial2DView(origin=SURFACE, name="Mirror over the pupil, nm")


def stroke_view() -> rrb.View:
    """Stroke used."""
    return rrb.TimeSeriesView(origin=STROKE, name="Mirror: stroke used, %")
