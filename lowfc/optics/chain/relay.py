"""The optics between the focal-plane mask and the detector, in which the kinds of sensor differ."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lowfc.arrays import Array, Complex
from lowfc.optics.chain.fourier import kernel
from lowfc.optics.chain.grid import image_axis


@dataclass(frozen=True, eq=False)
class ApertureMask:
    """A mask in the relay pupil, then a focus: sparse aperture (paper's Sect. 2.2), radial bar, or open (Sect. 4).

    Attributes:
        transmission: (n, n) amplitude transmission, sampled like the pupil.
    """

    transmission: Array


@dataclass(frozen=True)
class Defocus:
    """No relay pupil, and the detector out of focus: the coronagraphic low-order wavefront sensor (CLOWFS).

    Attributes:
        distance: Distance from the image of the focal-plane mask, in (lambda0/D)^2; see `fresnel_distance`.
    """

    distance: float

    def __post_init__(self) -> None:
        if not self.distance > 0:
            raise ValueError(f"the detector must be behind the focal-plane mask, got a distance of {self.distance}")


@dataclass(frozen=True)
class PupilImage:
    """The relay pupil imaged on the detector: the Zernike wavefront sensor, whose phase spot is in the focal mask.

    Attributes:
        width: Width of the square image, in pupil diameters.
    """

    width: float = 1.1

    def __post_init__(self) -> None:
        if not self.width > 0:
            raise ValueError(f"the image of the pupil must have a positive width, got {self.width}")


Relay = ApertureMask | Defocus | PupilImage


def fresnel_distance(defocus_mm: float, focal_ratio: float, wavelength_nm: float) -> float:
    """Distance z / (lambda0 F^2), in (lambda0/D)^2: 27.3 for the 6 mm, F/20 and 550 nm of the paper's Sect. 3."""
    return defocus_mm * 1e6 / (wavelength_nm * focal_ratio**2)


@lru_cache(maxsize=16)
def direct_kernel(
    relay: Defocus | PupilImage, samples: int, focal_samples: int, samples_per: int, scale: float
) -> Complex:
    """Kernel (samples, focal_samples), read-only, from focal-plane mask to detector along one axis; conserves energy.

    For a `Defocus` it is the Fresnel integral of the paper's eq. (13), exp(i pi (x' - x)^2 scale / distance), exact if
    the samples resolve the chirp; for a `PupilImage` it is the Fourier transform to the relay pupil.

    Args:
        relay: The optics between mask and detector.
        samples: Samples across the detector.
        focal_samples: Samples across the focal-plane mask.
        samples_per: Samples per lambda0 / D in the focal plane.
        scale: lambda0 / lambda.
    """
    if isinstance(relay, PupilImage):
        # The pupil's samples are spaced by width / samples, not by 1 / samples as in `kernel`.
        stretch = scale * relay.width
        matrix = np.asarray(
            np.sqrt(scale) / samples_per * kernel(focal_samples, samples_per, samples, stretch).conj().T
        )
    else:
        x = image_axis(focal_samples, samples_per)
        chirp = np.exp(1j * np.pi * scale / relay.distance * (image_axis(samples, samples_per)[:, None] - x) ** 2)
        matrix = np.asarray(np.sqrt(scale / (1j * relay.distance)) / samples_per * chirp)
    matrix.flags.writeable = False
    return matrix


def half_band(relay: Relay, width: float, mask_radius: float, scale: float) -> float:
    """Half of the bandwidth of the field on the detector, in cycles per unit of the detector's axis.

    Args:
        relay: The optics before the detector.
        width: Width of the detector, in the unit of the detector's axis.
        mask_radius: Radius of the focal-plane mask, in lambda0 / D.
        scale: lambda0 / lambda.
    """
    match relay:
        case ApertureMask():
            return scale / 2.0
        case PupilImage():
            return scale * mask_radius
        case Defocus():
            # Spatial frequency f displaces light by distance times f: light of higher frequencies misses the detector.
            distance = relay.distance / scale
            return (width / 2.0 + mask_radius + float(np.sqrt(distance))) / distance
