"""The calibration; reconstructors from a reference image and a response matrix; normalisation by flux; noise."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lowfc.arrays import Array, Single
from lowfc.control.identity import identity
from lowfc.control.loop.camera import CameraSettings

ESTIMATORS = ("weighted", "pinv")

SINGULAR_CONDITION = 1e8
"""Condition number of H above which the sensor cannot tell the modes apart."""

FIRST_SUFFIX = "+first"
"""Suffix of `Calibration.estimator` for the first calibration of a commissioning."""


@dataclass(frozen=True, slots=True, eq=False)  # hashed as an object, so that it can be a key of a cache
class Calibration:
    """Matrices from a frame to modes and from modes to actuators; single precision, as in the loop.

    Attributes:
        noll: Noll index of each mode.
        reference: (pixels,) I0 in flux fractions; sums to 1 over the good pixels.
        response: (pixels, modes) H in flux fractions per nm of wavefront rms.
        reconstructor: (modes, pixels) R in nm per flux fraction; zero at bad pixels.
        good: (pixels,) 1 for a used pixel, else 0.
        dark: (pixels,) dark image, DN.
        modes_to_actuators: (actuators, modes) nm of surface per nm of wavefront rms; includes the 1/2 of reflection.
        actuators_to_modes: (modes, actuators) nm of wavefront rms that R measures per nm of surface; empty if unknown.
        shape: rows and columns of the frame.
        grid: rows and columns of the mirror.
        flux_dn: expected sum of the good pixels, dark subtracted.
        saturation_dn: highest value a pixel can have.
        estimator: how R was computed: weighted or pinv, and fitted nuisance parameters, as in weighted+shear.
        wavelength_nm: wavelength of H.
        operator_hash: hash of the optical model that the calibration was computed from; empty for a measured one.
        id: identity of the calibration.
        camera: camera settings with which it was made; None if unknown.
    """

    noll: tuple[int, ...]
    reference: Single
    response: Single
    reconstructor: Single
    good: Single
    dark: Single
    modes_to_actuators: Single
    shape: tuple[int, int]
    grid: tuple[int, int]
    flux_dn: float
    saturation_dn: float
    estimator: str
    wavelength_nm: float
    operator_hash: str
    id: str
    actuators_to_modes: Single = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    camera: CameraSettings | None = None

    def __post_init__(self) -> None:
        for name, shape in array_shapes(len(self.noll), self.shape, self.grid).items():
            array = getattr(self, name)
            if array.shape != shape and not (name == "actuators_to_modes" and not array.size):
                raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds values that are not finite")
        if not 0 < self.flux_dn < np.inf:
            raise ValueError(f"flux_dn must be above 0 and finite, got {self.flux_dn}")

    @property
    def provisional(self) -> bool:
        """Whether it is the first calibration of a commissioning, whose accuracy has not been checked."""
        return self.estimator.endswith(FIRST_SUFFIX)

    @classmethod
    def none(cls, grid: tuple[int, int]) -> "Calibration":
        """Placeholder for no calibration: a mirror of (rows, columns) actuators, without modes or pixels."""
        shapes = array_shapes(0, (0, 0), grid)
        arrays: dict[str, Any] = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
        values: dict[str, Any] = {"estimator": "none", "wavelength_nm": 0.0, "operator_hash": "", "id": ""}
        return cls((), shape=(0, 0), grid=grid, flux_dn=1.0, saturation_dn=np.inf, **arrays, **values)

    def identity(self) -> str:
        """The correct `id`: a hash of all other content."""
        camera = self.camera
        settings = None if camera is None else tuple(getattr(camera, name) for name in _CAMERA_IDENTITY)
        parts = [(name, getattr(self, name)) for name in _IDENTITY]
        return identity([*parts, ("camera", settings)])


_IDENTITY = (
    *("noll", "reference", "response", "reconstructor", "good", "dark", "modes_to_actuators", "shape", "grid"),
    *("flux_dn", "saturation_dn", "estimator", "wavelength_nm", "operator_hash", "actuators_to_modes"),
)
_CAMERA_IDENTITY = ("shape", "region", "bias_dn", "saturation_dn", "gain_e_per_dn", "em_gain", "read_noise_e")


def array_shapes(modes: int, shape: tuple[int, int], grid: tuple[int, int]) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of a calibration, by name; `actuators_to_modes` may be empty."""
    pixels, actuators = shape[0] * shape[1], grid[0] * grid[1]
    return {
        **dict.fromkeys(("reference", "good", "dark"), (pixels,)),
        "response": (pixels, modes),
        "reconstructor": (modes, pixels),
        "modes_to_actuators": (actuators, modes),
        "actuators_to_modes": (modes, actuators),
    }


def same_frames_and_modes(one: Calibration, other: Calibration) -> bool:
    """Whether two calibrations have frames of the same size and the same modes."""
    return one.shape == other.shape and one.noll == other.noll


