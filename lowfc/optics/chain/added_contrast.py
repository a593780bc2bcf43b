"""What a small wavefront adds to the contrast of a coronagraph's dark zone: a quadratic form of its modes.

With the field E = E0 + i k sum a_j E_j - k^2 / 2 sum a_j a_l E_jl, the intensity's second order in a has two terms:
that of the first-order field, and that of the second-order field with E0. The second is as large as the first for a
shaped pupil: without it tilt would cost 58 times too much. The first order has no mean over a dark zone on both sides
of the star.
"""

import numpy as np

from lowfc.arrays import Array
from lowfc.optics.chain.coronagraph import DARK_ZONE, Wedge, wedge_samples
from lowfc.optics.chain.fourier import kernel
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.zernike import zernikes

BEYOND_QUADRATIC = 0.1
"""By which the form may differ from the image before that is said."""
_SAMPLES_PER = 2  # in each lambda / D: the intensity's band is 1 D to either side


def contrast_form(pupil: Array, noll: tuple[int, ...], wavelength_nm: float, wedge: Wedge = DARK_ZONE) -> Array:
    """Q (modes, modes) of the contrast a' Q a that a wavefront a (modes,) adds on average in a wedge, per nm^2.

    Args:
        pupil: (n, n) amplitude transmission of the shaped pupil.
        noll: Noll index of each mode; a is nm rms over the circle.
        wavelength_nm: The wavelength.
        wedge: Part of the focal plane.
    """
    side = 2 * int(np.ceil(wedge.outer * _SAMPLES_PER))
    inside = wedge_samples(wedge, side, side, _SAMPLES_PER)
    to_focus = kernel(side, _SAMPLES_PER, len(pupil), 1.0)
    radius = 2 * pupil_axis(len(pupil))
    rows, columns = np.nonzero(pupil)
    shapes = zernikes(noll, radius[columns], radius[rows])
    still = to_focus @ pupil @ to_focus.T

    def field(shape: Array) -> Array:
        moved = np.zeros_like(pupil)
        moved[rows, columns] = pupil[rows, columns] * shape
        return np.asarray((to_focus @ moved @ to_focus.T)[inside])

    fields = np.array([field(shape) for shape in shapes])
    back = to_focus.T @ (still.conj() * inside) @ to_focus  # the sum over the wedge, brought back to the pupil
    second = (shapes * (pupil * back.real)[rows, columns]) @ shapes.T
    scale = (2 * np.pi / wavelength_nm / pupil.sum()) ** 2 / np.count_nonzero(inside)
    return np.asarray(scale * ((fields @ fields.conj().T).real - second))


def without_negative(form: Array) -> Array:
    """The form without its negative eigenvalues: for use as a loss, which must not reward a wavefront."""
    values, vectors = np.linalg.eigh(form)
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)
