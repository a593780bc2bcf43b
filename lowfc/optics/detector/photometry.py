"""Electrons from a star, and wavefront tilt per milliarcsecond (Subedi et al. 2015, Sect. 3.3)."""

from dataclasses import dataclass

import numpy as np

PHOTONS_PER_S_M2_NM = 1.005e8
"""Photon flux of a star of V = 0 before the telescope, near 550 nm."""

_RADIANS_PER_MAS = np.pi / (180.0 * 3600.0 * 1000.0)


@dataclass(frozen=True)
class Photometry:
    """A star, a telescope and losses of light; the defaults are those of Sect. 3.3.

    Attributes:
        magnitude: V magnitude of the star.
        diameter_m: Diameter of the open circular pupil.
        bandwidth_nm: Width of the passband.
        throughput: Throughput of all optics before the shaped pupil.
        quantum_efficiency: Electrons per photon.
    """

    magnitude: float = 4.83
    diameter_m: float = 2.0
    bandwidth_nm: float = 110.0
    throughput: float = 0.5
    quantum_efficiency: float = 0.8

    def __post_init__(self) -> None:
        if not (self.diameter_m > 0 and self.bandwidth_nm > 0):
            raise ValueError(
                f"diameter and bandwidth must be positive, got {self.diameter_m} m and {self.bandwidth_nm} nm"
            )
        if not (0 < self.throughput <= 1 and 0 < self.quantum_efficiency <= 1):
            raise ValueError(
                f"throughput and quantum efficiency must lie above 0 and not above 1, got {self.throughput} and "
                f"{self.quantum_efficiency}"
            )


def electrons(photometry: Photometry, exposure_s: float) -> float:
    """Electrons per exposure from all light in the open circle: factor from fractions of this light to electrons."""
    area_m2 = np.pi / 4.0 * photometry.diameter_m**2
    flux = PHOTONS_PER_S_M2_NM * 10.0 ** (-0.4 * photometry.magnitude)
    collected = flux * area_m2 * photometry.bandwidth_nm * exposure_s
    return float(collected * photometry.throughput * photometry.quantum_efficiency)


def tilt_nm_per_mas(diameter_m: float) -> float:
    """Tilt of 1 mas on the sky in nm rms of wavefront over the circle (1/4 of peak to valley): 2.424 nm for 2 m."""
    return float(_RADIANS_PER_MAS * diameter_m * 1e9 / 4.0)
