"""Pupils: open circle, apodised pupils of coronagraphs, circle with a bar for the relay; the field behind a pupil."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lowfc.arrays import Array, Complex
from lowfc.optics.chain.grid import pupil_axis


def circle(samples: int) -> Array:
    """Open circular pupil (samples, samples): 1 where the sample's centre is inside, else 0."""
    u = pupil_axis(samples)
    return (u[:, None] ** 2 + u**2 <= 0.25).astype(np.float64)


def circle_with_bar(samples: int, width: float, angle_deg: float) -> Array:
    """Circle (samples, samples) with a bar from the centre to the edge, which makes it asymmetric (paper's Sect. 4).

    Args:
        samples: Points across the diameter.
        width: Width of the bar, in pupil diameters.
        angle_deg: Angle of the bar, from the x axis towards y.
    """
    u, angle = pupil_axis(samples), np.deg2rad(angle_deg)
    along = u * np.cos(angle) + u[:, None] * np.sin(angle)
    across = u[:, None] * np.cos(angle) - u * np.sin(angle)
    return np.asarray(circle(samples) * ~((along >= 0) & (np.abs(across) <= width / 2.0)))


def prolate(samples: int, mask_radius: float) -> Array:
    """Apodised pupil (samples, samples) of an apodised-pupil Lyot coronagraph, 1 at its centre.

    It is the circular prolate function: of all pupils it concentrates the most light within the focal-plane mask.

    Args:
        samples: Points across the diameter.
        mask_radius: Radius of the focal-plane mask, in lambda0 / D.

    Raises:
        ValueError: The radius is not positive.
    """
    if not mask_radius > 0:
        raise ValueError(f"the radius of the focal-plane mask must be positive, got {mask_radius} lambda0 / D")
    points, weights = np.polynomial.legendre.leggauss(64)
    rho = 0.25 * (points + 1.0)  # 0 to 1/2
    weights = 0.25 * weights * rho
    root = np.sqrt(weights)
    _, vectors = np.linalg.eigh(root[:, None] * _mask_kernel(rho, rho, mask_radius) * root)
    values = weights * (vectors[:, -1] / root)
    u = pupil_axis(samples)
    r = np.hypot(u[:, None], u)
    inside = r <= 0.5
    amplitude = np.zeros((samples, samples))
    radii, where = np.unique(r[inside], return_inverse=True)
    amplitude[inside] = (_mask_kernel(radii, rho, mask_radius) @ values)[where]
    centre = float((_mask_kernel(np.zeros(1), rho, mask_radius) @ values)[0])
    return np.clip(amplitude / centre, 0.0, 1.0)


def _mask_kernel(r: Array, rho: Array, radius: float) -> Array:
    """Kernel (r, rho) from pupil via mask to pupil: integral of x J0(2 pi r x) J0(2 pi rho x), x from 0 to `radius`."""
    from scipy.special import j0, j1  # its import takes a quarter of a second; most processes load a stored result

    a, b = 2.0 * np.pi * r[:, None], 2.0 * np.pi * rho[None, :]
    gap = a**2 - b**2
    near = np.abs(gap) < 1e-6
    apart = a * j1(a * radius) * j0(b * radius) - b * j0(a * radius) * j1(b * radius)
    same = 0.5 * radius**2 * (j0(a * radius) * j0(b * radius) + j1(a * radius) * j1(b * radius))
    return np.where(near, same, radius * apart / np.where(near, 1.0, gap))


def from_quarter(quarter: ArrayLike, samples: int) -> Array:
    """Pupil (samples, samples) from its quadrant x >= 0, y >= 0, mirrored in both axes.

    Args:
        quarter: (cells, cells) amplitude transmission from 0 to 1, [0, 0] next to the pupil's centre.
        samples: Points across the diameter, a multiple of twice the number of cells.

    Raises:
        ValueError: The quadrant is not real and square, has values outside 0..1 or none above one half, or `samples`
            is not a multiple of twice its cells.
    """
    array = np.asarray(quarter)
    if array.dtype.kind not in "buif":
        raise ValueError(f"a quadrant must be of real numbers, got {array.dtype}")
    quarter = array.astype(np.float64)
    if quarter.ndim != 2 or quarter.shape[0] != quarter.shape[1] or not quarter.size:
        raise ValueError(f"a quadrant must be square, got shape {quarter.shape}")
    if not (np.isfinite(quarter).all() and quarter.min() >= 0 and quarter.max() <= 1):
        raise ValueError("a quadrant's transmission must lie between 0 and 1")
    repeat, remainder = divmod(samples, 2 * quarter.shape[0])
    if remainder or not repeat:
        cells = len(quarter)
        raise ValueError(
            f"the samples across a pupil must be a multiple of {2 * cells}, twice the quadrant's {cells} cells, "
            f"got {samples}: resample the quadrant"
        )
    if not quarter.max() > 0.5:
        raise ValueError(
            "a quadrant's transmission must exceed one half somewhere, since wavefronts are judged there, got at most "
            f"{quarter.max():g}"
        )
    right = np.vstack([quarter[::-1], quarter])
    return np.kron(np.hstack([right[:, ::-1], right]), np.ones((repeat, repeat)))


def aberrated(pupil: Array, opd_nm: NDArray[np.floating], wavelength_nm: float) -> Complex:
    """Field (n, n) after a pupil for a wavefront (n, n) in nm; ValueError if it is not sampled like the pupil."""
    if opd_nm.shape != pupil.shape:
        raise ValueError(f"a wavefront must be sampled like the pupil, {pupil.shape}, got {opd_nm.shape}")
    field, transmits = np.zeros(pupil.shape, np.complex128), pupil != 0  # a fifth of the samples, for a shaped pupil
    field[transmits] = pupil[transmits] * np.exp((2j * np.pi / wavelength_nm) * opd_nm[transmits])
    return field
