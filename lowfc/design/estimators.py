"""From an image to modes: plain and noise-weighted pseudo-inverse (Sect. 2.3), and iterations with the full model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import ESTIMATORS, reconstructor

Model = Callable[[Array], Array]
"""Image (pixels,), fractions of the open circle's light, of modes in nm: with exp(i phi) and not its expansion."""

KINDS = ESTIMATORS[::-1]
"""The plain one first, as in the paper."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A linear estimator for one exposure of one sensor; the light's total is taken to be known.

    Attributes:
        nolls: Noll index of each mode.
        reference_e: (pixels,) I0 in electrons.
        response_e: (pixels, modes) H in electrons per nm.
        R: (modes, pixels) nm per electron.
        kind: One of `KINDS`.
        scale_e: Electrons of the open circle's light in the exposure.
    """

    nolls: tuple[int, ...]
    reference_e: Array
    response_e: Array
    R: Array
    kind: str
    scale_e: float


def fit(
    nolls: Sequence[int],
    I0: Array,
    H: Array,
    scale_e: float,
    read_noise_e: float,
    kind: str,
    nuisance: Array | None = None,
) -> Fit:
    """The least-squares solution of eq. (11) for one exposure.

    Args:
        nolls: Noll index of each mode.
        I0: (pixels,) flat wavefront's image, fractions of the open circle's light.
        H: (pixels, modes) its derivative per nm of each mode.
        scale_e: Electrons of the open circle's light in the exposure: fractions times this are electrons.
        read_noise_e: Of each pixel.
        kind: "pinv" weighs all pixels alike, "weighted" by the inverse variance of the flat image.
        nuisance: (pixels, extra) changes of the image that are no wavefront, in fractions per unit of each: I0 for the
            flux, `lowfc.optics.chain.sensor.shear_response` for the pupil's shear. They are fitted along and dropped.

    Raises:
        ValueError: Unknown kind, or modes that this sensor cannot tell apart.
    """
    R = reconstructor(I0, H, np.ones_like(I0), scale_e, read_noise_e, kind, nuisance)
    return Fit(tuple(nolls), I0 * scale_e, H * scale_e, R / scale_e, kind, scale_e)


def estimate(fit: Fit, image_e: Array) -> Array:
    """Modes in nm, (modes,) or (n, modes), of an image (pixels,) or images (n, pixels) in electrons."""
    return np.asarray((image_e - fit.reference_e) @ fit.R.T)


def iterated(fit: Fit, image_e: Array, model: Model, iterations: int) -> list[Array]:
    """Estimates (modes,) in nm after none, one, ... `iterations` with the full model: a <- a + R (I - I_model(a)).

    The gain stays, the model is not linear; two iterations are enough for the wavefronts of Sect. 3.1.

    Args:
        fit: The linear estimator.
        image_e: (pixels,) electrons.
        model: The sensor's image for modes in nm.
        iterations: How many.
    """
    found = [estimate(fit, image_e)]
    for _ in range(iterations):
        found.append(found[-1] + fit.R @ (image_e - fit.scale_e * model(found[-1])))
    return found
