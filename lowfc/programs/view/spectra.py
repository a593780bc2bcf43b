"""Power spectra of the wavefront: open against closed, and what the law should leave of it."""

from math import ceil, floor, log10

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.adapters.history import frame_rate_hz
from lowfc.control.error_budget import LinearLoop
from lowfc.control.safety import LoopMode
from lowfc.control.spectra import Spectrum, in_bins, pieces, spectrum
from lowfc.programs.view.axes import LABEL, Axes
from lowfc.programs.view.colours import GREEN, GREY, YELLOW
from lowfc.programs.view.loop import MODE_NAMES
from lowfc.programs.view.marks import at, words
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel
from lowfc.programs.view.steady import Steady

TILTS, OTHERS = "spectra/tip_tilt", "spectra/other_modes"
PERIOD_NS = 2_000_000_000
WIDTH, HEIGHT = 150.0, 90.0
"""Of the plot's box on its view, whose own axes count pixels."""

_HIGHEST_TILT = 3
_SEGMENT = 1024
_MOST_DECADES = 2
"""Decades by which a plot's scale may be taller than it has to."""
_MOST_LABELS = 6
_LEGEND_X, _LEGEND_Y = (25.0, 75.0, 125.0), -4.0
_STATE = (WIDTH - 34.0, HEIGHT - 12.0)
_LEAST = 1e-12
"""Of the highest power: what is below is drawn there."""
_CURVES = (
    ("pseudo-open-loop", GREY, 1.2),
    ("measured error", GREEN, 1.8),
    ("rejection² x open", YELLOW, 0.6),
)

_MODES = {mode.value: name for mode, name in MODE_NAMES.items()}

Double = npt.NDArray[np.float64]


class _Scales:
    """The axes of one plot, both logarithmic: they grow at once, and shrink where they are far too large."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._axes = Axes(path, WIDTH, HEIGHT)
        self._y = (0, 0)

    def fit(self, stream: rr.RecordingStream, rate_hz: float, power: Double) -> None:
        """Hold these powers and the frequencies of this frame rate."""
        low, high = floor(log10(power.min())), ceil(log10(power.max()) + 1e-9)
        taller = (self._y[1] - self._y[0]) - (high - low)
        if not (self._y[0] <= low and high <= self._y[1] and taller <= _MOST_DECADES):
            self._y = (low, high)
        low, high = self._y
        x = (log10(rate_hz / _SEGMENT), log10(rate_hz / 2))
        x_ticks = [(float(n), f"{10.0**n:g} Hz") for n in range(ceil(x[0]), floor(x[1]) + 1)]
        y_ticks = [(float(n), f"1e{n}") for n in range(low, high + 1, ceil((high - low) / _MOST_LABELS))]
        self._axes.fit(stream, x, (low, high), x_ticks, y_ticks)

    def places(self, frequency_hz: npt.ArrayLike, power: npt.ArrayLike) -> Double:
        """Where they are (points, 2) on the view."""
        return self._axes.places(np.log10(frequency_hz), np.log10(power))


class Spectra(Panel):
    """Spectra of the last frames under one loop mode and one law, every other second."""

    def __init__(self) -> None:
        self._steady = Steady()
        self._axes = {path: _Scales(path) for path in (TILTS, OTHERS)}
        self._drawn_ns = 0

    def begin(self, stream: rr.RecordingStream) -> None:
        """Draw what stays: which line is what."""
        lines = [np.array([[at_x - 10, _LEGEND_Y], [at_x + 10, _LEGEND_Y]]) for at_x in _LEGEND_X]
        names, colours = [name for name, _, _ in _CURVES], [colour for _, colour, _ in _CURVES]
        widths = [width for _, _, width in _CURVES]
        for path in self._axes:
            legend = rr.LineStrips2D(lines, colors=colours, radii=rr.Radius.ui_points(widths))
            stream.log(f"{path}/legend/lines", legend, static=True)
            texts = words([(at_x, _LEGEND_Y - LABEL - 6) for at_x in _LEGEND_X], names, colours)
            stream.log(f"{path}/legend/names", texts, static=True)

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Keep what is new; now and then, draw."""
        calibration, steps = moment.calibration, moment.steps
        if calibration is None or not len(steps.error_nm) or steps.error_nm.shape[1] != len(calibration.noll):
            return
        self._steady.feed(moment, len(calibration.noll))
        if 0 <= moment.time_ns - self._drawn_ns < PERIOD_NS:
            return
        self._drawn_ns = moment.time_ns
        rate_hz = frame_rate_hz(moment.camera, steps)
        run = pieces(*self._steady.rows())
        found = spectrum(run, rate_hz) if rate_hz else None
        mode = _MODES.get(self._steady.mode, "unknown")
        index = np.array(calibration.noll)
        at(stream, moment.time_ns)
        for axes, modes in zip(self._axes.values(), (index <= _HIGHEST_TILT, index > _HIGHEST_TILT), strict=True):
            columns = [] if found is None or not modes.any() else self._columns(found, modes, rate_hz)
            if not columns:
                said = f"loop {mode}: too few frames yet"
            else:
                said = f"loop {mode}, last {run.frames / rate_hz:.1f} s"
            _draw_curves(stream, axes, found, columns, rate_hz)
            stream.log(f"{axes.path}/state", words([_STATE], [said]))

    def _columns(self, found: Spectrum, modes: npt.NDArray[np.bool_], rate_hz: float) -> list[Double]:
        """Power (frequencies,) of some of the modes: open, measured and, with the loop closed, in theory.

        An error is measured with noise, and so is the pseudo-open-loop: both are in the theory.
        """
        error, as_open = found.power_nm2_hz[:, : modes.size], found.power_nm2_hz[:, modes.size :]
        columns = [as_open[:, modes].sum(axis=1), error[:, modes].sum(axis=1)]
        law = self._steady.law
        if law is not None and not law.linear and self._steady.mode == LoopMode.CLOSED:
            loop = LinearLoop(np.array(law.gain), np.array(law.leak), law.delay_frames, rate_hz)
            passed = loop.rejection(found.frequency_hz)[:, modes] ** 2
            columns.append((passed * as_open[:, modes]).sum(axis=1))
        return columns


def spectra_views() -> list[rrb.View]:
    """Tip and tilt, and the other modes."""
    bounds = rrb.VisualBounds2D(x_range=[-20, WIDTH + 6], y_range=[-17, HEIGHT + 11])
    titles = {TILTS: "Power spectrum of tip and tilt, nm²/Hz", OTHERS: "Power spectrum of the other modes, nm²/Hz"}
    return [rrb.Spatial2DView(origin=path, name=title, visual_bounds=bounds) for path, title in titles.items()]


def _draw_curves(
    stream: rr.RecordingStream, axes: _Scales, found: Spectrum | None, columns: list[Double], rate_hz: float
) -> None:
    """Draw columns (frequencies,) of power; none where there are none."""
    strips = []
    if found is not None and any(column[1:].any() for column in columns):
        centres_hz, means = in_bins(found.frequency_hz, columns)
        least = _LEAST * max(float(mean.max()) for mean in means)
        powers = [np.maximum(mean, least) for mean in means]
        axes.fit(stream, rate_hz, np.concatenate(powers))
        strips = [axes.places(centres_hz, power) for power in powers]
    colours = [colour for _, colour, _ in _CURVES[: len(strips)]]
    widths = rr.Radius.ui_points([width for _, _, width in _CURVES[: len(strips)]])
    stream.log(f"{axes.path}/curves", rr.LineStrips2D(strips, colors=colours, radii=widths))
