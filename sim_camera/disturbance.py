"""The wavefront's disturbance: a pure function of the seed, the frame rate and the frame's number.

Every preset is a sum of some of these: sine waves with seeded phases (a spectral model of drift and jitter), damped
lines, a square wave, a static screen. The spectrum of waves, lines and wheels of constant speed is known exactly. A
damped line is a rotating vector whose length and phase wander (an Ornstein-Uhlenbeck process). It is drawn frame by
frame: a frame requires all frames before it.
"""

from dataclasses import dataclass, replace

import numpy as np

from lowfc.arrays import Array, Complex, Single
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.optics.chain.zernike import noll_to_orders
from sim_camera.wheel import ORDERS, Wheel, walk

BLOCK = 8
"""Frames computed at once: enough to be efficient, few enough not to delay a frame."""
LINE_WIDTH = 0.005
"""Width of a damped line between its half-power points, as a fraction of its frequency."""

# Lines of the reaction wheel and their rms per axis, mas. The rms falls with frequency, as a telescope's structure
# damps fast vibrations; with the drift the total is 14 mas.
LINES_HZ = (6.0, 18.0, 37.0, 71.0, 117.0)
LINES_MAS = (9.0, 8.3, 5.0, 3.0, 2.0)
_DRIFT_MAS = 3.0
_JITTER_HZ = (0.7, 1.9, 4.3, 9.1)
_JITTER_MAS = 1.5  # rms per axis of the four lines together: half of it for each
_STEP_MAS = 5.0
_STEP_PERIOD_S = 4.0
_SCREEN_WAVES = 0.05  # rms over the open pupil
_THERMAL_NM = {1: 4.0, 2: 5.0, 3: 2.5, 4: 1.5}  # rms, by radial degree
_THERMAL_HZ = (0.003, 0.5)
_DRIFT_HZ = (0.02, 5.0)
_WAVES_PER_BAND = 24
_FRAMES_AT_ONCE = 1 << 14  # largest number of frames for which damped lines are drawn at once


@dataclass(frozen=True, eq=False)
class DampedLine:
    """A vibration: frequency, width between half-power points, and rms of each mode (modes,), nm of wavefront."""

    frequency_hz: float
    width_hz: float
    rms_nm: Array


@dataclass(frozen=True, eq=False)
class Disturbance:
    """A disturbance of the modes and a static screen.

    Attributes:
        noll: Noll index of each mode.
        frequency_hz: (waves,) frequency of each sine wave.
        amplitude_nm: (waves, modes) complex: amplitude and phase, nm of wavefront rms.
        step_nm: (modes,) amplitude of a square wave, half of its height.
        static_nm: (modes,) constant wavefront.
        screen_nm: rms of a static Kolmogorov screen, 0 for none.
        lines: damped lines.
        seed: seed of the damped lines, and of the drift, jitter and shear that `with_sources` adds.
        wheels: reaction wheels, whose speeds may change.
        shear: shear of the beam on the sensor's masks as sine waves: frequencies (waves,), Hz, and complex amplitudes
            (waves, 2) along x and y, pupil diameters.
    """

    noll: tuple[int, ...]
    frequency_hz: Array
    amplitude_nm: Complex
    step_nm: Array
    static_nm: Array
    screen_nm: float
    lines: tuple[DampedLine, ...] = ()
    seed: int = 0
    wheels: tuple[Wheel, ...] = ()
    shear: tuple[Array, Complex] | None = None


