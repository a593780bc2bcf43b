"""Science camera panel: computed contrast of the dark zone, for the residual wavefront and with a flat mirror."""

from collections import deque

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.arrays import Array, Single
from lowfc.optics.chain.coronagraph import Coronagraph, Wedge
from lowfc.optics.chain.science_camera import ScienceCamera
from lowfc.programs.view.draw.colours import BLUE, GREEN, GREY, Rgb, sequential
from lowfc.programs.view.draw.pictures import Picture
from lowfc.programs.view.draw.plots import Plot, labels
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot

IMAGE = "science/image"
CONTRAST = Plot("science/contrast", "Computed contrast, mean over the inner 2 λ/D of the dark zone, log10", width=1.6)
_ZONE_WIDTH = 2.0
"""Width of the zone in which contrast is averaged, from the inner edge of the dark zone on, lambda / D."""

_AVERAGED = 5
"""Number of images averaged for one picture, each of the newest wavefront of a snapshot."""
_DARKEST, _BRIGHTEST = -10, -4
"""Range of the colour scale, log10 of contrast."""
_HALF_WIDTH, _SAMPLING = 12, 4  # half width of an image, lambda / D; samples per lambda / D, fewer for a larger zone
_SAMPLES = 2 * _HALF_WIDTH * _SAMPLING
_GAP, _BAR = 6, 5  # samples between the pictures, and across the colour scale
_SECOND = _SAMPLES + _GAP  # start of the second picture
_SCALE = 2 * _SECOND  # start of the colour scale
_WIDTH = _SCALE + _BAR
_LABEL = 5  # samples by which the viewer draws a label below its position
BOUNDS = rrb.VisualBounds2D(x_range=[-4, _WIDTH + 24], y_range=[-2 * _GAP - _LABEL, _SAMPLES + 14])
CONTRAST_AXIS = rrb.ScalarAxis(range=(_DARKEST, _BRIGHTEST - 1))
_NAMES = {
    "true": ("with a flat mirror, true wavefront", "now, true wavefront"),
    "measured": ("with a flat mirror, pseudo-open-loop", "now, measured error"),
}
"""Names of the curves for true and measured wavefronts; true ones are preferred."""


class Science(Panel):
    """Two images side by side and the mean contrast, once a second."""

    period_ns = 1_000_000_000

    def __init__(self, coronagraph: Coronagraph, wavelength_nm: float) -> None:
        self._coronagraph = coronagraph
        zone = coronagraph.dark_zone
        self._wedge = Wedge(zone.inner, min(zone.inner + _ZONE_WIDTH, zone.outer), zone.half_opening_deg)
        self._sampling = max(min(_SAMPLING, int(_SAMPLES / (2 * self._wedge.outer))), 1)
        self._wavelength_nm = wavelength_nm
        self._noll: tuple[int, ...] = ()
        self._camera: ScienceCamera | None = None
        self._unaberrated = np.nan
        self._wavefronts: dict[str, deque[tuple[Single, Single]]] = {
            source: deque(maxlen=_AVERAGED) for source in _NAMES
        }
        self._picture = Picture(f"{IMAGE}/contrast")
        self._named = ""

    def begin(self, stream: rr.RecordingStream) -> None:
        """Draw the static parts: the dark zone's inner edge, the zone of the mean contrast, and the colour scale."""
        outlined = _outlines(self._wedge, self._sampling)
        lines = [line + np.array([start, 0]) for start in (0, _SECOND) for line in outlined]
        outlines = rr.LineStrips2D(lines, colors=[GREY], radii=rr.Radius.ui_points(0.7))
        stream.log(f"{IMAGE}/outlines", outlines, static=True)
        decades = range(_DARKEST, _BRIGHTEST + 1)
        positions = [(_WIDTH + 12, _SAMPLES * (1 - float(_share(decade))) - _LABEL) for decade in decades]
        stream.log(f"{IMAGE}/scale", labels(positions, [f"1e{decade}" for decade in decades]), static=True)

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Keep the newest wavefront; draw when due."""
        if snapshot.calibration is None:
            return
        noll = snapshot.calibration.noll
        if self._camera is None or noll != self._noll:  # wavefronts of other modes are dropped
            self._noll = noll
            half_width = _SAMPLES // (2 * self._sampling)
            self._camera = ScienceCamera(self._coronagraph, noll, self._wavelength_nm, half_width, self._sampling)
            self._unaberrated = self._camera.mean_contrast(self._camera.image(np.zeros(len(noll))), self._wedge)
            self._clear()
        for source, wavefronts in self._wavefronts.items():
            new = snapshot.wavefronts(true=source == "true")
            if new.time_ns.size and new.residual_nm.shape[1] == len(self._noll):
                wavefronts.append((new.residual_nm[-1], new.open_nm[-1]))
        source = next((name for name, wavefronts in self._wavefronts.items() if wavefronts), "")
        if source and self.due(snapshot):
            self._show(stream, snapshot.time_ns, self._camera, source)
            self._clear()

    def _clear(self) -> None:
        for wavefronts in self._wavefronts.values():
            wavefronts.clear()

    def _show(self, stream: rr.RecordingStream, time_ns: int, camera: ScienceCamera, source: str) -> None:
        wavefronts = self._wavefronts[source]
        images = [np.mean([camera.image(wave[which]) for wave in wavefronts], axis=0) for which in (0, 1)]
        means = [camera.mean_contrast(image, self._wedge) for image in images]
        if source != self._named:
            self._named = source
            CONTRAST.name(stream, dict(zip((*_NAMES[source], "flat wavefront"), (GREY, GREEN, BLUE), strict=True)))
        self._picture.show(stream, time_ns, _side_by_side(*images))
        captions = [f"{title}: {mean:.1e}" for title, mean in zip(("now", "flat mirror"), means, strict=True)]
        positions = [(start + _SAMPLES / 2, -_LABEL - _GAP) for start in (0, _SECOND)]
        stream.log(f"{IMAGE}/captions", labels(positions, captions))
        CONTRAST.add_one(stream, time_ns, *np.log10([*reversed(means), self._unaberrated]))


def _share(decade: npt.NDArray[np.floating] | float) -> npt.NDArray[np.floating]:
    """Position on the colour scale, from 0 to 1, of log10 of a contrast."""
    return np.clip((np.asarray(decade) - _DARKEST) / (_BRIGHTEST - _DARKEST), 0, 1)


def _side_by_side(now: Single, flat: Single) -> Rgb:
    """Colours of both images and of the colour scale next to them, on black."""
    shares = np.zeros((_SAMPLES, _WIDTH))
    tiny = 10.0 ** (_DARKEST - 1)  # the logarithm of zero is undefined
    shares[:, :_SAMPLES] = _share(np.log10(now + tiny))
    shares[:, _SECOND : _SECOND + _SAMPLES] = _share(np.log10(flat + tiny))
    shares[:, _SCALE:] = np.linspace(1, 0, _SAMPLES)[:, None]
    return sequential(shares)


def _outlines(wedge: Wedge, sampling: int) -> list[Array]:
    """Lines (points, 2) in pixels of an image: the dark zone's inner edge, and the wedge on either side of the star."""
    angle = np.linspace(0, 2 * np.pi, 97)
    opening = np.deg2rad(wedge.half_opening_deg) * np.linspace(-1, 1, 33)
    arcs = [radius * _directions(opening) for radius in (wedge.inner, wedge.outer)]
    right = np.concatenate([arcs[0], arcs[1][::-1], arcs[0][:1]])
    return [_SAMPLES / 2 + sampling * line for line in (wedge.inner * _directions(angle), right, -right)]


def _directions(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)
