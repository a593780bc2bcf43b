"""The camera: photo-electrons to digital numbers, with the noise of a CCD, CMOS or electron-multiplying CCD."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
    """

    gain_e_per_dn: float = 1.0
    read_noise_e: float = 1.0
    bias_dn: float = 100.0
    full_well_e: float = 60_000.0
    bit_depth: int = 16
    em_gain: float = 1.0
    clock_induced_charge_e: float = 0.0

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


def expose(
    detector: Detector,
    electrons: NDArray[np.floating],
    rng: np.random.Generator,
    normal: NDArray[np.float32] | None = None,
) -> NDArray[np.uint16]:
    """One frame (rows, columns) in DN.

    Electrons are drawn from the exact Poisson law. Multiplication draws from the gamma law of a long register, whose
    excess noise doubles the variance of the photons.

    Args:
        detector: The camera.
        electrons: (rows, columns) mean photo-electrons in the exposure; rounding below zero counts as none.
        rng: Source of all randomness.
        normal: (rows, columns) of the standard normal law for the read noise, drawn before a loop has no time for it;
            overwritten. Drawn here when None.

    Raises:
        ValueError: An expected number of electrons is not a finite number.
    """
    mean = np.maximum(electrons, 0.0)
    if detector.clock_induced_charge_e:
        mean = mean + detector.clock_induced_charge_e
    charge = rng.poisson(mean)
    values = rng.standard_normal(charge.shape, dtype=np.float32) if normal is None else normal
    values *= np.float32(detector.read_noise_e)
    if detector.em_gain > 1.0:
        charge = rng.standard_gamma(charge.astype(np.float32), dtype=np.float32)
        charge *= np.float32(detector.em_gain)
    if charge.max() > detector.full_well_e:
        charge = np.minimum(charge, np.float32(detector.full_well_e))
    np.add(values, charge, out=values, casting="same_kind")
    if detector.gain_e_per_dn != 1.0:
        values *= np.float32(1.0 / detector.gain_e_per_dn)
    values += np.float32(detector.bias_dn)
    np.rint(values, out=values)
    np.clip(values, np.float32(0.0), np.float32(saturation_dn(detector)), out=values)
    return values.astype(np.uint16)
