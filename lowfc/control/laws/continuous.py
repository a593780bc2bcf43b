"""Residual wavefront of a loop in continuous time, not only at one instant of each frame.

The star moves while the mirror holds. A wave e^(i w t) is measured as m e^(i w t_k), its mean over the exposure that
starts at t_k. The command computed from it is in force from a to a + 1 periods after t_k; the mean of the wave in this
time is h e^(i w (t_k + a)). The command follows from the sampled loop; the residual has a floor, `1 - |h|^2`, that no
command can remove.

Frequencies are in rad per frame and may exceed pi, where the sampled loop sees the alias.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lowfc.arrays import Array, Complex, Integers
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.margins import sensitivity
from lowfc.control.laws.stability import delay_weights

_FILTER_POINTS = 4096  # points of the Fourier transform from a filter's response to its taps
_FILTER_OMEGA = np.linspace(0, np.pi, _FILTER_POINTS // 2 + 1)
_FILTER_REACH = 48
"""Frames on either side from which a mean between measurements is interpolated."""

_INSTANTS = 8  # instants of a frame period at which a mean square is sampled


class Timing(NamedTuple):
    """When a loop exposes and moves its mirror, in frame periods.

    Attributes:
        delay: in frames; a command computed from frame n first acts on the whole exposure of frame n + delay.
        applied: time from the start of an exposure until the command computed from it is in force.
        exposure: length of an exposure; 0 for an instant.
        held: time over which the residual counts, from `applied` on: a period, or 0 for that instant alone.
    """

    delay: float
    applied: float
    exposure: float
    held: float = 1.0

    @classmethod
    def of(cls, delay: float, exposure: float) -> "Timing":
        """Timing in which a command is in force from the start of the first exposure that sees it alone.

        With a fractional delay, the mirror moves in the exposure before, when the fraction of the delay is over.
        """
        whole = delay // 1
        return cls(delay, whole + (delay - whole) * exposure, exposure)

    @classmethod
    def measured(cls, delay: float, exposure: float, waited: float) -> "Timing":
        """Timing in which a command is in force `waited` periods after the end of its frame's exposure.

        The whole periods follow from `delay`, the fraction of a period from `exposure + waited`. The result is that of
        `of` if the delay is fractional, or if the command is in force by the end of the exposure or only after the
        delay.
        """
        after = exposure + waited
        if delay != round(delay) or not exposure < after <= delay:
            return cls.of(delay, exposure)
        return cls(delay, delay + after - np.ceil(after), exposure)

    @classmethod
    def sampled(cls, delay: float) -> "Timing":
        """Timing in which only one instant of each frame counts; the residual between them is not included."""
        return cls(delay, delay, 0.0, 0.0)


def mean_over(omega: Array, length: float) -> Complex:
    """Mean (frequencies,) of e^(i w u) over u in [0, length]; w in rad per frame."""
    turned = 1j * np.asarray(omega, float) * length
    small = np.abs(turned) < 1e-9
    return np.where(small, 1 + turned / 2, np.expm1(turned) / np.where(small, 1, turned))


def hold_floor(omega: Array, held: float = 1.0) -> Array:
    """Residual power (frequencies,) of a wave of power 1, omega in rad per frame, under the best held command."""
    return np.asarray(1 - np.abs(mean_over(omega, held)) ** 2)


def residual_power(law: LinearLaw, omega: Array, timing: Timing) -> Array:
    """Mean residual power over time (frequencies, modes) of a wave of power 1 and frequency `omega`, rad per frame."""
    return _residual(sensitivity(law, omega, timing.delay), omega, timing)


def _residual(S: Complex, omega: Array, timing: Timing) -> Array:
    if not timing.held:  # only at the starts of exposures, where S holds
        return np.asarray(np.abs(S) ** 2)
    command = _commanded(S, omega, timing.delay) * mean_over(omega, timing.exposure)[:, None]
    return np.asarray(
        hold_floor(omega, timing.held)[:, None] + np.abs(_mean_while_applied(omega, timing)[:, None] + command) ** 2
    )


def _mean_while_applied(omega: Array, timing: Timing) -> Complex:
    """Mean (frequencies,) of a wave over the time for which a command counts, relative to the wave at t_k."""
    return np.asarray(mean_over(omega, timing.held) * np.exp(1j * timing.applied * omega))


def residual_spectrum(law: LinearLaw, omega: Array, measured: Array, noise_nm2: Array, timing: Timing) -> Array:
    """Spectrum (frequencies, modes) of the residual, from the spectrum of the measurements.

    Args:
        law: the loop's law.
        omega: (frequencies,) rad per frame, up to pi.
        measured: (frequencies, modes) spectrum of pseudo-open-loop modes with their noise.
        noise_nm2: (modes,) variance of one frame's white noise.
        timing: the loop's timing.
    """
    S = sensitivity(law, omega, timing.delay)
    disturbance_factor = _residual(S, omega, timing) / np.abs(mean_over(omega, timing.exposure))[:, None] ** 2
    noise_factor = np.abs(_commanded(S, omega, timing.delay)) ** 2
    return np.asarray((measured - noise_nm2) * disturbance_factor + noise_nm2 * noise_factor)


def commanded(law: LinearLaw, omega: Array, delay: float) -> Complex:
    """Command (frequencies, modes) for a measurement of e^(i w t_k), relative to it; omega in rad per frame."""
    return _commanded(sensitivity(law, omega, delay), omega, delay)


def _commanded(S: Complex, omega: Array, delay: float) -> Complex:
    seen = np.polynomial.polynomial.polyval(np.exp(-1j * omega), delay_weights(delay)) * np.exp(-1j * omega)
    return np.asarray((S - 1) / seen[:, None])


def means_while_applied(measured_nm: Array, timing: Timing) -> tuple[Array, Complex]:
    """Mean of each mode over the period in which a command is in force, from the measurements before and after.

    Args:
        measured_nm: (frames, modes), exposure by exposure.
        timing: the loop's timing.

    Returns:
        The means (frames, modes), NaN where there are too few neighbours; and the filter's response (frequencies,) at
        `_FILTER_OMEGA`, from which the noise of the means follows.
    """
    lags, taps, response = _filter(timing)
    means_nm = np.full(measured_nm.shape, np.nan)
    rows = np.arange(max(0, -lags[0]), len(measured_nm) - max(0, lags[-1]))
    if rows.size:
        for mean_nm, mode_nm in zip(means_nm.T, measured_nm.T, strict=True):
            mean_nm[rows] = np.correlate(mode_nm, taps, "valid")
    return means_nm, response


@lru_cache(maxsize=32)
def _filter(timing: Timing) -> tuple[Integers, Array, Complex]:
    """Filter of `means_while_applied`: its lags in frames ahead, its taps and its response."""
    response = _mean_while_applied(_FILTER_OMEGA, timing) / mean_over(_FILTER_OMEGA, timing.exposure)
    full = np.fft.irfft(response, _FILTER_POINTS)
    centre = round(timing.applied + (timing.held - timing.exposure) / 2)
    lags = np.arange(-_FILTER_REACH, _FILTER_REACH + 1) + centre
    taps = full[-lags % _FILTER_POINTS] * np.hanning(lags.size + 2)[1:-1]
    taps /= taps.sum()
    return lags, taps, np.asarray(np.exp(1j * np.outer(_FILTER_OMEGA, lags)) @ taps)


def held_residual_nm2(
    law: LinearLaw, measured_nm: Array, command_nm: Array, noise_nm2: Array, timing: Timing
) -> tuple[Array, int]:
    """Sum of squares (modes,) of the means of `means_while_applied` plus the commands, and the number of frames.

    The contribution of the measurements' noise (modes,) is subtracted.
    """
    ahead_nm, response = means_while_applied(measured_nm, timing)
    rows = np.isfinite(ahead_nm).all(axis=1)
    command = commanded(law, np.maximum(_FILTER_OMEGA, 1e-6), timing.delay)
    power_gain = np.abs(response)[:, None] ** 2 + 2 * np.real(response[:, None] * command.conj())
    by_noise_nm2 = noise_nm2 * np.trapezoid(power_gain, _FILTER_OMEGA, axis=0) / np.pi
    squares = np.sum((ahead_nm[rows] + command_nm[rows]) ** 2, axis=0)
    return squares - rows.sum() * by_noise_nm2, int(rows.sum())


def continuous_residual_nm2(
    disturbance_nm: Array, mirror_nm: Array, moves_at: float = 1.0, next_nm: Array | None = None
) -> Array:
    """Mean square residual over each period (frames, modes), from the states at the start of each exposure.

    The disturbance (frames, modes) is interpolated between those instants. The mirror (frames, modes) holds for
    `moves_at` periods and then moves to `next_nm`, by default its state in the next frame. NaN where there are too few
    neighbours.
    """
    mean_square = np.zeros_like(disturbance_nm)
    next_nm = np.roll(mirror_nm, -1, axis=0) if next_nm is None else next_nm
    for instant in ((np.arange(_INSTANTS) + 0.5) / _INSTANTS).tolist():
        between_nm, _ = means_while_applied(disturbance_nm, Timing(1.0, instant, 0.0, 0.0))
        mean_square += (between_nm + (mirror_nm if instant < moves_at else next_nm)) ** 2 / _INSTANTS
    return mean_square
