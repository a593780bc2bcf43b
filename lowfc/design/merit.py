"""Predicted performance of a sensor: the figures that a search can minimise.

A `Candidate` says what it sees, as I0 and H of eqs. (6) and (12); from these follow what Tables 3 and 4 would show, and
what the noise of an exposure adds to the contrast of the dark zone.
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
from lowfc.optics.chain.zernike import NOLLS_14
from lowfc.optics.detector.photometry import electrons, tilt_nm_per_mas

WAVELENGTH_NM = 550.0
HELD = len(NOLLS_14)
"""Modes that a loop holds: those of the noise, of its contrast and of the share of the quantum limit."""


@dataclass(frozen=True)
class Signal:
    """An image and what the modes change of it, in one band.

    Attributes:
        I0: (samples,) flat wavefront's image, fraction of the open circle's light per pixel.
        H: (samples, modes) its derivative per nm rms of each mode.
        pixels_per_sample: How many pixels each value stands for.
        peak: The largest value of a pixel.
    """

    I0: Array
    H: Array
    pixels_per_sample: float
    peak: float


@dataclass(frozen=True, eq=False)
class PupilForms:
    """Quadratic forms of the modes that depend on the coronagraph's pupil alone.

    Attributes:
        gram: (20, 20) mean products of the modes, less their mean, over the open part.
        contrast: (14, 14) contrast that a wavefront adds to the dark zone, per nm^2, without negative directions.
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
            without_negative(contrast_form(pupil, NOLLS_14, WAVELENGTH_NM)),
            quantum_information(pupil, modes[:HELD], WAVELENGTH_NM),
        )


class Candidate(Protocol):
    """A sensor that is judged."""

    @property
    def forms(self) -> PupilForms:
        """Of its coronagraph's pupil."""

    @property
    def paper_rows(self) -> tuple[str, ...]:
        """The paper's rows of Table 3 that it is compared with, as in `lowfc.design.paper.TABLE3_WAVES`."""

    @property
    def paper_tilt(self) -> str:
        """The paper's row of Table 4."""

    def central(self, row: str) -> Signal:
        """What it sees at the central wavelength in a row of Table 3, 20 modes."""

    def in_band(self) -> Signal:
        """What it sees of the band of Table 4, tip and tilt at least."""

    def nonlinearity_waves(self, modes: int) -> float:
        """What Table 3 would show of the plain pseudo-inverse without noise."""


def covariance_nm2(seen: Signal, electrons_e: float, read_noise_e: float, modes: int, estimator: str) -> Array:
    """Covariance (modes, modes) of the first modes when these alone are fitted to one frame, photon and read noise.

    Args:
        seen: What the sensor sees.
        electrons_e: Light that enters the open circle during the exposure.
        read_noise_e: Of each pixel.
        modes: How many are fitted.
        estimator: "pinv", or "weighted", which attains the Cramer-Rao bound.

    Raises:
        ValueError: The estimator is not known.
    """
    H = seen.H[:, :modes] * electrons_e
    variance_e2 = (np.maximum(seen.I0, 0.0) * electrons_e + read_noise_e**2)[:, None]
    if estimator == "weighted":
        weighted = np.divide(H, variance_e2, out=np.zeros_like(H), where=variance_e2 > 0)
        return np.asarray(np.linalg.inv(H.T @ weighted) / seen.pixels_per_sample)
    if estimator != "pinv":
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
    inverse = np.linalg.inv(H.T @ H)
    return np.asarray(inverse @ (H.T @ (variance_e2 * H)) @ inverse / seen.pixels_per_sample)


def table3_noise_waves(forms: PupilForms, seen: Signal, modes: int, estimator: str) -> float:
    """Residual rms over the open pupil that noise alone leaves in Table 3, in waves."""
    covariance = covariance_nm2(seen, PEAK_E / seen.peak, TABLE3_READ_NOISE_E, modes, estimator)
    return expected_rms(forms.gram[:modes, :modes], covariance) / WAVELENGTH_NM


def table3_waves(candidate: Candidate, row: str, modes: int, estimator: str) -> float:
    """Residual rms over the open pupil that Table 3 would show, noise and second order, in waves."""
    noise = table3_noise_waves(candidate.forms, candidate.central(row), modes, estimator)
    return float(np.hypot(noise, candidate.nonlinearity_waves(modes)))


def table4_mas(seen: Signal, modes: int, estimator: str) -> tuple[float, float]:
    """Standard deviations of the tilts in x and y that Table 4 would show with our own photometry, in mas."""
    x, y = np.sqrt(np.diag(exposure_nm2(seen, modes, estimator))[:2]) / tilt_nm_per_mas(STAR.diameter_m)
    return float(x), float(y)


def exposure_nm2(seen: Signal, modes: int, estimator: str) -> Array:
    """Covariance (modes, modes) in one exposure of Table 4's star, our own photometry, 1 e- read noise."""
    light_e = electrons(STAR, TABLE4_EXPOSURE_S)
    return covariance_nm2(seen, light_e, TABLE4_READ_NOISE_E, modes, estimator)


def contrast_noise(forms: PupilForms, seen: Signal, estimator: str) -> float:
    """Contrast that the noise of 14 modes in one exposure of Table 4's star adds to the dark zone."""
    return float(np.sum(forms.contrast * exposure_nm2(seen, HELD, estimator)))


def quantum_share(forms: PupilForms, seen: Signal) -> float:
    """Share of the quantum limit that photons on these pixels use: median over 14 modes, without read noise."""
    bound_nm2 = np.linalg.inv(forms.quantum)
    return float(np.median(np.diag(bound_nm2) / np.diag(covariance_nm2(seen, 1.0, 0.0, HELD, "weighted"))))


def condition(seen: Signal, modes: int) -> float:
    """Largest over smallest singular value of H."""
    return condition_number(seen.H[:, :modes])


def throughput(seen: Signal) -> float:
    """Fraction of the open circle's light that falls on the pixels."""
    return float(seen.I0.sum()) * seen.pixels_per_sample
