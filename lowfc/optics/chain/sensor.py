"""The full optical chain of a sensor, with diffraction: star to binned sensor image (Subedi et al. 2015, Sect. 2)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lowfc.arrays import Array, Complex
from lowfc.optics.chain.band import Band, monochromatic
from lowfc.optics.chain.fourier import to_image, to_pupil
from lowfc.optics.chain.grid import OPEN_AREA, image_axis, pupil_axis
from lowfc.optics.chain.pupil import aberrated
from lowfc.optics.chain.relay import ApertureMask, Defocus, PupilImage, Relay, direct_kernel


@dataclass(frozen=True, eq=False)
class Sensor:
    """The hardware of a wavefront sensor that uses the light rejected by a coronagraph's focal-plane mask.

    Attributes:
        pupil: (n, n) amplitude transmission of the coronagraph's pupil.
        focal_mask: (k, k) amplitude reflectivity of the focal-plane mask to the sensor, k even, centred; complex if it
            delays light, as the spot of a Zernike sensor does.
        relay: The optics between the focal-plane mask and the detector.
        wavelength_nm: The central wavelength, lambda0.
        samples_per: Samples per lambda0 / D in the focal planes.
        binning: Samples per pixel, in each direction.
        pixels: Pixels across the square image.
    """

    pupil: Array
    focal_mask: NDArray[np.inexact]
    relay: Relay
    wavelength_nm: float = 550.0
    samples_per: int = 8
    binning: int = 2
    pixels: int = 80

    def __post_init__(self) -> None:
        if self.pupil.ndim != 2 or self.pupil.shape[0] != self.pupil.shape[1]:
            raise ValueError(f"the pupil must be square, got shape {self.pupil.shape}")
        if isinstance(self.relay, ApertureMask) and self.relay.transmission.shape != self.pupil.shape:
            raise ValueError(
                f"the relay mask must be sampled like the pupil, {self.pupil.shape}, got "
                f"{self.relay.transmission.shape}"
            )
        if self.focal_mask.ndim != 2 or self.focal_mask.shape[0] != self.focal_mask.shape[1]:
            raise ValueError(f"the focal-plane mask must be square, got shape {self.focal_mask.shape}")
        if isinstance(self.relay, Defocus):
            reach = (self.pixels * self.binning + self.focal_mask.shape[0]) / (2.0 * self.samples_per)
            # The sum over the focal plane aliases if the phase of chirp times field advances by a wave per sample.
            spare = 2.0  # cycles per lambda0 / D: 0.5 for the edge of the pupil, 1.5 for short wavelengths
            least = reach / (self.samples_per - spare)
            if self.relay.distance < least:
                raise ValueError(
                    f"{self.samples_per} samples per lambda/D resolve a defocus of at least {least:.3g} (lambda/D)^2, "
                    f"got {self.relay.distance:.3g}; increase the distance or use a smaller focal ratio"
                )
        if not self.wavelength_nm > 0:
            raise ValueError(f"the wavelength must be positive, got {self.wavelength_nm} nm")

    @property
    def samples(self) -> int:
        """Samples across the detector."""
        return self.pixels * self.binning

    @property
    def pitch(self) -> float:
        """Spacing of the detector samples, in lambda0 / D; in D for a `PupilImage`."""
        return self.relay.width / self.samples if isinstance(self.relay, PupilImage) else 1.0 / self.samples_per


@dataclass(frozen=True)
class LightBudget:
    """Throughput of the elements, each relative to the light that its description names.

    Attributes:
        pupil: Fraction of the open circle's light that the pupil mask transmits.
        focal_mask: Fraction of the light after the pupil that the focal-plane mask reflects to the sensor.
        relay_mask: Fraction of the light reflected by the focal-plane mask that a relay-pupil mask transmits; 1
            without a relay-pupil mask.
        sensor: Fraction of the light reflected by the focal-plane mask that falls on the pixels.
        total: Fraction of the open circle's light that falls on the pixels.
        peak: Fraction of the light on the pixels that falls on the brightest pixel.
    """

    pupil: float
    focal_mask: float
    relay_mask: float
    sensor: float
    total: float
    peak: float


def pupil_radii(sensor: Sensor) -> tuple[Array, Array]:
    """Coordinates x (1, n) and y (n, 1) of the pupil samples in pupil radii, for Zernike polynomials."""
    u = 2.0 * pupil_axis(sensor.pupil.shape[0])
    return u[None, :], u[:, None]


def propagate(
    sensor: Sensor,
    pupil_field: NDArray[np.inexact],
    wavelength_nm: float,
    focal_mask: NDArray[np.inexact] | None = None,
) -> Complex:
    """Field at the sensor's samples, eqs. (4) to (6) or (13), for a field (n, n) after the pupil mask.

    Args:
        sensor: The optics.
        pupil_field: The field after the pupil mask, in any unit.
        wavelength_nm: The wavelength.
        focal_mask: Replaces the sensor's focal-plane mask if given.
    """
    mask = sensor.focal_mask if focal_mask is None else focal_mask
    scale = sensor.wavelength_nm / wavelength_nm
    focal = to_image(pupil_field, mask.shape[0], sensor.samples_per, scale)
    return from_focus(sensor, focal * mask, wavelength_nm)


def from_focus(sensor: Sensor, focal: Complex, wavelength_nm: float) -> Complex:
    """Field at the sensor's samples for a field (k, k) after the focal-plane mask, in any unit."""
    size, relay, scale = focal.shape[0], sensor.relay, sensor.wavelength_nm / wavelength_nm
    if isinstance(relay, ApertureMask):
        in_relay = to_pupil(focal, sensor.pupil.shape[0], sensor.samples_per, scale)
        return to_image(in_relay * relay.transmission, sensor.samples, sensor.samples_per, scale)
    matrix = direct_kernel(relay, sensor.samples, size, sensor.samples_per, scale)
    return np.asarray(matrix @ focal @ matrix.T)


