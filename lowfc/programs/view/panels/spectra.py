"""Panel of power spectra: pseudo-open-loop, measured error, and the prediction from an integrator's rejection."""

from math import ceil, floor, log10

import numpy as np
import rerun as rr

from lowfc.adapters.logs.columns import frame_rate_hz
from lowfc.arrays import Array, Mask
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.control.laws.linear_law import integrator
from lowfc.control.laws.margins import rejection
from lowfc.control.laws.spectra import SHORTEST, Spectrum, means_in_bins, spectrum, time_series
from lowfc.control.loop.safety import LoopMode, mode_name
from lowfc.programs.view.draw.colours import GREEN, GREY, YELLOW
from lowfc.programs.view.draw.plots import BOX_HEIGHT, Axes, at, labels
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.snapshot import Snapshot
from lowfc.programs.view.verdicts.steady import LawInForce, SteadyFrames

TILTS, OTHERS = "spectra/tip_tilt", "spectra/other_modes"
WIDTH = 150.0

_SEGMENT = 1024  # frames; the axis begins at the lowest frequency of such a segment
_MAX_DECADES = 2
"""Decades by which a scale may exceed the range of the data before it shrinks."""
_MAX_LABELS = 6
_STATE_POSITION = (WIDTH - 34.0, BOX_HEIGHT - 12.0)
_LEAST = 1e-12
"""Lowest power drawn, as a fraction of the highest; lower values are drawn at that power."""
_NAMES, _COLOURS = ("pseudo-open-loop", "measured error", "rejection² x open"), (GREY, GREEN, YELLOW)
_WIDTHS = (1.2, 1.8, 0.6)


class Spectra(Panel):
    """Spectra of the last frames since loop mode or law changed, drawn every two seconds.

    If there are too few of these frames at the end of a log, the last spectra from before the change are drawn.
    """

    def __init__(self) -> None:
        self._steady = SteadyFrames()
        self._axes = [Axes(path, WIDTH) for path in (TILTS, OTHERS)]
        self._last: dict[str, tuple[str, Array, list[Array]]] = {}
        self._decades = dict.fromkeys((TILTS, OTHERS), (0, 0))

    def begin(self, stream: rr.RecordingStream) -> None:
        """Draw the legends."""
        for axes in self._axes:
            axes.name(stream, _NAMES, _COLOURS)

    def draw(self, stream: rr.RecordingStream, snapshot: Snapshot) -> None:
        """Keep the new frames; draw when due."""
        calibration, steady = snapshot.calibration, self._steady
        fed, ended = steady.feed(snapshot), snapshot.ended is not None
        if calibration is None or not steady.mode or not (ended or (fed and self.due(snapshot))):
            return
        rate_hz = frame_rate_hz(snapshot.camera, snapshot.steps)
        series = time_series(*steady.rows())
        spectra = spectrum(series, rate_hz) if rate_hz else None
        tilts = np.isin(calibration.noll, TIP_TILT)
        law = steady.law if steady.mode == LoopMode.CLOSED else None
        loop = f"loop {mode_name(steady.mode)}"
        at(stream, snapshot.time_ns)
        for axes, modes in zip(self._axes, (tilts, ~tilts), strict=True):
            why = f"fewer than {SHORTEST} steady frames" if modes.any() else "no such modes"
            text, frequency_hz, powers = f"{loop}: {why}", np.zeros(0), list[Array]()
            if spectra is not None and modes.any():
                text = f"{loop}, last {series.frames / rate_hz:.1f} s"
                frequency_hz, powers = power_curves(spectra, modes, law, rate_hz)
                self._last[axes.path] = text, frequency_hz, powers
            elif ended and modes.any() and axes.path in self._last:  # no more frames will come
                text, frequency_hz, powers = self._last[axes.path]
                text += " before a change"
            if powers and rate_hz:  # otherwise the axes stay: without a curve, or with those of the last drawing
                self._fit(stream, axes, rate_hz, np.concatenate(powers))
            axes.draw(stream, np.log10(frequency_hz), [np.log10(power) for power in powers], _COLOURS, _WIDTHS)
            stream.log(f"{axes.path}/state", labels([_STATE_POSITION], [text]))

    def _fit(self, stream: rr.RecordingStream, axes: Axes, rate_hz: float, power: Array) -> None:
        """Fit the axes: they grow at once, and shrink only if they are far too large."""
        low, high = floor(log10(power.min())), ceil(log10(power.max()) + 1e-9)
        drawn_low, drawn_high = self._decades[axes.path]
        if drawn_low <= low and high <= drawn_high and drawn_high - drawn_low <= high - low + _MAX_DECADES:
            low, high = drawn_low, drawn_high
        self._decades[axes.path] = low, high
        x = (log10(rate_hz / _SEGMENT), log10(rate_hz / 2))
        x_ticks = [(float(n), f"{10.0**n:g} Hz") for n in range(ceil(x[0]), floor(x[1]) + 1)]
        y_ticks = [(float(n), f"1e{n}") for n in range(low, high + 1, ceil((high - low) / _MAX_LABELS))]
        axes.fit(stream, x, (low, high), x_ticks, y_ticks)


def power_curves(spectra: Spectrum, modes: Mask, law: LawInForce | None, rate_hz: float) -> tuple[Array, list[Array]]:
    """Frequency, Hz, and power spectra summed over `modes`, nm^2/Hz: pseudo-open-loop, error, prediction.

    `spectra` has a column for the error of each mode, then one for the pseudo-open-loop of each mode, all with noise.
    `law` is None if the loop is not closed or its law is unknown. Only an integrator has a prediction. A constant
    wavefront has no curves.
    """
    error, pol = spectra.power_nm2_hz[:, : modes.size], spectra.power_nm2_hz[:, modes.size :]
    columns = [pol[:, modes].sum(axis=1), error[:, modes].sum(axis=1)]
    if law is not None and not law.linear:
        any_noll = tuple(range(2, 2 + modes.size))  # the rejection does not depend on the indices
        integrating = integrator(law.gain, law.leak, any_noll, law.delay_frames, rate_hz)
        squared_rejection = rejection(integrating, spectra.frequency_hz)[:, modes] ** 2
        columns.append((squared_rejection * pol[:, modes]).sum(axis=1))
    if not any(column[1:].any() for column in columns):
        return np.zeros(0), []
    frequency_hz, means = means_in_bins(spectra.frequency_hz, columns)
    least = _LEAST * max(float(mean.max()) for mean in means)
    return frequency_hz, [np.maximum(mean, least) for mean in means]
