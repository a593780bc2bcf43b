"""Power spectra of the wavefront: open against closed, and what the law should leave of it."""

from collections import deque
from math import ceil, floor, log10

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from lowfc.adapters.history import frame_rate_hz
from lowfc.control.error_budget import LinearLoop
from lowfc.control.safety import LoopMode
from lowfc.control.spectra import Spectrum, in_bins, pieces, spectrum
from lowfc.control.stability import settling_frames
from lowfc.programs.view.colours import GREEN, GREY, YELLOW
from lowfc.programs.view.marks import at, words
from lowfc.programs.view.moment import Moment
from lowfc.programs.view.panel import Panel

TILTS, OTHERS = "spectra/tip_tilt", "spectra/other_modes"
PERIOD_NS = 2_000_000_000
FRAMES = 6144
"""Of them the spectra are made: segments of 1024 frames, eleven of them."""
WIDTH, HEIGHT = 150.0, 90.0
"""Of the plot's box on its view, whose own axes count pixels."""

_HIGHEST_TILT = 3
_SEGMENT = 1024
_MOST_DECADES = 2
"""Decades by which a plot's scale may be taller than it has to."""
_MOST_LABELS = 6
_LABEL = 5.0  # by which the viewer sets a label below its place
_LEGEND_X, _LEGEND_Y = (25.0, 75.0, 125.0), -4.0
_STATE = (WIDTH - 34.0, HEIGHT - 12.0)
_LEAST = 1e-12
"""Of the highest power: what is below is drawn there."""
_CURVES = (
    ("pseudo-open-loop", GREY, 1.2),
    ("measured error", GREEN, 1.8),
    ("rejection² x open", YELLOW, 0.6),
)

_MODES = {mode.value: mode.name.lower() for mode in LoopMode}

Double = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
Law = tuple[tuple[float, ...], tuple[float, ...], float]
"""Gain and leak of each mode, and the delay in frames."""


class Axes:
    """A plot with logarithmic axes, in a view that has none: where a frequency and a power are, and the grid."""

    def __init__(self, path: str) -> None:
        self.path = path
        self._x = (0.0, 1.0)
        self._y = (0, 1)
        self._drawn = False

    def fit(self, stream: rr.RecordingStream, rate_hz: float, power: Double) -> None:
        """Hold these powers and the frequencies of this frame rate; the grid is drawn anew where it changes."""
        x = (log10(rate_hz / _SEGMENT), log10(rate_hz / 2))
        low, high = floor(log10(power.min())), ceil(log10(power.max()) + 1e-9)
        taller = (self._y[1] - self._y[0]) - (high - low)
        holds = self._y[0] <= low and high <= self._y[1] and taller <= _MOST_DECADES
        if self._drawn and x == self._x and holds:
            return
        self._x, self._y, self._drawn = x, (low, high), True
        self._draw_grid(stream)

    def places(self, frequency_hz: npt.ArrayLike, power: npt.ArrayLike) -> Double:
        """Where they are (points, 2) on the view; upwards is downwards there."""
        x, y = np.log10(frequency_hz), np.log10(power)
        share_x = (x - self._x[0]) / (self._x[1] - self._x[0])
        share_y = (y - self._y[0]) / (self._y[1] - self._y[0])
        return np.stack([WIDTH * share_x, HEIGHT * (1 - share_y)], axis=1)

    def _draw_grid(self, stream: rr.RecordingStream) -> None:
        decades_x = range(ceil(self._x[0]), floor(self._x[1]) + 1)
        decades_y = range(self._y[0], self._y[1] + 1, ceil((self._y[1] - self._y[0]) / _MOST_LABELS))
        x = self.places([10.0**decade for decade in decades_x], [1.0] * len(decades_x))[:, 0]
        y = self.places([1.0] * len(decades_y), [10.0**decade for decade in decades_y])[:, 1]
        box = np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT], [0, 0]])
        lines = [box, *(np.array([[at_x, 0], [at_x, HEIGHT]]) for at_x in x)]
        lines += [np.array([[0, at_y], [WIDTH, at_y]]) for at_y in y]
        grid = rr.LineStrips2D(lines, colors=[(70, 72, 80)], radii=rr.Radius.ui_points(0.5), draw_order=-1.0)
        stream.log(f"{self.path}/grid", grid)
        places = [(at_x, HEIGHT + 1) for at_x in x] + [(-11.0, at_y - _LABEL) for at_y in y]
        labels = [f"{10.0**decade:g} Hz" for decade in decades_x] + [f"1e{decade}" for decade in decades_y]
        stream.log(f"{self.path}/ticks", words(places, labels))


