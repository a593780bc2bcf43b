"""Estimators of modes from an image: plain and noise-weighted pseudo-inverse, and iterations with the full model."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Array
from lowfc.control.calibration.calibration import ESTIMATORS, reconstructor

Model = Callable[[Array], Array]
"""Function from modes, nm, to the image (pixels,), fractions of the open circle's light, with the full exp(i phi)."""

KINDS = ESTIMATORS[::-1]
"""Kinds of linear estimator; the first is the paper's plain pseudo-inverse."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A linear estimator for one exposure of one sensor; the total flux is assumed to be known.

    Attributes:
        reference_e: (pixels,) I0 in electrons.
        response_e: (pixels, modes) H in electrons per nm.
        R: (modes, pixels) nm per electron.
        scale_e: Electrons of the open circle's light in the exposure.
    """

    reference_e: Array
    response_e: Array
    R: Array
    scale_e: float


def fit(I0: Array, H: Array, scale_e: float, read_noise_e: float, kind: str, nuisance: Array | None = None) -> Fit:
    """The least-squares solution of the paper's eq. (11) for one exposure.

    Args:
        I0: (pixels,) image of a flat wavefront, fractions of the open circle's light.
        H: (pixels, modes) derivative of the image per nm of each mode.
        scale_e: Electrons of the open circle's light in the exposure: the factor from fractions to electrons.
        read_noise_e: Read noise of each pixel.
        kind: "pinv" weights all pixels equally, "weighted" by the inverse variance of the flat wavefront's image.
        nuisance: (pixels, extra) changes of the image by nuisance parameters, in fractions per unit of each: I0 for the
            flux, `lowfc.optics.chain.sensor.shear_response` for the pupil's shear. They are fitted and dropped.

    Raises:
        ValueError: Unknown kind, or modes that this sensor cannot distinguish.
    """
    R = reconstructor(I0, H, np.ones_like(I0), scale_e, read_noise_e, kind, nuisance)
    return Fit(I0 * scale_e, H * scale_e, R / scale_e, scale_e)


def estimate(fit: Fit, image_e: Array) -> Array:
    """Estimate modes in nm, (modes,) or (n, modes), from an image (pixels,) or images (n, pixels) in electrons."""
    return np.asarray((image_e - fit.reference_e) @ fit.R.T)


def iterated(fit: Fit, image_e: Array, model: Model, iterations: int) -> list[Array]:
    """Estimates (modes,), nm, after 0 to `iterations` iterations with the full model: a <- a + R (I - I_model(a)).

    R is constant, the model is nonlinear. Two iterations suffice for wavefronts with the input rms of Table 3.

    Args:
        fit: The linear estimator.
        image_e: (pixels,) image in electrons.
        model: The sensor's image for modes in nm.
        iterations: Number of iterations.
    """
    estimates = [estimate(fit, image_e)]
    for _ in range(iterations):
        estimates.append(estimates[-1] + fit.R @ (image_e - fit.scale_e * model(estimates[-1])))
    return estimates
