"""Contrast that the simulated wavefront adds to the dark zone, from full science images and from the quadratic form."""

import numpy as np

from lowfc.arrays import Single
from lowfc.optics.chain.added_contrast import ModalContrast

IMAGES = 200
"""Number of full images averaged for each mean; fewer in a short run."""


class Contrast:
    """Collects modes at instants evenly spread over a run of unknown length; computes the contrast that they add."""

    def __init__(self, modal: ModalContrast) -> None:
        """Start without instants."""
        self._modal, self._form = modal, modal.form.astype(np.float32)
        self._instants: list[tuple[Single, Single]] = []
        self._stride, self._frames = 1, 0

    def add(self, disturbance_nm: Single, residual_nm: Single) -> None:
        """Add the modes (modes,) at one instant of the next frame, nm of wavefront rms."""
        if self._frames % self._stride == 0:
            self._instants.append((disturbance_nm, residual_nm))
            if len(self._instants) == 4 * IMAGES:
                self._instants, self._stride = self._instants[::2], 2 * self._stride
        self._frames += 1

    def quadratic(self, modes_nm: Single) -> Single:
        """Mean contrast added by each mode (..., modes) of wavefronts (..., n, modes), nm, by the quadratic form."""
        added = np.einsum("...nj,...nj->...j", modes_nm @ self._form, modes_nm)
        return np.asarray(added / np.float32(modes_nm.shape[-2]), np.float32)

    def measure(self) -> dict[str, float]:
        """Means at up to `IMAGES` instants of the run's second half, by field of `WavefrontFigures`.

        The contrasts added with a flat mirror and by the residual, and the coronagraph's own, are from full images;
        `quadratic_added_contrast` is from the quadratic form. Empty before the first frame.
        """
        half = self._instants[len(self._instants) // 2 :]
        instants = [half[int(position)] for position in np.linspace(0, len(half) - 1, min(IMAGES, len(half)))]
        if not instants:
            return {}
        by_image = self._modal.by_image
        dark_zone = by_image(np.zeros_like(instants[0][0]))
        disturbance, residual = (np.mean([by_image(pair[which]) for pair in instants]) - dark_zone for which in (0, 1))
        quadratic = self.quadratic(np.array([residual_nm for _, residual_nm in instants])).sum()
        return {
            "added_contrast_flat": float(disturbance),
            "added_contrast": float(residual),
            "science_images": len(instants),
            "quadratic_added_contrast": float(quadratic),
            "dark_zone_contrast": dark_zone,
        }