def field(sensor: Sensor, opd_nm: NDArray[np.floating], wavelength_nm: float | None = None) -> Complex:
    """Field at the sensor's samples for a wavefront (n, n) in nm, from the full exp(i phi), not from its expansion.

    Args:
        sensor: The optics.
        opd_nm: Wavefront (n, n).
        wavelength_nm: The wavelength; the central one when None.

    Raises:
        ValueError: The wavefront is not sampled like the pupil.
    """
    wavelength_nm = sensor.wavelength_nm if wavelength_nm is None else wavelength_nm
    return propagate(sensor, aberrated(sensor.pupil, opd_nm, wavelength_nm), wavelength_nm)


def image(sensor: Sensor, opd_nm: NDArray[np.floating], band: Band | None = None) -> Array:
    """Image (pixels, pixels): the light on each pixel divided by the light entering the open circular pupil.

    Args:
        sensor: The optics.
        opd_nm: Wavefront (n, n).
        band: The central wavelength alone when None.
    """
    band = monochromatic(sensor.wavelength_nm) if band is None else band
    total = np.zeros((sensor.pixels, sensor.pixels))
    for wavelength_nm, weight in zip(band.wavelengths_nm, band.weights, strict=True):
        at_sensor = field(sensor, opd_nm, wavelength_nm)
        total += weight * pixel_sums(sensor, at_sensor.real**2 + at_sensor.imag**2)
    return total


def reference(sensor: Sensor, band: Band | None = None) -> Array:
    """I0 (pixels, pixels): the image of a flat wavefront, eqs. (6) and (8), in the units of `image`."""
    return image(sensor, np.zeros(sensor.pupil.shape), band)


