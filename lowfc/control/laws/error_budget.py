"""The error budget of a closed loop: residual wavefront from noise, delay, cross-talk and nonlinearity.

A frame measures error = residual + m, where m is noise, cross-talk and nonlinearity; the loop leaves
residual = S disturbance - T m, with S and T of `lowfc.control.laws.margins`.
All terms are variances of the true residual.
"""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array, Mask
from lowfc.control.calibration.calibration import noise_nm
from lowfc.control.laws.continuous import Timing, mean_over, residual_power
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.margins import noise_gain, noise_transfer, rejection
from lowfc.control.laws.spectra import Spectrum, TimeSeries, floor_nm2_hz, spectrum

ROWS_PER_REGRESSOR = 10
"""Least number of frames for each regressor; with fewer, a fit mostly explains noise."""
DETECTED_SIGMAS = 2.0
"""Standard errors above which a difference of two variances counts as detected."""

_DEGENERATE = 1e-7  # regressors: singular values below this fraction of the largest are dropped


@dataclass(frozen=True, slots=True)
class Term:
    """One term: variance of the true residual (modes,), and its standard error if it is a difference of variances."""

    variance_nm2: Array
    error_nm2: Array | float = 0.0

    def total(self, modes: Mask) -> tuple[float, bool]:
        """Rms in nm over the modes selected by a mask (modes,), and whether it was detected; if not, an upper limit."""
        variance = float(self.variance_nm2[modes].sum())
        error = float(np.sqrt((np.broadcast_to(self.error_nm2, self.variance_nm2.shape)[modes] ** 2).sum()))
        if error == 0 or variance > DETECTED_SIGMAS * error:
            return float(np.sqrt(max(variance, 0.0))), True
        return float(np.sqrt(max(variance, 0.0) + DETECTED_SIGMAS * error)), False


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Noise of the modes from one frame: standard deviations (modes,), nm, by photon noise and by read noise."""

    photon_nm: Array
    read_nm: Array

    @property
    def total_nm(self) -> Array:
        """Standard deviation (modes,) from both."""
        return np.hypot(self.photon_nm, self.read_nm)


def sensor_noise(
    matrix: Array, reference: Array, flux_e: float, read_noise_e: float, excess: float = 1.0
) -> SensorNoise:
    """Noise of one frame after R (modes, pixels), split into photon noise and read noise.

    Args:
        matrix: (modes, pixels) R, nm per flux fraction.
        reference: (pixels,) I0, flux fractions.
        flux_e: electrons on the good pixels, before multiplication.
        read_noise_e: noise of a pixel other than photon noise, as electrons before multiplication.
        excess: factor by which a multiplication register raises the photon variance: 2, or 1 without one.
    """
    photon = noise_nm(matrix, reference, flux_e, 0.0)
    both = noise_nm(matrix, reference, flux_e, read_noise_e)
    return SensorNoise(np.sqrt(excess) * photon, np.sqrt(np.maximum(both**2 - photon**2, 0.0)))


def white_noise(law: LinearLaw, noise_nm: Array, timing: Timing) -> Term:
    """Residual from white measurement noise (modes,); as in `lag`, a mean over all time or over starts of exposures."""
    return Term(noise_nm**2 * noise_gain(law, continuous=timing.held > 0))


def lag(law: LinearLaw, disturbance: Spectrum, mean_nm: Array, timing: Timing) -> Term:
    """Residual of a disturbance, from the spectrum and the mean (modes,) of its values at the starts of exposures.

    The residual is a mean over all time, or over the starts of exposures if `timing.held` is 0.
    """
    return Term(disturbance.variance_nm2(_passed(law, disturbance, timing)) + _steady_nm2(law, mean_nm))


def lag_under_noise(law: LinearLaw, measured: Spectrum, mean_nm: Array, timing: Timing) -> Term:
    """The residual of `lag`, computed from the spectrum and the mean (modes,) of measurements.

    A measurement is the mean of the disturbance over an exposure, plus white noise. The noise, the floor of the
    spectrum, is subtracted.
    """
    exposed = np.abs(mean_over(_omega(law, measured), timing.exposure)) ** 2
    passed = _passed(law, measured, timing) / exposed[:, None]
    floor = floor_nm2_hz(measured)
    above = measured.variance_nm2(passed) - floor * passed.sum(axis=0) * measured.spacing_hz
    return Term(above + _steady_nm2(law, mean_nm), measured.error_nm2(passed))


def _omega(law: LinearLaw, power: Spectrum) -> Array:
    return np.asarray(2 * np.pi * power.frequency_hz / law.rate_hz)


def _passed(law: LinearLaw, power: Spectrum, timing: Timing) -> Array:
    """Residual power (frequencies, modes) of a disturbance of power 1 at each frequency of a spectrum."""
    return residual_power(law, _omega(law, power), timing)


def _steady_nm2(law: LinearLaw, mean_nm: Array) -> Array:
    return np.asarray((mean_nm * rejection(law, np.zeros(1))[0]) ** 2)


@dataclass(frozen=True, slots=True)
class MeasurementError:
    """Residual from errors of the sensor other than noise."""

    crosstalk: Term
    nonlinearity: Term


def measurement_error(
    law: LinearLaw, error: TimeSeries, residual: TimeSeries, seen: TimeSeries, noise_nm: Array
) -> MeasurementError | None:
    """Split m = error - residual by a fit, and pass each part through the loop.

    The part of m that follows linearly from a constant, the true residual and the command is cross-talk: a response
    other than the calibration's, or light from outside the modes (a static screen, mirror print-through). The rest,
    less the noise (modes,) expected in a frame, is nonlinearity. A frame's noise is independent of the residual and the
    command in it, so it does not bias the fit; the noise that the fit explains by chance is subtracted.

    Args:
        law: the loop's law, with the true delay.
        error: modal error of each frame.
        residual: true residual of the same frames.
        seen: modal command seen in each of these frames.
        noise_nm: standard deviation of the noise of one frame's modes.

    Returns:
        None if there are too few frames for the fit or a spectrum.
    """
    rows = error.frames
    if rows < ROWS_PER_REGRESSOR * (1 + 2 * len(law.noll)):
        return None
    regressors = np.hstack([np.ones((rows, 1)), residual.joined(), seen.joined()])
    basis, sizes, _ = np.linalg.svd(regressors / np.maximum(np.linalg.norm(regressors, axis=0), 1e-30), False)
    basis = basis[:, sizes > _DEGENERATE * sizes[0]]
    added = error.joined() - residual.joined()
    linear = basis @ (basis.T @ added)
    nonlinear = added - linear

    def spectrum_of(column: Array) -> Spectrum | None:
        ends = np.cumsum([len(piece) for piece in error.values])[:-1]
        return spectrum(TimeSeries(tuple(np.split(column, ends)), error.interpolated), law.rate_hz)

    linear_psd, nonlinear_psd, basis_psd = spectrum_of(linear), spectrum_of(nonlinear), spectrum_of(basis)
    if linear_psd is None or nonlinear_psd is None or basis_psd is None:
        return None
    passed, at_0_hz = noise_transfer(law, nonlinear_psd.frequency_hz) ** 2, noise_transfer(law, np.zeros(1))[0] ** 2
    steady = linear.mean(axis=0) ** 2 * at_0_hz
    freedom = rows - basis.shape[1]
    # Residual from one unit of noise in each direction of the basis, (modes, directions).
    by_chance = passed.T @ basis_psd.power_nm2_hz * basis_psd.spacing_hz + np.outer(at_0_hz, basis.mean(axis=0) ** 2)
    noise_nm2 = np.sum(nonlinear**2, axis=0) / freedom
    nonlinear_nm2 = nonlinear_psd.variance_nm2(passed) * rows / freedom - noise_nm**2 * noise_gain(law)
    return MeasurementError(
        Term(
            linear_psd.variance_nm2(passed) + steady - noise_nm2 * by_chance.sum(axis=1),
            noise_nm2 * np.sqrt(2 * np.sum(by_chance**2, axis=1)),
        ),
        Term(nonlinear_nm2, nonlinear_psd.error_nm2(passed)),
    )