def preset_disturbance(
    preset: str,
    noll: tuple[int, ...],
    seed: int,
    nm_per_mas: float,
    wavelength_nm: float,
    scale: float = 1.0,
    static_nm: dict[int, float] | None = None,
    line_width: float = LINE_WIDTH,
) -> Disturbance:
    """The disturbance of a preset for these modes.

    Args:
        preset: name of the preset.
        noll: Noll index of each mode.
        seed: seed of all phases and of the damped lines.
        nm_per_mas: wavefront rms of a milliarcsecond of tilt.
        wavelength_nm: central wavelength.
        scale: factor on the amplitudes of the preset.
        static_nm: constant wavefront, nm rms, by Noll index.
        line_width: width of the reaction wheel's lines between half-power points, as a fraction of their frequency; 0
            for undamped lines.

    Raises:
        ValueError: unknown preset.
    """
    modes = len(noll)
    static = np.array([(static_nm or {}).get(index, 0.0) for index in noll])
    rng = np.random.default_rng([seed, 1])
    tilt = np.array([index in TIP_TILT for index in noll])
    tilt_nm = scale * nm_per_mas * tilt
    step, screen = np.zeros(modes), 0.0
    lines: tuple[DampedLine, ...] = ()
    waves: list[tuple[Array, Complex]] = []
    match preset:
        case "quiet":
            pass
        case "thermal":
            waves = [_drift(rng, scale * _thermal_nm(noll), _THERMAL_HZ)]
        case "bench":
            waves = [
                _drift(rng, scale * _thermal_nm(noll), _THERMAL_HZ),
                _undamped_lines(rng, np.full(len(_JITTER_HZ), _JITTER_MAS / 2), _JITTER_HZ, tilt_nm),
            ]
        case "reaction-wheel" | "reaction-wheel-ideal":
            waves = [
                _drift(rng, scale * _thermal_nm(noll) * ~tilt, _THERMAL_HZ),
                _drift(rng, _DRIFT_MAS * tilt_nm, _DRIFT_HZ),
            ]
            if preset == "reaction-wheel" and line_width:
                lines = tuple(
                    DampedLine(hz, line_width * hz, rms_mas * tilt_nm)
                    for rms_mas, hz in zip(LINES_MAS, LINES_HZ, strict=True)
                )
            else:
                waves.append(_undamped_lines(rng, np.array(LINES_MAS), LINES_HZ, tilt_nm))
        case "step":
            step = _STEP_MAS * tilt_nm
        case "kolmogorov":
            screen = scale * _SCREEN_WAVES * wavelength_nm
        case _:
            raise ValueError(f"unknown disturbance {preset!r}")
    frequencies = np.concatenate([np.zeros(0), *(frequency for frequency, _ in waves)])
    amplitudes = np.concatenate([np.zeros((0, modes), complex), *(amplitude for _, amplitude in waves)])
    return Disturbance(noll, frequencies, amplitudes, step, static, screen, lines, seed)


def with_sources(
    disturbance: Disturbance,
    rate_hz: float,
    drift_nm: dict[int, float],
    drift_slope: float,
    jitter_nm: float,
    shear: float,
) -> Disturbance:
    """The disturbance with drift, jitter and shear added, each drawn from its own random stream.

    Args:
        disturbance: the disturbance without drift, jitter and shear.
        rate_hz: frame rate.
        drift_nm: strength of the drift, nm per root second by Noll index.
        drift_slope: the drift's power per hertz falls as 1 / f^drift_slope; with 2 it is a random walk.
        jitter_nm: rms of the jitter of tip and of tilt, white from 0.5 to 1.5 times the frame rate.
        shear: rms of the beam's slow wander on the sensor's masks along each axis, pupil diameters.
    """
    waves = [(disturbance.frequency_hz, disturbance.amplitude_nm)]
    if drift_nm:
        per_root_s = np.array([drift_nm.get(index, 0.0) for index in disturbance.noll])
        waves.append(walk(np.random.default_rng([disturbance.seed, 8]), per_root_s, drift_slope))
    if jitter_nm:
        rng = np.random.default_rng([disturbance.seed, 9])
        frequency_hz = rate_hz * (0.5 + (np.arange(_WAVES_PER_BAND) + rng.random(_WAVES_PER_BAND)) / _WAVES_PER_BAND)
        tilt_nm = jitter_nm * np.isin(disturbance.noll, TIP_TILT) * np.sqrt(2 / _WAVES_PER_BAND)
        waves.append((frequency_hz, tilt_nm * _phases(rng, (_WAVES_PER_BAND, len(disturbance.noll)))))
    wander = _drift(np.random.default_rng([disturbance.seed, 10]), np.full(2, shear), _DRIFT_HZ) if shear else None
    frequencies, amplitudes = zip(*waves, strict=True)
    return replace(
        disturbance, frequency_hz=np.concatenate(frequencies), amplitude_nm=np.concatenate(amplitudes), shear=wander
    )


def shear_at(disturbance: Disturbance, time_s: float) -> Array:
    """Shear of the beam (2,) along x and y, pupil diameters; empty without shear."""
    if disturbance.shear is None:
        return np.zeros(0)
    frequency_hz, amplitude = disturbance.shear
    return np.asarray((np.exp(2j * np.pi * frequency_hz * time_s) @ amplitude).real)


def speeds_hz(disturbance: Disturbance, time_s: float) -> Array:
    """Speed of each wheel, revolutions per second."""
    return np.array([wheel.speed_hz(np.array([time_s]))[0] for wheel in disturbance.wheels])


def highest_hz(disturbance: Disturbance) -> float:
    """Highest frequency of the waves, of the damped lines and of the wheels' harmonics at time 0, Hz."""
    lines = [line.frequency_hz for line in disturbance.lines]
    harmonics = [max(ORDERS) * abs(wheel.start_hz) for wheel in disturbance.wheels]
    return float(max([0.0, *disturbance.frequency_hz, *lines, *harmonics]))


