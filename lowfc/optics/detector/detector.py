"""The camera: photo-electrons to digital numbers, with the noise of a CCD, CMOS or electron-multiplying CCD."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lowfc.arrays import Pixels, Single
from lowfc.optics.detector.detector_noise_table import FAINT_E, NoiseTable, draw, noise_table


@dataclass(frozen=True)
class Detector:
    """A pixel detector with a 16-bit or shallower converter.

    Attributes:
        gain_e_per_dn: Electrons per digital number.
        read_noise_e: Rms noise of the output amplifier, electrons; after the multiplication register if there is one.
        bias_dn: Digital number of zero electrons.
        full_well_e: Charge at which the output saturates; after the multiplication register if there is one.
        bit_depth: Bits of the converter, at most 16.
        em_gain: Mean gain of the multiplication register; 1 for a detector without one.
        clock_induced_charge_e: Mean number of spurious electrons per pixel and frame, before the register.
        exact: Draw the electrons of every pixel from the Poisson distribution. If False, faint pixels are drawn from
            a precomputed table where one applies, in a third of the time; see `expose`.
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
    """Largest value of a pixel: full well or the end of the converter's range, whichever is lower."""
    full_well_dn = detector.bias_dn + detector.full_well_e / detector.gain_e_per_dn
    return int(min(np.rint(full_well_dn), 2**detector.bit_depth - 1))


def expose(detector: Detector, electrons: NDArray[np.floating], rng: np.random.Generator) -> Pixels:
    """One frame (rows, columns) in DN.

    Electrons are drawn from the Poisson distribution. Multiplication draws from the gamma distribution of a long
    register at a high gain, whose excess noise doubles the photons' variance. A real register of gain g multiplies the
    variance by about 2 - 1 / g.

    If `noise_table_of` returns a table, pixels with a mean below `FAINT_E` electrons are drawn from it. Their
    distribution is exact at means that are multiples of 1/64 electron. Between these the mean is exact and the
    variance too large by at most 6e-5 electrons squared. With a read noise of half an electron or more, a chi-square
    test of a million draws does not detect this. With a lower read noise, pixels with a mean near
    0.005 electrons have two electrons too often.

    Args:
        detector: The detector.
        electrons: (rows, columns) mean photo-electrons in the exposure; negative values count as zero.
        rng: Generator of all random numbers; its bit generator must produce 64-bit words, as all of numpy's but
            MT19937 do.

    Raises:
        ValueError: A mean number of electrons is not finite.
    """
    mean = np.asarray(electrons, np.float32).ravel()
    if detector.clock_induced_charge_e:
        mean = np.maximum(mean, np.float32(0)) + np.float32(detector.clock_induced_charge_e)
    brightest_e = float(mean.max(initial=0))
    if not brightest_e < np.inf:
        raise ValueError(f"the mean electrons in a pixel must be a finite number, got {brightest_e}")
    table = noise_table_of(detector)
    if table is None:
        return _expose_exactly(detector, mean, rng).reshape(electrons.shape)
    frame = draw(table, mean, rng)
    if brightest_e >= FAINT_E:
        bright = np.flatnonzero(mean >= FAINT_E)
        frame[bright] = _expose_exactly(detector, mean[bright], rng)
    return frame.reshape(electrons.shape)


@lru_cache(maxsize=4)
def noise_table_of(detector: Detector) -> NoiseTable | None:
    """The table from which `expose` draws faint pixels, cached; None if all pixels are drawn step by step."""
    if detector.exact or detector.em_gain > 1.0:
        return None
    return noise_table(detector.gain_e_per_dn, detector.read_noise_e, detector.bias_dn, saturation_dn(detector))


def _expose_exactly(detector: Detector, mean_e: Single, rng: np.random.Generator) -> Pixels:
    """Pixels (pixels,) in DN, step by step: electrons, multiplication, full well, read noise, rounding."""
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
