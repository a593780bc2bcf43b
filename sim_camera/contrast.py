"""What the simulated wavefront adds to the contrast of the dark zone: by the full science image, and by its form."""

from dataclasses import dataclass

import numpy as np

from lowfc.adapters.files import factory
from lowfc.arrays import Array, Single
from lowfc.contract.configuration import Configuration
from lowfc.optics.chain.added_contrast import contrast_form
from lowfc.optics.chain.coronagraph import DARK_ZONE
from lowfc.optics.chain.science_camera import ScienceCamera

IMAGES = 200
"""Full images of each that a figure is the mean of, where there were so many frames."""
_SAMPLES_PER = 2  # of an image in each lambda / D


@dataclass(frozen=True, slots=True)
class AddedContrast:
    """Means over instants of a run's second half.

    Attributes:
        instants: of which the full images were made.
        flat: added by the disturbance, as with a flat mirror, and `left` by what the loop left; of full images.
        quadratic_left: by the quadratic form, at the same instants.
        dark_zone: the coronagraph's own contrast, without any wavefront.
    """

    instants: int
    flat: float
    left: float
    quadratic_left: float
    dark_zone: float


class Contrast:
    """Keeps modes of some instants, evenly spread over a run of unknown length.

    Attributes:
        form: (modes, modes) added contrast per nm^2.
    """

    def __init__(self, pupil: Array, noll: tuple[int, ...], wavelength_nm: float) -> None:
        """Prepare the images of a shaped pupil (n, n)."""
        self.form: Single = contrast_form(pupil, noll, wavelength_nm).astype(np.float32)
        half_width = int(np.ceil(DARK_ZONE.outer))
        self._camera = ScienceCamera(pupil, noll, wavelength_nm, half_width, _SAMPLES_PER)
        self._kept: list[tuple[Single, Single]] = []
        self._every, self._frames = 1, 0

    def add(self, disturbance_nm: Single, residual_nm: Single) -> None:
        """The modes (modes,) at an instant of the next frame."""
        if self._frames % self._every == 0:
            self._kept.append((disturbance_nm, residual_nm))
            if len(self._kept) == 4 * IMAGES:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self._frames += 1

    def quadratic(self, modes_nm: Single) -> float:
        """What wavefronts (many, modes) add on average, by the form."""
        return float(np.einsum("nj,nj->", modes_nm @ self.form, modes_nm)) / len(modes_nm)

    def measure(self) -> AddedContrast | None:
        """Full images at up to `IMAGES` instants of the second half; None before the first frame."""
        half = self._kept[len(self._kept) // 2 :]
        chosen = [half[int(place)] for place in np.linspace(0, len(half) - 1, min(IMAGES, len(half)))]
        if not chosen:
            return None
        dark_zone = self._mean(np.zeros_like(chosen[0][0]))
        flat, left = (np.mean([self._mean(pair[which]) for pair in chosen]) - dark_zone for which in (0, 1))
        quadratic = self.quadratic(np.array([residual for _, residual in chosen]))
        return AddedContrast(len(chosen), float(flat), float(left), quadratic, dark_zone)

    def _mean(self, modes_nm: Single) -> float:
        return self._camera.mean_contrast(self._camera.image(modes_nm), DARK_ZONE)


def contrast_of(config: Configuration) -> Contrast | None:
    """The contrast of a configuration; None without a science image."""
    pupil = factory.science_pupil(config, lambda _: None)
    return None if pupil is None else Contrast(pupil, config.noll, config.star.wavelength_nm)