def variances_nm2(disturbance: Disturbance, per_line: int = 401) -> tuple[Array, Array]:
    """Frequencies (n,), Hz, of waves, damped lines and wheels, and the variance of each mode at them (n, modes), nm^2.

    A damped line is represented by `per_line` quantiles of its power, a wheel by its harmonics at time 0.
    """
    frequency_hz, variance_nm2 = [disturbance.frequency_hz], [np.abs(disturbance.amplitude_nm) ** 2 / 2]
    quantiles = (np.arange(per_line) + 0.5) / per_line
    for line in disturbance.lines:
        frequency_hz.append(np.abs(line.frequency_hz + line.width_hz / 2 * np.tan(np.pi * (quantiles - 0.5))))
        variance_nm2.append(np.tile(line.rms_nm**2 / per_line, (per_line, 1)))
    for wheel in disturbance.wheels:
        wheel_hz, wheel_nm2 = wheel.lines()
        frequency_hz.append(wheel_hz)
        variance_nm2.append(wheel_nm2)
    return np.concatenate(frequency_hz), np.concatenate(variance_nm2)


class _DampedLines:
    """Damped lines at the starts of exposures as rotating complex vectors, drawn in the order of the frames.

    Attributes:
        modes: (moved,) indices of the modes that the lines move.
    """

    def __init__(self, disturbance: Disturbance, rate_hz: float) -> None:
        self._seed = disturbance.seed
        rms_nm = np.array([line.rms_nm for line in disturbance.lines])
        self.modes = np.flatnonzero(rms_nm.any(axis=0))
        self._rms_nm = rms_nm[:, self.modes]
        omega = 2 * np.pi * np.array([line.frequency_hz for line in disturbance.lines]) / rate_hz
        damping = np.pi * np.array([line.width_hz for line in disturbance.lines]) / rate_hz
        self._step = np.exp(1j * omega - damping)
        self._restart()

    def _restart(self) -> None:
        self._rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([self._seed, 4])))
        self._next, self._vector = 0, self._draw(1)[0]

    def _draw(self, count: int) -> Complex:
        """Random vectors (count, lines, moved); real and imaginary parts each have the variance of the line."""
        parts = self._rng.standard_normal((count, *self._rms_nm.shape, 2))
        return np.asarray((parts[..., 0] + 1j * parts[..., 1]) * self._rms_nm)

    def at(self, first: int, count: int) -> Complex:
        """Vectors (count + 1, lines, moved) at frames `first` to `first + count`."""
        if first < self._next:
            self._restart()
        while self._next < first:
            self._advance(min(first - self._next, _FRAMES_AT_ONCE))
        return np.asarray(np.concatenate([self._advance(count), self._vector[None]]))

    def _advance(self, count: int) -> Complex:
        """Vectors (count, lines, moved) of the next `count` frames."""
        drawn = self._draw(count) * np.sqrt(1 - np.abs(self._step) ** 2)[:, None]
        vectors: Complex = np.empty_like(drawn)
        vector, step = self._vector, self._step[:, None]
        for row in range(count):
            vectors[row] = vector
            vector = step * vector + drawn[row]
        self._next, self._vector = self._next + count, vector
        return vectors


class Sampler:
    """The disturbance at the same instants of each period, in single precision, computed in blocks of frames."""

    def __init__(self, disturbance: Disturbance, instants: Array, rate_hz: float) -> None:
        """Prepare the waves; `instants` (instants,) are in periods after the start of an exposure."""
        self._disturbance = disturbance
        self._rate_hz = rate_hz
        self._time_s = ((np.arange(BLOCK)[:, None] + instants) / rate_hz).ravel()
        waves = np.exp(2j * np.pi * np.outer(self._time_s, disturbance.frequency_hz))
        self._waves = np.hstack([waves.real, -waves.imag]).astype(np.float32)
        self._lines = _DampedLines(disturbance, rate_hz) if disturbance.lines else None
        self._end_weights = _end_weights(disturbance.lines, instants / rate_hz, 1 / rate_hz)
        self._shape = (BLOCK, len(instants), len(disturbance.noll))
        self._blocks: dict[int, Single] = {}

    def at(self, index: int) -> Single:
        """Modes (instants, modes) in the period of a frame, nm of wavefront rms."""
        first = index - index % BLOCK  # fixed blocks, so that a frame does not depend on the order of the calls
        if first not in self._blocks:
            # Keep the two blocks before: a frame's truth is computed after the exposure of up to ten later frames.
            self._blocks = {before: block for before, block in self._blocks.items() if 0 < first - before <= 2 * BLOCK}
            self._blocks[first] = self._block(first)
        row: Single = self._blocks[first][index - first]
        return row

    def _block(self, first: int) -> Single:
        """Modes (frames, instants, modes) of the block that begins with frame `first`."""
        start_s, disturbance = first / self._rate_hz, self._disturbance
        turned = disturbance.amplitude_nm * np.exp(2j * np.pi * disturbance.frequency_hz * start_s)[:, None]
        total_nm = self._waves @ np.vstack([turned.real, turned.imag]).astype(np.float32)
        in_first_half = np.mod(start_s + self._time_s, _STEP_PERIOD_S) < _STEP_PERIOD_S / 2
        square = np.where(in_first_half, -1.0, 1.0)[:, None] * disturbance.step_nm
        total_nm += (square + disturbance.static_nm).astype(np.float32)
        for wheel in disturbance.wheels:
            total_nm += wheel.modes_nm(start_s + self._time_s).astype(np.float32)
        block = total_nm.reshape(self._shape)
        if self._lines is not None:
            vectors, (before, after) = self._lines.at(first, BLOCK), self._end_weights
            moved = np.einsum("il,flm->fim", before, vectors[:-1]) + np.einsum("il,flm->fim", after, vectors[1:])
            block[:, :, self._lines.modes] += moved.real
        return block


