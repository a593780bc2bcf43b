"""Pointing panel: residual tip and tilt of the last two seconds as points in a plane, in mas, with rings."""

from collections import deque
from math import ceil

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.arrays import Long
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.programs.view.draw.colours import BLUE, GREY, YELLOW
from lowfc.programs.view.draw.pictures import Scale
from lowfc.programs.view.draw.plots import at, labels
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot

TRAIL = "pointing/trail"
BOUNDS = rrb.VisualBounds2D(x_range=[-1.15, 1.15], y_range=[-1.15, 1.15])
_MAX_POINTS = 400
"""Largest number of points of the trail; for a fast loop, not every frame has a point."""
_TRAIL_NS = 2_000_000_000
_RINGS = (0.25, 0.5, 1.0)  # radii as fractions of the scale
_MIN_MAS = 0.5  # smallest scale

Points = npt.NDArray[np.floating]


class Pointing(Panel):
    """The trail of the last two seconds, and rings whose scale follows the trail's largest deviation."""

    def __init__(self, nm_per_mas: float) -> None:
        self._nm_per_mas = nm_per_mas
        self._scale = Scale(_MIN_MAS)
        self._pieces: deque[tuple[Long, Points]] = deque()

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Update the trail."""
        if snapshot.calibration is None or not set(TIP_TILT) <= set(snapshot.calibration.noll):
            return
        noll = snapshot.calibration.noll
        wavefronts = snapshot.wavefronts(true=snapshot.truths.time_ns.size > 0)
        if not wavefronts.time_ns.size or wavefronts.residual_nm.shape[1] != len(noll):
            return
        mas = wavefronts.residual_nm[:, [noll.index(index) for index in TIP_TILT]] / self._nm_per_mas
        finite = np.isfinite(mas).all(axis=1)
        self._pieces.append((wavefronts.time_ns[finite], mas[finite]))
        while self._pieces and self._pieces[0][0].max(initial=0) < snapshot.time_ns - _TRAIL_NS:
            self._pieces.popleft()
        mas = np.concatenate([piece for _, piece in self._pieces] or [mas[:0]])
        if not len(mas):
            return
        mas = mas[:: -ceil(len(mas) / _MAX_POINTS)][::-1]  # every nth point, counted from the newest
        at(stream, snapshot.time_ns)
        if self._scale.fit(mas, snapshot.time_ns):
            self._draw_rings(stream)
        positions = _screen(mas / self._scale.limit)
        fading = np.linspace(40, 220, len(positions)).astype(np.uint8)
        colours = np.concatenate([np.tile(BLUE, (len(positions), 1)), fading[:, None]], axis=1).astype(np.uint8)
        stream.log(f"{TRAIL}/points", rr.Points2D(positions, colors=colours, radii=0.012))
        stream.log(f"{TRAIL}/now", rr.Points2D(positions[-1:], colors=[YELLOW], radii=0.035))

    def _draw_rings(self, stream: rr.RecordingStream) -> None:
        angle = np.linspace(0, 2 * np.pi, 97)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        cross = [np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]])]
        lines = [*(circle * ring for ring in _RINGS), *cross]
        stream.log(f"{TRAIL}/rings", rr.LineStrips2D(lines, colors=[GREY], radii=0.003))
        texts = [f"{ring * self._scale.limit:g} mas" for ring in _RINGS]
        positions = _screen(np.array([[0.0, ring] for ring in _RINGS]))
        stream.log(f"{TRAIL}/labels", labels(positions, texts))


def _screen(points: Points) -> Points:
    """Flip the y axis, which points down on a screen."""
    return np.asarray(points * np.array([1.0, -1.0]))
