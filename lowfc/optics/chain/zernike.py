"""Zernike polynomials in Noll order, with unit rms over the unit circle."""

from collections.abc import Sequence
from math import factorial, sqrt

import numpy as np
from numpy.typing import ArrayLike

from lowfc.arrays import Array

NOLLS_14 = tuple(range(2, 16))
"""Radial degrees 1 to 4, the paper's 14 modes."""

NOLLS_20 = tuple(range(2, 22))
"""Radial degrees 1 to 5."""

_NAMES = (
    "piston",
    "tilt x",
    "tilt y",
    "focus",
    "astigmatism 45",
    "astigmatism 0",
    "coma y",
    "coma x",
    "trefoil y",
    "trefoil x",
    "spherical",
    "secondary astigmatism 0",
    "secondary astigmatism 45",
    "tetrafoil 0",
    "tetrafoil 22.5",
    "secondary coma x",
    "secondary coma y",
    "secondary trefoil x",
    "secondary trefoil y",
    "pentafoil x",
    "pentafoil y",
)


def mode_name(noll: int) -> str:
    """Optical name of a mode, such as "focus"; "Zernike 22" and so on above radial degree 5."""
    noll_to_orders(noll)  # refuses an index below 1
    return _NAMES[noll - 1] if noll <= len(_NAMES) else f"Zernike {noll}"


def mode_group(noll: int) -> str:
    """The name without the mode's direction: "coma" for both comas."""
    name = mode_name(noll)
    return name.rsplit(" ", 1)[0] if name.endswith((" x", " y", " 0", " 45", " 22.5")) and noll <= len(_NAMES) else name


def noll_to_orders(noll: int) -> tuple[int, int]:
    """Radial degree n and azimuthal order m of a Noll index; m < 0 for a sine.

    Raises:
        ValueError: The index is below 1.
    """
    if noll < 1:
        raise ValueError(f"Noll indices start at 1 (piston), got {noll}")
    n = int((sqrt(8 * noll - 7) - 1) / 2)
    position = noll - n * (n + 1) // 2  # 1 ... n + 1 within the degree
    m = 2 * (position // 2) if n % 2 == 0 else 2 * ((position - 1) // 2) + 1
    return n, m if noll % 2 == 0 else -m


def zernike(noll: int, x: ArrayLike, y: ArrayLike) -> Array:
    """One polynomial at (x, y) in pupil radii, not cut off outside the circle."""
    x = np.asarray(x, dtype=np.float64)
    y = np.asarray(y, dtype=np.float64)
    n, signed_m = noll_to_orders(noll)
    m = abs(signed_m)
    r2 = x**2 + y**2
    radial = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for k in range((n - m) // 2 + 1):  # Horner in r^2, from the highest power
        coefficient = factorial(n - k) // (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
        radial = radial * r2 + (-1) ** k * coefficient
    if m == 0:
        return sqrt(n + 1) * radial
    azimuthal = (x + 1j * y) ** m
    return sqrt(2 * (n + 1)) * radial * (azimuthal.real if signed_m > 0 else azimuthal.imag)


def zernikes(nolls: Sequence[int], x: ArrayLike, y: ArrayLike) -> Array:
    """Several polynomials, (modes, ...) for coordinates (...) in pupil radii."""
    return np.stack([zernike(noll, x, y) for noll in nolls])
