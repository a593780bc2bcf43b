"""Power spectra of the wavefront: open against closed, and what the law should leave of it."""

from math import ceil, floor, log10

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lowfc.adapters.logs.columns import frame_rate_hz
from lowfc.arrays import Array, Mask
from lowfc.control.laws.linear_law import integrator
from lowfc.control.laws.margins import rejection
from lowfc.control.laws.spectra import Spectrum, in_bins, pieces, spectrum
from lowfc.control.loop.safety import LoopMode
from lowfc.programs.view.draw.colours import GREEN, GREY, YELLOW
from lowfc.programs.view.draw.plots import BOX_HEIGHT, LABEL, Axes, at, lines, words
from lowfc.programs.view.panels.loop import MODE_NAMES
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.steady import Steady

TILTS, OTHERS = "spectra/tip_tilt", "spectra/other_modes"
PERIOD_NS = 2_000_000_000
WIDTH = 150.0
BOUNDS = rrb.VisualBounds2D(x_range=[-20, WIDTH + 6], y_range=[-17, BOX_HEIGHT + 11])

_HIGHEST_TILT = 3
_SEGMENT = 1024
_MOST_DECADES = 2
"""Decades by which a plot's scale may be taller than it has to."""
_MOST_LABELS = 6
_LEGEND_X, _LEGEND_Y = (25.0, 75.0, 125.0), -4.0
_STATE = (WIDTH - 34.0, BOX_HEIGHT - 12.0)
_LEAST = 1e-12
"""Of the highest power: what is below is drawn there."""
_NAMES, _COLOURS = ("pseudo-open-loop", "measured error", "rejection² x open"), (GREY, GREEN, YELLOW)
_WIDTHS = (1.2, 1.8, 0.6)
_MODES = {mode.value: name for mode, name in MODE_NAMES.items()}


class _LogAxes(Axes):
    """Logarithmic axes of one plot: they grow at once, and shrink where they are far too large."""

    def __init__(self, path: str) -> None:
        super().__init__(path, WIDTH)
        self._decades = (0, 0)

    def draw(self, stream: rr.RecordingStream, frequency_hz: Array, powers: list[Array], rate_hz: float) -> None:
        """Draw curves of power; none where there are none."""
        strips = []
        if powers:
            self._fit(stream, rate_hz, np.concatenate(powers))
            strips = [self.places(np.log10(frequency_hz), np.log10(power)) for power in powers]
        stream.log(f"{self.path}/curves", lines(strips, _COLOURS[: len(strips)], _WIDTHS[: len(strips)]))

    def _fit(self, stream: rr.RecordingStream, rate_hz: float, power: Array) -> None:
        low, high = floor(log10(power.min())), ceil(log10(power.max()) + 1e-9)
        taller = (self._decades[1] - self._decades[0]) - (high - low)
        if not (self._decades[0] <= low and high <= self._decades[1] and taller <= _MOST_DECADES):
            self._decades = (low, high)
        low, high = self._decades
        x = (log10(rate_hz / _SEGMENT), log10(rate_hz / 2))
        x_ticks = [(float(n), f"{10.0**n:g} Hz") for n in range(ceil(x[0]), floor(x[1]) + 1)]
        y_ticks = [(float(n), f"1e{n}") for n in range(low, high + 1, ceil((high - low) / _MOST_LABELS))]
        self.fit(stream, x, (low, high), x_ticks, y_ticks)


class Spectra(Panel):
    """Spectra of the last frames under one loop mode and one law, every other second."""

    def __init__(self) -> None:
        self._steady = Steady()
        self._axes = [_LogAxes(path) for path in (TILTS, OTHERS)]
        self._drawn_ns = 0

    def begin(self, stream: rr.RecordingStream) -> None:
        """Draw the legends."""
        strips = [np.array([[at_x - 10, _LEGEND_Y], [at_x + 10, _LEGEND_Y]]) for at_x in _LEGEND_X]
        texts = words([(at_x, _LEGEND_Y - LABEL - 6) for at_x in _LEGEND_X], _NAMES, _COLOURS)
        for axes in self._axes:
            stream.log(f"{axes.path}/legend/lines", lines(strips, _COLOURS, _WIDTHS), static=True)
            stream.log(f"{axes.path}/legend/names", texts, static=True)

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Keep what is new; now and then, draw."""
        calibration, steps = snapshot.calibration, snapshot.steps
        if not self._steady.feed(snapshot) or 0 <= snapshot.time_ns - self._drawn_ns < PERIOD_NS:
            return
        assert calibration is not None  # noqa: S101  # `feed` is False without one
        self._drawn_ns = snapshot.time_ns
        rate_hz = frame_rate_hz(snapshot.camera, steps)
        run = pieces(*self._steady.rows())
        found = spectrum(run, rate_hz) if rate_hz else None
        index = np.array(calibration.noll)
        at(stream, snapshot.time_ns)
        for axes, modes in zip(self._axes, (index <= _HIGHEST_TILT, index > _HIGHEST_TILT), strict=True):
            columns = [] if found is None or not modes.any() else self._columns(found, modes, rate_hz)
            state = f"last {run.frames / rate_hz:.1f} s" if columns else "too few frames yet"
            frequency_hz, powers = np.zeros(0), list[Array]()
            if found is not None and any(column[1:].any() for column in columns):
                frequency_hz, means = in_bins(found.frequency_hz, columns)
                least = _LEAST * max(float(mean.max()) for mean in means)
                powers = [np.maximum(mean, least) for mean in means]
            axes.draw(stream, frequency_hz, powers, rate_hz)
            separator = "," if columns else ":"
            text = f"loop {_MODES.get(self._steady.mode, 'unknown')}{separator} {state}"
            stream.log(f"{axes.path}/state", words([_STATE], [text]))

    def _columns(self, found: Spectrum, modes: Mask, rate_hz: float) -> list[Array]:
        """Power (frequencies,) of some of the modes: open, measured and, with the loop closed, in theory.

        An error is measured with noise, and so is the pseudo-open-loop: both are in the theory.
        """
        error, as_open = found.power_nm2_hz[:, : modes.size], found.power_nm2_hz[:, modes.size :]
        columns = [as_open[:, modes].sum(axis=1), error[:, modes].sum(axis=1)]
        law = self._steady.law
        if law is not None and not law.linear and self._steady.mode == LoopMode.CLOSED:
            noll = tuple(range(2, 2 + modes.size))
            integrating = integrator(law.gain, law.leak, noll, law.delay_frames, rate_hz)
            passed = rejection(integrating, found.frequency_hz)[:, modes] ** 2
            columns.append((passed * as_open[:, modes]).sum(axis=1))
        return columns