class Spectra(Panel):
    """Spectra of the last frames under one loop mode and one law, every other second."""

    def __init__(self) -> None:
        self._recent: deque[tuple[npt.NDArray[np.uint64], Single]] = deque()
        self._mode = 0
        self._law: Law | None = None
        self._settling = 0
        self._axes = {path: Axes(path) for path in (TILTS, OTHERS)}
        self._drawn_ns = 0

    def begin(self, stream: rr.RecordingStream) -> None:
        """Draw what stays: which line is what."""
        lines = [np.array([[at_x - 10, _LEGEND_Y], [at_x + 10, _LEGEND_Y]]) for at_x in _LEGEND_X]
        names, colours = [name for name, _, _ in _CURVES], [colour for _, colour, _ in _CURVES]
        widths = [width for _, _, width in _CURVES]
        for path in self._axes:
            legend = rr.LineStrips2D(lines, colors=colours, radii=rr.Radius.ui_points(widths))
            stream.log(f"{path}/legend/lines", legend, static=True)
            texts = words([(at_x, _LEGEND_Y - _LABEL - 6) for at_x in _LEGEND_X], names, colours)
            stream.log(f"{path}/legend/names", texts, static=True)

    def draw(self, stream: rr.RecordingStream, moment: Moment) -> None:
        """Keep what is new; now and then, draw."""
        calibration, steps = moment.calibration, moment.steps
        if calibration is None or not len(steps.error_nm) or steps.error_nm.shape[1] != len(calibration.noll):
            return
        self._keep(moment, len(calibration.noll))
        if 0 <= moment.time_ns - self._drawn_ns < PERIOD_NS:
            return
        self._drawn_ns = moment.time_ns
        rate_hz = frame_rate_hz(moment.camera, steps)
        sequence, signals = (np.concatenate(column) for column in zip(*self._recent, strict=True))
        run = pieces(sequence, signals)
        found = spectrum(run, rate_hz) if rate_hz else None
        mode = _MODES.get(self._mode, "unknown")
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

    def _keep(self, moment: Moment, modes: int) -> None:
        """Add new rows; what was before a change of mode or law is forgotten, and what has yet to settle left out."""
        steps, law = moment.steps, _law_of(moment, modes)
        changes = np.flatnonzero(np.diff(steps.mode.astype(int), prepend=self._mode))
        first = int(changes[-1]) if changes.size else 0
        if changes.size or law != self._law:
            self._recent.clear()
            self._mode, self._law = int(steps.mode[-1]), law
            self._settling = 0
            if law is not None and self._mode == LoopMode.CLOSED:
                gain, leak, _ = law
                self._settling = min(settling_frames(np.array(gain), np.array(leak)), FRAMES)
        signals = np.concatenate([steps.error_nm, steps.pol_nm], axis=1)
        left_out = min(self._settling, len(signals) - first)
        self._settling -= left_out
        self._recent.append((steps.sequence[first + left_out :], signals[first + left_out :]))
        kept = sum(len(sequence) for sequence, _ in self._recent)
        while kept - len(self._recent[0][0]) >= FRAMES:
            kept -= len(self._recent.popleft()[0])

    def _columns(self, found: Spectrum, modes: npt.NDArray[np.bool_], rate_hz: float) -> list[Double]:
        """Power (frequencies,) of some of the modes: open, measured and, with the loop closed, in theory.

        An error is measured with noise, and so is the pseudo-open-loop: both are in the theory.
        """
        error, as_open = found.power_nm2_hz[:, : modes.size], found.power_nm2_hz[:, modes.size :]
        columns = [as_open[:, modes].sum(axis=1), error[:, modes].sum(axis=1)]
        if self._law is not None and self._mode == LoopMode.CLOSED:
            gain, leak, delay_frames = self._law
            loop = LinearLoop(np.array(gain), np.array(leak), delay_frames, rate_hz)
            passed = loop.rejection(found.frequency_hz)[:, modes] ** 2
            columns.append((passed * as_open[:, modes]).sum(axis=1))
        return columns


def spectra_views() -> list[rrb.View]:
    """Tip and tilt, and the other modes."""
    bounds = rrb.VisualBounds2D(x_range=[-20, WIDTH + 6], y_range=[-17, HEIGHT + 11])
    titles = {TILTS: "Power spectrum of tip and tilt, nm²/Hz", OTHERS: "Power spectrum of the other modes, nm²/Hz"}
    return [rrb.Spatial2DView(origin=path, name=title, visual_bounds=bounds) for path, title in titles.items()]


def _draw_curves(
    stream: rr.RecordingStream, axes: Axes, found: Spectrum | None, columns: list[Double], rate_hz: float
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


def _law_of(moment: Moment, modes: int) -> Law | None:
    """The controller's; None where it does not tell, or is for other modes."""
    state = moment.controller
    if state is None or not len(state.gain) == len(state.leak) == modes or not state.delay_frames >= 1:
        return None
    return tuple(state.gain), tuple(state.leak), state.delay_frames
