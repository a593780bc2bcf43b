"""Mirror panel: the surface at each actuator, with marks on those at the stroke limit, and over the pupil."""

import numpy as np
import rerun as rr

from lowfc.arrays import Single
from lowfc.contract.codecs.codec import actuators
from lowfc.programs.view.draw.colours import YELLOW
from lowfc.programs.view.draw.pictures import SignedPicture
from lowfc.programs.view.draw.plots import Plot, at
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot

ACTUATORS, SURFACE = "mirror/command", "mirror/surface"
STROKE = Plot("mirror/stroke", "Mirror: stroke used, %", {"largest stroke used, % of the limit": YELLOW}, legend=None)
_NEAR = 0.995
"""Fraction of the stroke limit from which an actuator is marked: the controller keeps a margin, the driver rounds."""


class Mirror(Panel):
    """Pictures of the newest mirror state."""

    pictures = True
    plots = (STROKE,)

    def __init__(self) -> None:
        self._actuators, self._surface = SignedPicture(ACTUATORS, "nm"), SignedPicture(SURFACE, "nm")
        self._limited = False

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Show the surface at the actuators and over the pupil."""
        surface_nm = actuators(snapshot.mirror) if snapshot.mirror is not None else None
        if surface_nm is not None:
            self._actuators.show_values(stream, snapshot.time_ns, surface_nm)
            self._mark(stream, snapshot, surface_nm)
        if snapshot.surface is not None:
            self._surface.show_values(stream, snapshot.time_ns, snapshot.surface)

    def _mark(self, stream: rr.RecordingStream, snapshot: Snapshot, surface_nm: Single) -> None:
        stroke_nm = snapshot.stroke_nm
        if not stroke_nm:
            return
        used_fraction = max(float(surface_nm.max()), -float(surface_nm.min())) / stroke_nm
        limited = used_fraction >= _NEAR
        if limited or self._limited:
            rows, columns = np.nonzero(np.abs(surface_nm) >= _NEAR * stroke_nm)
            positions = np.stack([columns + 0.5, rows + 0.5], axis=1)
            at(stream, snapshot.time_ns)
            stream.log(f"{ACTUATORS}/at_limit", rr.Points2D(positions, radii=0.3, colors=[YELLOW]))
        self._limited = limited
        if snapshot.complete:
            STROKE.add_one(stream, snapshot.time_ns, 100 * used_fraction)
