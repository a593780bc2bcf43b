"""Contrast that a small wavefront adds to a coronagraph's dark zone: a quadratic form of its modes.

With the field E = E0 + i k sum a_j E_j - k^2 / 2 sum a_j a_l E_jl, the intensity's second order in a has two terms:
the squared first-order field, and the product of the second-order field with E0. For tilt behind the shaped pupil the
second term cancels most of the first, which alone would be 7 (x) or 9 (y) times as large as the sum. The intensity's
first order averages to zero over a dark zone on both sides of the star.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from lowfc.arrays import Array, Complex, Single
from lowfc.optics.chain.coronagraph import SAMPLES_PER, Coronagraph, wedge_samples
from lowfc.optics.chain.fourier import kernel
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.science_camera import ScienceCamera
from lowfc.optics.chain.zernike import mode_group, zernikes

_BEYOND_QUADRATIC = 0.1  # largest relative difference between full images and the quadratic form
_IMAGE_ROUNDING = 1e-13  # contrast; means of images in single precision are exact to some 1e-14 behind a shaped pupil
_DRAWS = 24  # random wavefronts compared, each with both signs


class ModalContrast:
    """Contrast that modal wavefronts add to a dark zone, from the quadratic form and from full images.

    Attributes:
        noll: Noll index of each mode.
        form: (modes, modes) quadratic form, see `contrast_form`.
    """

    def __init__(
        self, coronagraph: Coronagraph, noll: tuple[int, ...], wavelength_nm: float, form: Array | None = None
    ) -> None:
        """Prepare the images, and compute the form (modes, modes) unless it is given."""
        self.noll, self.form = noll, contrast_form(coronagraph, noll, wavelength_nm) if form is None else form
        self._zone = coronagraph.dark_zone
        self._camera = ScienceCamera(coronagraph, noll, wavelength_nm, int(np.ceil(self._zone.outer)))

    def by_image(self, modes_nm: Array | Single) -> float:
        """Mean contrast of the dark zone with a wavefront (modes,), nm rms; includes the flat wavefront's contrast."""
        return self._camera.mean_contrast(self._camera.image(modes_nm), self._zone)

    def by_mode(self, covariance_nm2: Array) -> Array:
        """Contrast added by each mode (modes,) for wavefronts of a covariance (modes, modes); the sum is the total."""
        return np.asarray(np.sum(self.form * covariance_nm2, axis=1))

    def is_beyond_quadratic(self, covariance_nm2: Array) -> bool:
        """Whether full images of wavefronts with this covariance (modes, modes) differ from the form by over 10 %."""
        values, vectors = np.linalg.eigh(covariance_nm2)
        drawn = np.random.default_rng(1).standard_normal((_DRAWS, len(values)))
        modes_nm = drawn * np.sqrt(np.maximum(values, 0)) @ vectors.T
        both_signs_nm = np.vstack([modes_nm, -modes_nm])  # the odd orders cancel
        flat = self.by_image(np.zeros(len(values)))
        image = float(np.mean([self.by_image(wavefront_nm) - flat for wavefront_nm in both_signs_nm]))
        form = float(np.einsum("nj,jl,nl->", modes_nm, self.form, modes_nm)) / _DRAWS
        return beyond_quadratic(form, image)


def beyond_quadratic(form: float, image: float) -> bool:
    """Whether the contrast added in full images differs from that of the form by over 10 %, beyond rounding errors."""
    return abs(form - image) > max(_BEYOND_QUADRATIC * abs(image), _IMAGE_ROUNDING)


def by_group(noll: Sequence[int], by_mode: Array) -> dict[str, float]:
    """Added contrast of the modes (modes,), summed over the modes of each kind, such as both comas; largest first."""
    groups: dict[str, float] = {}
    for index, contrast in zip(noll, by_mode.tolist(), strict=True):
        groups[mode_group(index)] = groups.get(mode_group(index), 0.0) + contrast
    return dict(sorted(groups.items(), key=lambda pair: -pair[1]))


def costliest(groups: Mapping[str, float]) -> tuple[str, float]:
    """The kind of modes that adds most contrast, and its share of the positive values in the result of `by_group`."""
    # Behind a classical Lyot coronagraph tilt removes light: its contrast is negative.
    added = [max(contrast, 0.0) for contrast in groups.values()]
    return next(iter(groups)), added[0] / (sum(added) or 1.0)


def contrast_form(coronagraph: Coronagraph, noll: tuple[int, ...], wavelength_nm: float) -> Array:
    """Quadratic form Q (modes, modes), per nm^2: a wavefront a (modes,) adds the mean contrast a' Q a in the dark zone.

    Args:
        coronagraph: The optics.
        noll: Noll index of each mode; a is nm rms over the circle.
        wavelength_nm: The wavelength.
    """
    pupil, wedge, lyot = coronagraph.pupil, coronagraph.dark_zone, coronagraph.lyot
    side = 2 * int(np.ceil(wedge.outer * SAMPLES_PER))
    inside = wedge_samples(wedge, side, side)
    to_focus = kernel(side, SAMPLES_PER, len(pupil), 1.0)
    axis = 2 * pupil_axis(len(pupil))  # in pupil radii
    rows, columns = np.nonzero(pupil)
    shapes = zernikes(noll, axis[columns], axis[rows])

    def image(field: Array) -> Complex:
        return np.asarray(to_focus @ coronagraph.behind(field) @ to_focus.T)

    def first_order(shape: Array) -> Complex:
        field = np.zeros_like(pupil)
        field[rows, columns] = pupil[rows, columns] * shape
        return image(field)[inside]

    fields = np.array([first_order(shape) for shape in shapes])
    back = to_focus.T @ (image(pupil).conj() * inside) @ to_focus  # the sum over the wedge, brought back to the pupil
    back = back if lyot is None else lyot.transposed(back)
    second = (shapes * (pupil * back.real)[rows, columns]) @ shapes.T
    scale = (2 * np.pi / wavelength_nm / coronagraph.peak) ** 2 / np.count_nonzero(inside)
    return np.asarray(scale * ((fields @ fields.conj().T).real - second))


def without_negative(form: Array) -> Array:
    """The form (modes, modes), contrast per nm^2, with negative eigenvalues set to 0 for use as a loss function."""
    values, vectors = np.linalg.eigh(form)
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)
