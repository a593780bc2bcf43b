"""Where the star's image wanders: tip against tilt of the last moments, in mas, over rings."""

from collections import deque

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.programs.view.colours import BLUE, GREY, YELLOW
from lowfc.programs.view.marks import at, words
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel
from lowfc.programs.view.scale import Scale
from lowfc.programs.view.wavefront import TIP_TILT

TRAIL = "pointing/trail"
_KEPT = 400
"""Points of the trail; of a faster loop not every one."""
_TRAIL_NS = 2_000_000_000
_RINGS = (0.25, 0.5, 1.0)
_LEAST_MAS = 0.5

Points = npt.NDArray[np.floating]


class Pointing(Panel):
    """The trail of the last two seconds; the outer ring follows it."""

    def __init__(self, nm_per_mas: float) -> None:
        self._nm_per_mas = nm_per_mas
        self._scale = Scale(_LEAST_MAS)
        self._pieces: deque[tuple[npt.NDArray[np.int64], Points]] = deque()

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Move the trail on."""
        if moment.calibration is None or not set(TIP_TILT) <= set(moment.calibration.noll):
            return
        columns = [moment.calibration.noll.index(index) for index in TIP_TILT]
        times_ns, modes_nm = moment.truths.time_ns, moment.truths.residual_nm
        if not times_ns.size:
            times_ns, modes_nm = moment.steps.time_ns, moment.steps.error_nm
        if not times_ns.size or modes_nm.shape[1] != len(moment.calibration.noll):
            return
        mas = modes_nm[:, columns] / self._nm_per_mas
        whole = np.isfinite(mas).all(axis=1)
        self._pieces.append((times_ns[whole], mas[whole]))
        while self._pieces and self._pieces[0][0].max(initial=0) < moment.time_ns - _TRAIL_NS:
            self._pieces.popleft()
        if self._pieces:
            self._show(stream, moment.time_ns)

    def _show(self, stream: rr.RecordingStream, time_ns: int) -> None:
        mas = np.concatenate([piece for _, piece in self._pieces])
        mas = mas[:: max(1, len(mas) // _KEPT)]
        if not len(mas):
            return
        at(stream, time_ns)
        if self._scale.fit(mas, time_ns):
            self._draw_rings(stream)
        places = _screen(mas / self._scale.limit)
        fading = np.linspace(40, 220, len(places)).astype(np.uint8)
        colours = np.concatenate([np.tile(BLUE, (len(places), 1)), fading[:, None]], axis=1).astype(np.uint8)
        stream.log(f"{TRAIL}/points", rr.Points2D(places, colors=colours, radii=0.012))
        stream.log(f"{TRAIL}/now", rr.Points2D(places[-1:], colors=[YELLOW], radii=0.035))

    def _draw_rings(self, stream: rr.RecordingStream) -> None:
        turn = np.linspace(0, 2 * np.pi, 97)
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        cross = [np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]])]
        lines = [*(circle * ring for ring in _RINGS), *cross]
        stream.log(f"{TRAIL}/rings", rr.LineStrips2D(lines, colors=[GREY], radii=0.003))
        labels = [f"{ring * self._scale.limit:g} mas" for ring in _RINGS]
        places = _screen(np.array([[0.0, ring] for ring in _RINGS]))
        stream.log(f"{TRAIL}/labels", words(places, labels))


def pointing_view() -> rrb.View:
    """The trail."""
    return rrb.Spatial2DView(
        origin=TRAIL,
        name="Residual pointing, mas",
        visual_bounds=rrb.VisualBounds2D(x_range=[-1.15, 1.15], y_range=[-1.15, 1.15]),
    )


def _screen(points: Points) -> Points:
    """Upwards is downwards on a screen."""
    return np.asarray(points * np.array([1.0, -1.0]))