def response(sensor: Sensor, basis: NDArray[np.floating], band: Band | None = None) -> Array:
    """H = dI/da (pixels squared, modes), in the units of `image` per nm of each mode.

    H = 2 (2 pi / lambda) Re{E0 conj(i E_k)}, where E0 is the field of the flat wavefront, and E_k the field of the
    pupil times mode k: eq. (12) with the 2 of eq. (9), so that I - I0 = H a.

    Args:
        sensor: The optics.
        basis: Modes (modes, n, n); of unit rms if the coefficients a are to be in nm rms.
        band: The central wavelength alone when None.
    """
    band = monochromatic(sensor.wavelength_nm) if band is None else band
    H = np.zeros((sensor.pixels**2, len(basis)))
    for wavelength_nm, weight in zip(band.wavelengths_nm, band.weights, strict=True):
        E0 = propagate(sensor, sensor.pupil, wavelength_nm)
        for k, mode in enumerate(basis):
            Ek = propagate(sensor, sensor.pupil * mode, wavelength_nm)
            slope = (4.0 * np.pi / wavelength_nm) * (E0 * np.conj(1j * Ek)).real
            H[:, k] += weight * pixel_sums(sensor, slope).ravel()
    return H


def shear_response(sensor: Sensor, band: Band | None = None) -> Array:
    """dI/ds (pixels squared, 2), in the units of `image` per pupil diameter of shear of the beam along x and y.

    A shift of the beam in the pupil is a phase ramp in the focal plane: there, the derivative of the field is -2 pi i x
    times the field. Shear is a nuisance parameter: beam wander on the relay mask mimics a wavefront error.

    Args:
        sensor: The optics.
        band: The central wavelength alone when None.
    """
    band = monochromatic(sensor.wavelength_nm) if band is None else band
    x = image_axis(sensor.focal_mask.shape[0], sensor.samples_per)
    slopes = np.zeros((sensor.pixels**2, 2))
    for wavelength_nm, weight in zip(band.wavelengths_nm, band.weights, strict=True):
        ramp = (-2j * np.pi * sensor.wavelength_nm / wavelength_nm) * x
        E0 = propagate(sensor, sensor.pupil, wavelength_nm)
        for k, along in enumerate((ramp[None, :], ramp[:, None])):
            E1 = propagate(sensor, sensor.pupil, wavelength_nm, sensor.focal_mask * along)
            slopes[:, k] += weight * pixel_sums(sensor, 2.0 * (E0 * np.conj(E1)).real).ravel()
    return slopes


def light_budget(sensor: Sensor) -> LightBudget:
    """The throughput of each element at the central wavelength, for a flat wavefront."""
    samples, area = sensor.pupil.shape[0], 1.0 / sensor.samples_per**2
    focal = to_image(sensor.pupil, sensor.focal_mask.shape[0], sensor.samples_per, 1.0)
    focal = focal * sensor.focal_mask
    after_pupil = np.sum(sensor.pupil**2) / samples**2
    after_focal = np.sum(np.abs(focal) ** 2) * area
    after_relay = after_focal
    if isinstance(sensor.relay, ApertureMask):
        in_relay = to_pupil(focal, samples, sensor.samples_per, 1.0)
        after_relay = np.sum(np.abs(in_relay * sensor.relay.transmission) ** 2) / samples**2
    I0 = reference(sensor)
    return LightBudget(
        pupil=float(after_pupil / OPEN_AREA),
        focal_mask=float(after_focal / after_pupil),
        relay_mask=float(after_relay / after_focal),
        sensor=float(I0.sum() * OPEN_AREA / after_focal),
        total=float(I0.sum()),
        peak=float(I0.max() / I0.sum()),
    )


def pixel_sums(sensor: Sensor, intensity: Array) -> Array:
    """Sums (pixels, pixels) of an intensity (samples, samples) over each pixel, relative to the open circle's light."""
    shape = (sensor.pixels, sensor.binning, sensor.pixels, sensor.binning)
    return np.asarray(intensity.reshape(shape).sum(axis=(1, 3))) * (sensor.pitch**2 / OPEN_AREA)
