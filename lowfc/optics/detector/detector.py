"""The camera: photo-electrons to digital numbers, with the noise of a CCD, CMOS or electron-multiplying CCD."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lowfc.arrays import Pixels, Single
from lowfc.optics.detector.detector_noise_table import FAINT_E, PixelLaws, draw, pixel_laws


@dataclass(frozen=True)
class Detector:
    """A pixel detector with a 16-bit or shallower converter.

    Attributes:
        gain_e_per_dn: Electrons per digital number.
        read_noise_e: Rms of the output amplifier, in electrons; behind the multiplication register if there is one.
        bias_dn: Digital number of no electrons.
        full_well_e: Charge at which the output stops growing, behind the multiplication register if there is one.
        bit_depth: Of the converter, at most 16.
        em_gain: Mean gain of the multiplication register; 1 is a detector without one.
        clock_induced_charge_e: Mean spurious electrons per pixel and frame, ahead of the register.
        exact: Draw every pixel's electrons from the Poisson law itself; else faint ones come from a table of what
            they end as, in a third of the time: see `expose`.
    """

    gain_e_per_dn: float = 1.0
    read_noise_e: float = 1.0
    bias_dn: float = 100.0
    full_well_e: float = 60_000.0
    bit_depth: int = 16
    em_gain: float = 1.0
    clock_induced_charge_e: float = 0.0
    exact: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.bit_depth <= 16:
            raise ValueError(f"the bit depth must lie between 1 and 16, got {self.bit_depth}")
        if not (self.gain_e_per_dn > 0 and self.full_well_e > 0 and self.em_gain >= 1):
            raise ValueError(
                f"gain and full well must be positive and the EM gain at least 1, got {self.gain_e_per_dn} e-/DN, "
                f"{self.full_well_e} e- and {self.em_gain}"
            )
        if not (self.read_noise_e >= 0 and self.clock_induced_charge_e >= 0):
            raise ValueError(
                f"read noise and clock-induced charge cannot be negative, got {self.read_noise_e} and "
                f"{self.clock_induced_charge_e} e-"
            )
        if not 0 <= self.bias_dn < 2**self.bit_depth - 1:
            raise ValueError(f"the bias must lie within the {self.bit_depth}-bit range, got {self.bias_dn} DN")


def saturation_dn(detector: Detector) -> int:
    """The largest value a pixel can have: full well or the converter's range, whichever comes first."""
    full_well_dn = detector.bias_dn + detector.full_well_e / detector.gain_e_per_dn
    return int(min(np.rint(full_well_dn), 2**detector.bit_depth - 1))


def expose(detector: Detector, electrons: NDArray[np.floating], rng: np.random.Generator) -> Pixels:
    """One frame (rows, columns) in DN.

    Electrons are drawn from the Poisson law. Multiplication draws from the gamma law of a long register, whose
    excess noise doubles the variance of the photons.

    Unless the detector is `exact`, pixels below `FAINT_E` electrons are drawn from the law of their digital number. It
    is exact at multiples of 1/64 electron; between these the mean is exact and the variance too large by at most
    6e-5 electrons squared, which the chi-square test of a million draws does not see.

    Args:
        detector: The camera.
        electrons: (rows, columns) mean photo-electrons in the exposure; rounding below zero counts as none.
        rng: Source of all randomness, with words of 64 random bits, as all of numpy's but MT19937 have.

    Raises:
        ValueError: An expected number of electrons is not a finite number.
    """
    mean = np.asarray(electrons, np.float32).ravel()
    if detector.clock_induced_charge_e:
        mean = np.maximum(mean, np.float32(0)) + np.float32(detector.clock_induced_charge_e)
    brightest_e = float(mean.max(initial=0))
    if not brightest_e < np.inf:
        raise ValueError(f"the electrons expected in a pixel must be a finite number, got {brightest_e}")
    laws = laws_of(detector)
    if laws is None:
        return _expose_one_by_one(detector, mean, rng).reshape(electrons.shape)
    frame = draw(laws, mean, rng)
    if brightest_e >= FAINT_E:
        bright = np.flatnonzero(mean >= FAINT_E)
        frame[bright] = _expose_one_by_one(detector, mean[bright], rng)
    return frame.reshape(electrons.shape)


@lru_cache(maxsize=4)
def laws_of(detector: Detector) -> PixelLaws | None:
    """The table that `expose` draws from, made once; None where it draws every electron."""
    if detector.exact or detector.em_gain > 1.0:
        return None
    return pixel_laws(detector.gain_e_per_dn, detector.read_noise_e, detector.bias_dn, saturation_dn(detector))


def _expose_one_by_one(detector: Detector, mean_e: Single, rng: np.random.Generator) -> Pixels:
    """Pixels (pixels,) in DN: electrons, multiplication, read noise and rounding after each other."""
    charge = rng.poisson(np.maximum(mean_e, 0)).astype(np.float32)
    if detector.em_gain > 1.0:
        charge = rng.standard_gamma(charge, dtype=np.float32)
        charge *= np.float32(detector.em_gain)
    np.minimum(charge, np.float32(detector.full_well_e), out=charge)
    values = rng.standard_normal(charge.shape, dtype=np.float32)
    values *= np.float32(detector.read_noise_e)
    values += charge
    values *= np.float32(1.0 / detector.gain_e_per_dn)
    values += np.float32(detector.bias_dn)
    np.rint(values, out=values)
    np.clip(values, np.float32(0.0), np.float32(saturation_dn(detector)), out=values)
    return values.astype(np.uint16)