def _end_weights(lines: tuple[DampedLine, ...], time_s: Array, period_s: float) -> Complex:
    """Weights (2, instants, lines) of a line's vectors at both ends of a period.

    The weighted sum is the expected vector in between.
    """
    omega = 2j * np.pi * np.array([line.frequency_hz for line in lines])
    damping = np.pi * np.array([line.width_hz for line in lines])
    time_s = time_s[:, None]

    def sinh_ratio(span_s: Array) -> Array:
        """sinh(damping span_s) / sinh(damping period_s), without overflow."""
        ratio = np.expm1(-2 * damping * span_s) / np.expm1(-2 * damping * period_s)
        return np.asarray(ratio * np.exp(damping * (span_s - period_s)))

    before = sinh_ratio(period_s - time_s) * np.exp(omega * time_s)
    after = sinh_ratio(time_s) * np.exp(omega * (time_s - period_s))
    return np.array([before, after])


def screen(seed: int, samples: int, spacing: float) -> Array:
    """Kolmogorov screen (samples, samples) with power spectrum f^-11/3; `spacing` of the samples in pupil diameters.

    It has a period of four pupil diameters and an arbitrary amplitude. Its spectrum ends at 12 cycles per diameter, far
    beyond what the sensor's focal-plane mask passes, so that coarse nodes do not alias fine structure.
    """
    rng = np.random.default_rng([seed, 2])
    side, finest = 4.0, 12.0  # pupil diameters, cycles per diameter
    count = int(2 * finest * side)
    frequency = np.arange(-count // 2, count // 2 + 1) / side
    radius = np.hypot(frequency, frequency[:, None])
    amplitude = np.where((radius > 0) & (radius <= finest), np.maximum(radius, 1 / side) ** (-11 / 6), 0.0)
    spectrum = amplitude * (rng.standard_normal(radius.shape) + 1j * rng.standard_normal(radius.shape))
    position = (np.arange(samples) - (samples - 1) / 2) * spacing
    waves = np.exp(2j * np.pi * np.outer(position, frequency))
    return np.asarray((waves @ spectrum @ waves.T).real)


def _thermal_nm(noll: tuple[int, ...]) -> Array:
    """Rms (modes,) of the thermal drift of each mode, nm; it depends on the radial degree."""
    return np.array([_THERMAL_NM.get(noll_to_orders(index)[0], 1.0) for index in noll])


def _drift(rng: np.random.Generator, rms_nm: Array, band_hz: tuple[float, float]) -> tuple[Array, Complex]:
    """Sine waves nearly even in log(frequency), power per hertz as 1/f^2; their sum has rms `rms_nm` (modes,)."""
    frequencies = np.geomspace(*band_hz, _WAVES_PER_BAND) * rng.uniform(0.95, 1.05, _WAVES_PER_BAND)
    weights = frequencies**-0.5
    weights *= np.sqrt(2 / np.sum(weights**2))
    return frequencies, weights[:, None] * _phases(rng, (_WAVES_PER_BAND, len(rms_nm))) * rms_nm


def _undamped_lines(
    rng: np.random.Generator, rms: Array, frequencies_hz: tuple[float, ...], unit_nm: Array
) -> tuple[Array, Complex]:
    """Sine waves at fixed frequencies; `rms` (waves,) is that of each wave in units of `unit_nm` (modes,)."""
    amplitude = np.sqrt(2) * rms[:, None] * unit_nm
    return np.array(frequencies_hz), amplitude * _phases(rng, amplitude.shape)


def _phases(rng: np.random.Generator, shape: tuple[int, int]) -> Complex:
    return np.asarray(np.exp(2j * np.pi * rng.random(shape)))