def normalise_flux(reference: Array, response: Array, good: Array) -> tuple[Array, Array]:
    """Normalise I0 (pixels,) and H (pixels, modes) like frames, which are divided by their own flux.

    Returns I0 in flux fractions and the derivative of I/sum(I) with respect to each mode, in flux fractions per nm.
    """
    flux = _flux(reference, good)
    fraction = reference / flux
    change = good @ response / flux
    return fraction, response / flux - np.outer(fraction, change)


def for_unnormalised_images(reconstructor: Array, reference: Array, good: Array) -> Array:
    """R' (modes, pixels), nm per unit of I0, for images not divided by their flux: R' H = R N, N the normalised H."""
    flux = _flux(reference, good)
    return np.asarray((reconstructor - np.outer(reconstructor @ reference / flux, good)) / flux)


def _flux(reference: Array, good: Array) -> float:
    flux = float(reference @ good)
    if not flux > 0:
        raise ValueError(f"the reference image has no light on the good pixels (sum {flux})")
    return flux


def reconstructor(
    reference: Array,
    response: Array,
    good: Array,
    flux_e: float,
    read_noise_e: float,
    estimator: str = "weighted",
    nuisance: Array | None = None,
) -> Array:
    """R (modes, pixels) from normalised I0 and H: error = R (I - I0), least squares, eq. (11) of Subedi et al. 2015.

    `weighted` is (H' W H)^-1 H' W with W = 1 / (I0 + read_noise^2) in electrons. It is the unbiased linear estimate
    with the least noise, if the noise of the flux by which a frame is divided is neglected. `pinv` weights all pixels
    equally. Bad pixels have zero weight.

    Args:
        reference: (pixels,) I0, normalised.
        response: (pixels, modes) H, normalised.
        good: (pixels,) 1 for a used pixel, else 0.
        flux_e: Electrons on the good pixels.
        read_noise_e: Read noise of a pixel.
        estimator: One of `ESTIMATORS`.
        nuisance: (pixels, parameters) responses to other changes of the image, normalised like H, in any unit. They are
            fitted together with the modes, so that these changes are not measured as modes; R has no rows for them. A
            change of flux needs no nuisance response.

    Raises:
        ValueError: unknown estimator, or modes or nuisance parameters that this sensor cannot tell apart.
    """
    if estimator == "weighted":
        variance_e = np.maximum(reference, 0) * flux_e + read_noise_e**2
        weights = good / np.maximum(variance_e, 1e-12 * variance_e.max())
    elif estimator == "pinv":
        weights = good
    else:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}, got {estimator!r}")
    root = np.sqrt(weights)[:, None]
    scaled = root * response
    if not condition_number(scaled) < SINGULAR_CONDITION:
        raise ValueError(
            f"the sensor cannot tell the modes apart (condition number above {SINGULAR_CONDITION:.0e}): "
            "use another sensor or fewer modes; an even-symmetric aperture mask gives no signal of even modes"
        )
    if nuisance is None:
        return np.asarray(np.linalg.pinv(scaled) * root.T)
    both = np.hstack([scaled, root * nuisance])
    sizes = np.linalg.norm(both, axis=0)  # divided out, as pinv drops small singular values, and the units differ
    if not (sizes.all() and condition_number(both / sizes) < SINGULAR_CONDITION):
        raise ValueError("the sensor cannot tell modes and nuisance parameters apart: fit fewer of either")
    inverse = np.linalg.pinv(both / sizes) / sizes[:, None]
    return np.asarray((inverse * root.T)[: response.shape[1]])


def condition_number(response: Array) -> float:
    """Largest over smallest singular value, without unit, of H (pixels, modes); infinite if a mode has no signal."""
    singular = np.linalg.svd(response, compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")


def noise_nm(matrix: Array, reference: Array, flux_e: float, read_noise_e: float) -> Array:
    """Standard deviation (modes,), nm, of the noise of the modes measured from one frame; see `noise_nm2`."""
    return np.asarray(np.sqrt(np.diag(noise_nm2(matrix, reference, flux_e, read_noise_e))))


def noise_nm2(matrix: Array, reference: Array, flux_e: float, read_noise_e: float) -> Array:
    """Covariance (modes, modes), nm^2, of the photon and read noise of one frame after R (modes, pixels)."""
    return scaled_noise_nm2(unit_noise_nm2(matrix, reference), flux_e, read_noise_e)


def unit_noise_nm2(matrix: Array, reference: Array) -> tuple[Array, Array]:
    """Covariances (modes, modes), nm^2, of photon noise and of read noise, for a flux and a read noise of one electron.

    The normalisation divides by the frame's own noisy flux, so that each pixel's noise n acts as n - I0 sum(n).
    """
    good = (np.abs(matrix).sum(axis=0) > 0).astype(float)
    effective = matrix - np.outer(matrix @ reference, good)
    return effective * np.maximum(reference, 0) @ effective.T, effective @ effective.T


def scaled_noise_nm2(unit_noise: tuple[Array, Array], flux_e: float, read_noise_e: float) -> Array:
    """Covariance (modes, modes), nm^2, of the noise of one frame, from `unit_noise_nm2`."""
    from_photons_nm2, from_read_out_nm2 = unit_noise
    return np.asarray(from_photons_nm2 / flux_e + from_read_out_nm2 * (read_noise_e / flux_e) ** 2)
