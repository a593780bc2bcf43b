"""Predicted performance of a sensor: the values that a search can minimise.

A `Candidate` provides I0 and H, eqs. (8) and (12) of the paper, the latter with the factor 2 of eq. (9), and its
nonlinear error. These determine its values in the paper's Tables 3 and 4, and the contrast that the noise of an
exposure adds to the dark zone.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import ESTIMATORS, condition_number
from lowfc.design.fisher import quantum_information
from lowfc.design.paper import PEAK_E, STAR, TABLE3_READ_NOISE_E, TABLE4_EXPOSURE_S, TABLE4_READ_NOISE_E
from lowfc.design.trials import expected_rms, gram
from lowfc.optics.chain.added_contrast import contrast_form, without_negative
from lowfc.optics.chain.band import uniform
from lowfc.optics.chain.coronagraph import Coronagraph
from lowfc.optics.chain.zernike import NOLLS_14
from lowfc.optics.detector.photometry import electrons, tilt_nm_per_mas

WAVELENGTH_NM = 550.0  # central wavelength, Table 1 of the paper
BAND = uniform(WAVELENGTH_NM)
"""Passband of Table 4."""
CONTROLLED = len(NOLLS_14)
"""Number of controlled modes: their noise, added contrast and share of the quantum limit are predicted."""


@dataclass(frozen=True)
class Signal:
    """I0 and H of a sensor in one band, on its pixels or on a coarser grid that samples the image fully.

    Attributes:
        I0: (samples,) image of a flat wavefront, fraction of the open circle's light per pixel.
        H: (samples, modes) derivative of the image per nm rms of each mode.
        pixels_per_sample: Number of pixels that each sample represents.
        peak: Largest value of I0: on a pixel at one wavelength, on a sample in a band.
    """

    I0: Array
    H: Array
    pixels_per_sample: float
    peak: float


@dataclass(frozen=True, eq=False)
class PupilForms:
    """Quadratic forms of the modes that depend only on the coronagraph's pupil.

    Attributes:
        gram: (20, 20) covariance of the modes over the open part of the pupil.
        contrast: (14, 14) contrast that a wavefront adds to the dark zone, per nm^2, without negative eigenvalues.
        quantum: (14, 14) quantum Fisher information per nm^2, for one electron in the open circle's light.
    """

    gram: Array
    contrast: Array
    quantum: Array

    @classmethod
    def of(cls, pupil: Array, modes: Array) -> "PupilForms":
        """The forms of a pupil (n, n) and its 20 modes (20, n, n)."""
        return cls(
            gram(modes[:, pupil > 0.5]),
            without_negative(contrast_form(Coronagraph(pupil), NOLLS_14, WAVELENGTH_NM)),
            quantum_information(pupil, modes[:CONTROLLED], WAVELENGTH_NM),
        )


class Candidate(Protocol):
    """A sensor whose performance is predicted."""

    @property
    def forms(self) -> PupilForms:
        """Quadratic forms of the pupil of the sensor's coronagraph."""

    @property
    def paper_rows(self) -> tuple[str, ...]:
        """The paper's rows of Table 3 for comparison, keys of `lowfc.design.paper.TABLE3_WAVES`."""

    @property
    def paper_tilt(self) -> str:
        """The paper's row of Table 4 for comparison."""

    def central(self, row: str) -> Signal:
        """I0 and H of 20 modes at the central wavelength, for a row of Table 3."""

    @property
    def in_band(self) -> Signal:
        """I0 and H of tip, tilt and possibly more modes in the band of Table 4."""

    def nonlinearity_waves(self, modes: int) -> float:
        """Residual of Table 3 with the plain pseudo-inverse and without noise, waves."""


def covariance_nm2(signal: Signal, light_e: float, read_noise_e: float, modes: int, estimator: str) -> Array:
    """Noise covariance (modes, modes), nm^2, of a fit of the first `modes` modes alone to one frame.

    Args:
        signal: I0 and H of the sensor.
        light_e: Electrons of the light that enters the open circle during the exposure.
        read_noise_e: Read noise of each pixel, electrons.
        modes: Number of fitted modes.
        estimator: "pinv", or "weighted", which attains the Cramer-Rao bound.

    Raises:
        ValueError: The estimator is not known.
        numpy.linalg.LinAlgError: A mode has no signal.
    """
    H = signal.H[:, :modes] * light_e
    variance_e2 = (np.maximum(signal.I0, 0.0) * light_e + read_noise_e**2)[:, None]
    if estimator == "weighted":
        weighted = np.divide(H, variance_e2, out=np.zeros_like(H), where=variance_e2 > 0)
        return np.asarray(np.linalg.inv(H.T @ weighted) / signal.pixels_per_sample)
    if estimator != "pinv":
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
    inverse = np.linalg.inv(H.T @ H)
    return np.asarray(inverse @ (H.T @ (variance_e2 * H)) @ inverse / signal.pixels_per_sample)


def table3_noise_waves(forms: PupilForms, signal: Signal, modes: int, estimator: str) -> float:
    """Residual rms over the open pupil in Table 3 from noise alone, in waves."""
    covariance = covariance_nm2(signal, PEAK_E / signal.peak, TABLE3_READ_NOISE_E, modes, estimator)
    return expected_rms(forms.gram[:modes, :modes], covariance) / WAVELENGTH_NM


def table3_waves(candidate: Candidate, row: str, modes: int, estimator: str) -> float:
    """Residual rms over the open pupil in Table 3 from noise and second-order errors, in waves."""
    noise = table3_noise_waves(candidate.forms, candidate.central(row), modes, estimator)
    return float(np.hypot(noise, candidate.nonlinearity_waves(modes)))


def table4_mas(signal: Signal, modes: int, estimator: str) -> tuple[float, float]:
    """Standard deviations of the tilts in x and y in Table 4 with our own photometry, in mas."""
    x, y = np.sqrt(np.diag(exposure_nm2(signal, modes, estimator))[:2]) / tilt_nm_per_mas(STAR.diameter_m)
    return float(x), float(y)


def exposure_nm2(signal: Signal, modes: int, estimator: str) -> Array:
    """Noise covariance (modes, modes), nm^2, in an exposure of Table 4's star: own photometry, 1 e- of read noise."""
    light_e = electrons(STAR, TABLE4_EXPOSURE_S)
    return covariance_nm2(signal, light_e, TABLE4_READ_NOISE_E, modes, estimator)


def contrast_noise(forms: PupilForms, signal: Signal, estimator: str) -> float:
    """Contrast added to the dark zone by the noise of 14 modes in one exposure of Table 4's star."""
    return float(np.sum(forms.contrast * exposure_nm2(signal, CONTROLLED, estimator)))


def quantum_share(forms: PupilForms, signal: Signal) -> float:
    """Ratio of the quantum limit to the sensor's variance: median over 14 modes, without read noise."""
    bound_nm2 = np.linalg.inv(forms.quantum)
    return float(np.median(np.diag(bound_nm2) / np.diag(covariance_nm2(signal, 1.0, 0.0, CONTROLLED, "weighted"))))


def condition(signal: Signal, modes: int) -> float:
    """Condition number of H: largest over smallest singular value."""
    return condition_number(signal.H[:, :modes])


def throughput(signal: Signal) -> float:
    """Fraction of the open circle's light that falls on the pixels."""
    return float(signal.I0.sum()) * signal.pixels_per_sample
