"""A mode's disturbance model of drift, lines and white noise, fitted to the spectrum of pseudo-open-loop modes.

The fit is Whittle's: it minimises the sum of log P + J / P over frequencies, with J the periodogram (Hann's window) and
P the model's spectrum. A further line must raise the likelihood by more than chance does among all frequencies.
"""

from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from scipy.fft import rfft
from scipy.linalg import block_diag
from scipy.optimize import minimize

from lowfc.arrays import Array
from lowfc.control.laws.spectra import TimeSeries

FEWEST = 2048
"""Least number of consecutive frames for a fit."""

_LONGEST = 1 << 16  # largest number of frames of a segment
_MAX_LINES = 12
_SCALES = (3, 9, 27, 81)  # numbers of frequencies over which lines are searched
_PENALTY = 2.5  # cost of a line in log-likelihood / log(frequencies): 1.5 for its 3 parameters (BIC), 1 for choosing it
_NARROW_SHARE = 0.3  # a narrower line is preferred if it reaches this part of the largest gain in likelihood
_HANN = 1.5  # under Hann's window neighbouring frequencies are correlated: three count as two
_LOBE = 12  # frequencies on either side of a line into which the window spreads the line
_UNAVERAGED = 40  # frequencies on either side of a line, and from 0 on, that are not averaged
_PER_DECADE = 48  # groups of averaged frequencies in a decade
_MIN_DRIFT = 1e-8  # ratio of variances of the drift's step and the noise: a constant is followed in 10^4 frames
_MIN_NOISE = 1e-3  # least ratio of noise to the level at high frequencies: a filter needs some noise


@dataclass(frozen=True, slots=True)
class Line:
    """A lightly damped vibration: `width_hz` between half-power points, variance in nm^2."""

    frequency_hz: float
    width_hz: float
    variance_nm2: float


@dataclass(frozen=True, slots=True)
class Model:
    """A mode's disturbance and the noise of measuring it.

    Attributes:
        drift_nm2: variance of a random walk's step per frame, before the low-pass.
        cutoff_hz: corner of the low-pass of the random walk; infinite without a low-pass.
        lines: vibration lines.
        noise_nm2: variance of one frame's white measurement noise.
        rate_hz: frame rate.
        lowest_hz: frequency below which the drift's spectrum is assumed flat: a log does not show slower changes.
    """

    drift_nm2: float
    cutoff_hz: float
    lines: tuple[Line, ...]
    noise_nm2: float
    rate_hz: float
    lowest_hz: float = 0.0

    def spectrum_nm2(self, omega: Array) -> Array:
        """Spectrum (frequencies,) of the disturbance without noise, nm^2, at frequencies in rad per frame.

        Its mean over all frequencies from -pi to pi is the variance.
        """
        shown = np.maximum(omega, 2 * np.pi * self.lowest_hz / self.rate_hz)
        power = _drift(shown, self.drift_nm2, self.cutoff_hz / self.rate_hz)
        for line in self.lines:
            power = power + _line(omega, *_per_frame(line, self.rate_hz))
        return power

    def states(self) -> tuple[Array, Array, Array]:
        """A, Q (states, states), C (states,) of x[k] = A x[k-1] + q, disturbance[k] = C x[k]; Q the covariance of q."""
        step, seen = [1.0], [1.0]
        if np.isfinite(self.cutoff_hz):  # x0 the walk, x1 its low-pass
            step, seen = [1.0, 1 - _kept(self.cutoff_hz / self.rate_hz)], [0.0, 1.0]
        parts = [self.drift_nm2 * np.outer(step, step)]
        for line in self.lines:
            _, decay, variance = _per_frame(line, self.rate_hz)
            parts.append(variance * (1 - decay**2) * np.eye(2))
            seen += [1.0, 0.0]
        return self.mean_over(1.0, 0.0), block_diag(*parts), np.array(seen)

    def mean_over(self, start: float, length: float) -> Array:
        """Mean (states, states) of A^u over u from start to start + length frames, with A of `states`."""

        def mean_of(exponent: complex) -> complex:
            if not length or not exponent:
                return complex(np.exp(exponent * start))
            return complex(np.exp(exponent * start) * np.expm1(exponent * length) / (exponent * length))

        blocks = [np.ones((1, 1))]
        if np.isfinite(self.cutoff_hz):
            kept = mean_of(-2 * np.pi * self.cutoff_hz / self.rate_hz).real
            blocks = [np.array([[1.0, 0.0], [1 - kept, kept]])]
        for line in self.lines:
            omega, decay, _ = _per_frame(line, self.rate_hz)
            mean = mean_of(complex(np.log(decay), omega))
            blocks.append(np.array([[mean.real, -mean.imag], [mean.imag, mean.real]]))
        return np.asarray(block_diag(*blocks))


