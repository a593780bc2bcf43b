"""The telescope's pupil: an open circle, or the shaped pupil that apodises it."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lowfc.optics.grid import pupil_axis


def circle(samples: int) -> NDArray[np.float64]:
    """Open circular pupil (samples, samples): 1 where the sample's centre is inside, else 0."""
    u = pupil_axis(samples)
    return (u[:, None] ** 2 + u**2 <= 0.25).astype(np.float64)


def from_quarter(quarter: ArrayLike, samples: int) -> NDArray[np.float64]:
    """Pupil (samples, samples) from its quadrant x >= 0, y >= 0, mirrored in both axes.

    Args:
        quarter: (cells, cells) amplitude transmission from 0 to 1, [0, 0] next to the pupil's centre.
        samples: Points across the diameter, a multiple of twice the number of cells.

    Raises:
        ValueError: The quadrant is not square, is outside 0..1, or does not divide `samples`.
    """
    quarter = np.asarray(quarter, dtype=np.float64)
    if quarter.ndim != 2 or quarter.shape[0] != quarter.shape[1]:
        raise ValueError(f"a quadrant must be square, got shape {quarter.shape}")
    if not (np.isfinite(quarter).all() and quarter.min() >= 0 and quarter.max() <= 1):
        raise ValueError("a quadrant's transmission must lie between 0 and 1")
    repeat, remainder = divmod(samples, 2 * quarter.shape[0])
    if remainder or not repeat:
        raise ValueError(f"samples must be a multiple of {2 * quarter.shape[0]}, got {samples}")
    right = np.vstack([quarter[::-1], quarter])
    return np.kron(np.hstack([right[:, ::-1], right]), np.ones((repeat, repeat)))
