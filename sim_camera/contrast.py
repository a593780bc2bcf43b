"""Contrast that the simulated wavefront adds to the dark zone, from full science images and from the quadratic form."""

from dataclasses import dataclass

import numpy as np

from lowfc.arrays import Single
from lowfc.optics.chain.added_contrast import ModalContrast

IMAGES = 200
"""Full images averaged in a figure, if there were enough frames."""


@dataclass(frozen=True, slots=True)
class AddedContrast:
    """Means over `science_images` instants of a run's second half, by the names of the message's fields.

    Attributes:
        added_contrast_flat: added by the disturbance, as with a flat mirror, from full images.
        added_contrast: added by the residual, from full images.
        science_images: instants.
        quadratic_added_contrast: added by the residual, from the quadratic form, at the same instants.
        dark_zone_contrast: of the coronagraph itself, without any wavefront.
    """

    added_contrast_flat: float
    added_contrast: float
    science_images: int
    quadratic_added_contrast: float
    dark_zone_contrast: float


class Contrast:
    """Keeps modes of some instants, evenly spread over a run of unknown length.

    Attributes:
        noll: of the modes.
    """

    def __init__(self, modal: ModalContrast) -> None:
        """Begin without an instant."""
        self.noll = modal.noll
        self._modal, self._form = modal, modal.form.astype(np.float32)
        self._kept: list[tuple[Single, Single]] = []
        self._every, self._frames = 1, 0

    def add(self, disturbance_nm: Single, residual_nm: Single) -> None:
        """The modes (modes,) at an instant of the next frame."""
        if self._frames % self._every == 0:
            self._kept.append((disturbance_nm, residual_nm))
            if len(self._kept) == 4 * IMAGES:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self._frames += 1

    def quadratic(self, modes_nm: Single) -> Single:
        """Mean contrast added by each mode (modes,) of wavefronts (many, modes), from the form."""
        return np.asarray(
            np.einsum("nj,nj->j", modes_nm @ self._form, modes_nm) / np.float32(len(modes_nm)), np.float32
        )

    def measure(self) -> AddedContrast | None:
        """Full images at up to `IMAGES` instants of the second half; None before the first frame."""
        half = self._kept[len(self._kept) // 2 :]
        chosen = [half[int(place)] for place in np.linspace(0, len(half) - 1, min(IMAGES, len(half)))]
        if not chosen:
            return None
        by_image = self._modal.by_image
        dark_zone = by_image(np.zeros_like(chosen[0][0]))
        flat, left = (np.mean([by_image(pair[which]) for pair in chosen]) - dark_zone for which in (0, 1))
        quadratic = self.quadratic(np.array([residual for _, residual in chosen])).sum()
        return AddedContrast(
            added_contrast_flat=float(flat),
            added_contrast=float(left),
            science_images=len(chosen),
            quadratic_added_contrast=float(quadratic),
            dark_zone_contrast=dark_zone,
        )