def identify(series: TimeSeries, rate_hz: float) -> Model | None:
    """The model of a mode, from its pseudo-open-loop values (frames, 1) in pieces; None if there are too few.

    The loop may be closed or open: in both cases the pseudo-open-loop modes are disturbance plus white noise.
    """
    whittle = _Whittle.of(series, rate_hz)
    if whittle is None:
        return None
    found = [whittle.fit(robust) for robust in (True, False)]  # a robust floor may be far off at the lowest frequencies
    return replace(min(found, key=whittle.cost), lowest_hz=rate_hz / series.longest)


def resolution_hz(series: TimeSeries, rate_hz: float) -> float:
    """Frequency spacing of the periodogram that `identify` fits; 0 if there is none."""
    return rate_hz / min(series.longest, _LONGEST) if series.longest >= FEWEST else 0.0


@dataclass(frozen=True, slots=True)
class _Whittle:
    """Fits to a periodogram (frequencies,), the mean of `segments`, without its first three and its last frequency."""

    omega: Array
    power: Array
    segments: int
    rate_hz: float

    @classmethod
    def of(cls, series: TimeSeries, rate_hz: float) -> "_Whittle | None":
        frames = min(series.longest, _LONGEST)
        if frames < FEWEST:
            return None
        window = np.hanning(frames + 2)[1:-1]
        window /= np.sqrt(np.sum(window**2))
        power, segments = np.zeros(frames // 2 + 1), 0
        for piece in series.values:
            for start in range(0, len(piece) - frames + 1, frames):
                values = piece[start : start + frames, 0]
                power += np.abs(rfft(window * (values - values.mean()))) ** 2
                segments += 1
        keep = slice(3, -1)  # the lowest are removed with the mean, and at half the frame rate the distribution differs
        omega = 2 * np.pi * np.arange(power.size) / frames
        return cls(omega[keep], np.maximum(power[keep] / segments, 1e-300), segments, rate_hz)

    @property
    def frequency_hz(self) -> Array:
        return np.asarray(self.omega * self.rate_hz / (2 * np.pi))

    @property
    def spacing_hz(self) -> float:
        return float((self.omega[1] - self.omega[0]) * self.rate_hz / (2 * np.pi))

    def fit(self, robust: bool) -> Model:
        """Fit the floor, then lines one by one, then all parameters; unknown lines hardly affect a `robust` floor."""
        model = self.fit_floor(Model(0.0, np.inf, (), 1.0, self.rate_hz), robust)
        while len(model.lines) < _MAX_LINES:
            line = self.another_line(model)
            if line is None:
                break
            model = self.fit_floor(replace(model, lines=(*model.lines, line)), robust=False)
        lines = tuple(sorted(model.lines, key=lambda line: line.frequency_hz))
        model = self.fit_all(replace(model, lines=lines))
        needed = self.needed(model)
        return model if needed == model.lines else self.fit_all(replace(model, lines=needed))

    def cost(self, model: Model) -> float:
        """Negative log-likelihood with the penalty of each line, up to a constant."""
        misfit = self.misfit(self.power, model.spectrum_nm2(self.omega) + model.noise_nm2, 1.0)
        return misfit + float(_PENALTY * np.log(self.omega.size)) * len(model.lines)

    def misfit(self, power: Array, spectrum: Array, counts: Array | float) -> float:
        """Negative log-likelihood, up to a constant."""
        return float((counts * (np.log(spectrum) + power / spectrum)).sum()) * self.segments / _HANN

    def grouped(self, lines: tuple[Line, ...], robust: bool) -> tuple[Array, Array, Array]:
        """Means of frequency and power, and count, of groups: single frequencies near lines and 0, else logarithmic."""
        places = np.arange(self.omega.size)
        group = _UNAVERAGED + np.floor(_PER_DECADE * np.log10(np.maximum(places, 1)))
        single = places < _UNAVERAGED
        for line in lines:
            near = max(_UNAVERAGED * self.spacing_hz, 4 * line.width_hz)
            single |= np.abs(self.frequency_hz - line.frequency_hz) < near
        fresh = np.diff(group, prepend=-1) != 0
        fresh |= single | np.concatenate([[True], single[:-1]])
        starts = np.flatnonzero(fresh)
        counts = np.diff(starts, append=places.size)
        omega, power = (np.add.reduceat(each, starts) / counts for each in (self.omega, self.power))
        if robust:  # medians: unknown lines hardly affect them
            parts = np.split(self.power, starts[1:])
            median = 1 if self.segments > 1 else np.log(2)  # median / mean of exponentially distributed power
            power = np.array([np.median(part) / median if part.size > 4 else np.nan for part in parts])
            valid = np.isfinite(power)
            return omega[valid], power[valid], counts[valid].astype(float)
        return omega, power, counts.astype(float)

    def fit_floor(self, model: Model, robust: bool) -> Model:
        """Refit the floor, which is drift and noise, with fixed lines."""
        omega, power, counts = self.grouped(model.lines, robust)
        line_power = replace(model, drift_nm2=0.0).spectrum_nm2(omega)
        white = float(np.median(self.power[self.power.size // 2 :])) / (np.log(2) if self.segments == 1 else 1)
        low = slice(0, max(8, omega.size // 20))
        step = float(np.median(np.maximum(power[low] - white - line_power[low], 1e-3 * white) * omega[low] ** 2))
        fits: list[tuple[float, tuple[float, float, float]]] = []
        for cutoff in (np.inf, 0.03, 0.003):  # initial corner, cycles per frame

            def floor_of(parameters: Array, cutoff: float = cutoff) -> tuple[float, float, float]:
                noise_nm2 = float(np.exp(parameters[1]))
                drift_nm2 = max(float(np.exp(parameters[0])), _MIN_DRIFT * noise_nm2)
                if not np.isfinite(cutoff):
                    return drift_nm2, np.inf, noise_nm2
                corner_hz = float(np.exp(min(parameters[2], 0.0))) * self.rate_hz
                return drift_nm2, min(max(corner_hz, self.spacing_hz), self.rate_hz / 2), noise_nm2

            def cost(parameters: Array) -> float:
                drift_nm2, cutoff_hz, noise_nm2 = floor_of(parameters)
                floor = _drift(omega, drift_nm2, cutoff_hz / self.rate_hz) + noise_nm2
                return self.misfit(power, floor + line_power, counts)

            start = np.log([step, white] + ([cutoff] if np.isfinite(cutoff) else []))
            found = minimize(cost, start, method="Nelder-Mead", options={"maxiter": 300, "xatol": 1e-2, "fatol": 1e-2})
            penalty = 0.5 * len(start) * np.log(self.omega.size)
            fits.append((found.fun + penalty, floor_of(found.x)))
        _, (drift_nm2, cutoff_hz, noise_nm2) = min(fits, key=lambda fit: fit[0])
        noise_nm2 = max(noise_nm2, _MIN_NOISE * white)
        return replace(model, drift_nm2=drift_nm2, cutoff_hz=cutoff_hz, noise_nm2=noise_nm2)

    def another_line(self, model: Model) -> Line | None:
        """The most significant line that the model lacks; None if none is significant."""
        spectrum = model.spectrum_nm2(self.omega) + model.noise_nm2
        ratio = self.power / spectrum
        free = np.ones(ratio.size, bool)
        free[:_LOBE] = False  # drift dominates there
        for line in model.lines:
            free &= np.abs(self.frequency_hz - line.frequency_hz) > max(_LOBE * self.spacing_hz, 1.5 * line.width_hz)
        candidates = []
        for scale in _SCALES:
            mean = np.convolve(ratio, np.ones(scale) / scale, "same")
            gain = scale * self.segments / _HANN * (mean - 1 - np.log(mean)) * (mean > 1) * free
            place = int(np.argmax(gain))
            candidates.append((float(gain[place]), place, scale))
        largest = max(gain for gain, _, _ in candidates)
        if largest < _PENALTY * np.log(ratio.size):
            return None
        # Take the narrowest line with a fair share of the gain: a wide one could be two separate lines.
        place, scale = next((place, scale) for gain, place, scale in candidates if gain >= _NARROW_SHARE * largest)
        if scale == _SCALES[0]:  # of the three frequencies, take the one with the highest power
            place += int(np.argmax(self.power[place - 1 : place + 2])) - 1
        reach = max(_UNAVERAGED, 3 * scale)
        near = slice(max(place - reach, 0), place + reach + 1)
        return self._fit_line(near, place, scale, spectrum[near])

    def _fit_line(self, near: slice, place: int, scale: int, background: Array) -> Line:
        """Fit a line around the frequency of index `place`, above the `background` at the frequencies `near`."""
        omega, power, step = self.omega[near], self.power[near], 2 * np.pi / self.rate_hz
        excess = self.power[max(place - scale, 0) : place + scale + 1].sum() / self.power.size

        def line_of(parameters: Array) -> Line:
            width = min(max(float(np.exp(parameters[1])), 1e-3), 1e3) * self.spacing_hz
            offset = min(max(float(parameters[0]), -scale / 3), scale / 3) * self.spacing_hz
            centre = max(float(self.omega[place]) / step + offset, _LOBE * self.spacing_hz)
            return Line(centre, width, float(np.exp(parameters[2])))

        def cost(parameters: Array) -> float:
            return self.misfit(power, background + _line(omega, *_per_frame(line_of(parameters), self.rate_hz)), 1.0)

        start = np.array([0.0, np.log(0.3 * scale), np.log(excess)])
        return line_of(minimize(cost, start, method="Nelder-Mead", options={"maxiter": 400, "xatol": 1e-3}).x)

    def needed(self, model: Model) -> tuple[Line, ...]:
        """The lines that raise the likelihood significantly; an early line may have stood for several found later."""
        for line in sorted(model.lines, key=lambda line: line.variance_nm2):
            fewer = replace(model, lines=tuple(other for other in model.lines if other is not line))
            if self.cost(fewer) < self.cost(model):
                model = fewer
        return model.lines

    def fit_all(self, model: Model) -> Model:
        """Fit all parameters together, starting from nearly right lines."""
        model = self.fit_floor(model, robust=False)  # the fit of all parameters searches only near its start
        omega, power, counts = self.grouped(model.lines, robust=False)
        spacing, corner = self.spacing_hz, np.isfinite(model.cutoff_hz)
        highest_hz = self.rate_hz / 2 - spacing
        # Cached, since numerical derivatives change one parameter at a time.
        drift_of = lru_cache(1)(partial(_drift, omega))
        line_of = lru_cache(2 * _MAX_LINES)(lambda line: _line(omega, *_per_frame(line, self.rate_hz)))

        def model_of(parameters: Array) -> Model:
            floor, rest = parameters[: 2 + corner], parameters[2 + corner :].reshape(-1, 3)
            lines = tuple(
                Line(min(max(line.frequency_hz + shift * spacing, spacing), highest_hz), *np.exp(others).tolist())
                for line, (shift, *others) in zip(model.lines, rest.tolist(), strict=True)
            )
            drift_nm2, noise_nm2, *cutoff = (float(np.exp(value)) for value in floor)
            cutoff_hz = cutoff[0] if corner else np.inf
            return Model(drift_nm2, cutoff_hz, lines, noise_nm2, self.rate_hz, model.lowest_hz)

        def cost(parameters: Array) -> float:
            trial = model_of(parameters)
            drift = drift_of(trial.drift_nm2, trial.cutoff_hz / self.rate_hz)
            return self.misfit(power, sum(map(line_of, trial.lines), drift) + trial.noise_nm2, counts)

        floor = [np.log(model.drift_nm2), np.log(model.noise_nm2)] + ([np.log(model.cutoff_hz)] if corner else [])
        lines = [[0.0, np.log(line.width_hz), np.log(line.variance_nm2)] for line in model.lines]
        start = np.concatenate([floor, *lines])
        bounds = [(value - 3, value + 3) for value in start[: 2 + corner]]
        for line, (_, width, variance) in zip(model.lines, start[2 + corner :].reshape(-1, 3), strict=True):
            reach = max(1.0, line.width_hz / spacing)
            bounds += [(-reach, reach), (np.log(1e-3 * spacing), width + 2), (variance - 2, variance + 2)]
        found = minimize(cost, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60})
        fitted = model_of(found.x if found.fun < cost(start) else start)
        fitted = replace(fitted, lines=tuple(self._with_measured_power(line, fitted) for line in fitted.lines))
        return replace(fitted, drift_nm2=max(fitted.drift_nm2, _MIN_DRIFT * fitted.noise_nm2))

    def _with_measured_power(self, line: Line, model: Model) -> Line:
        """Set the variance of an unresolved line from the measured power: so far only its wings were fitted."""
        if line.width_hz > self.spacing_hz:
            return line
        near = np.abs(self.frequency_hz - line.frequency_hz) < 3 * self.spacing_hz
        others = replace(model, lines=tuple(other for other in model.lines if other is not line))
        floor = others.spectrum_nm2(self.omega[near]) + model.noise_nm2
        variance = float(np.sum(np.maximum(self.power[near] - floor, 0.0))) / self.omega.size
        if not variance > 0:
            return line
        return Line(line.frequency_hz, line.width_hz * line.variance_nm2 / variance, variance)


def _kept(cutoff: float) -> float:
    """Fraction of its value that a low-pass with this corner, in cycles per frame, keeps per frame."""
    return float(np.exp(-2 * np.pi * cutoff))


def _drift(omega: Array, step_nm2: float, cutoff: float) -> Array:
    walk = step_nm2 / (4 * np.sin(omega / 2) ** 2)
    if not np.isfinite(cutoff):
        return np.asarray(walk)
    kept = _kept(cutoff)
    return np.asarray(walk * (1 - kept) ** 2 / (1 - 2 * kept * np.cos(omega) + kept**2))


def _per_frame(line: Line, rate_hz: float) -> tuple[float, float, float]:
    """Frequency in rad per frame, amplitude kept per frame, variance."""
    return 2 * np.pi * line.frequency_hz / rate_hz, float(np.exp(-np.pi * line.width_hz / rate_hz)), line.variance_nm2


def _line(omega: Array, centre: float, decay: float, variance_nm2: float) -> Array:
    """Spectrum of a process whose covariance at lag k is variance_nm2 decay^k cos(centre k)."""
    lost = (1 - decay) ** 2  # |1 - decay e^(i x)|^2 = (1 - decay)^2 + 4 decay sin^2(x/2), without cancellation
    near, far = (lost + 4 * decay * np.sin((omega + sign * centre) / 2) ** 2 for sign in (-1, 1))
    return np.asarray(variance_nm2 * (1 - decay**2) / 2 * (1 / near + 1 / far))
