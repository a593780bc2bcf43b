"""Reference image and response matrix from frames with known pokes, and their errors.

Each cycle of pokes, or piece of a dither, yields one response: H = cov(frames, z) cov(seen, z)^-1, where `seen` is the
mirror's shape in each exposure and z the instrumental variable. In open loop both are the poke. In closed loop, `seen`
is the sum of the poke and the loop's command, which follows noise and disturbance; z is the poke alone, which does not,
so that the loop's reaction does not bias the response. The standard error comes from the scatter of the cycles.

R is built from a reconstructor R_a that is independent of these frames: R = (R_a H)^-1 R_a, see `regularised`.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Integers, Mask

MIN_CYCLES = 4
"""Least number of cycles whose scatter gives a useful standard error."""
MAX_ELEMENT_RMS = 1.2
"""Largest rms of the elements of R H - I of a good calibration, in units of 1 / snr."""
MAX_ELEMENT = 4.0
"""Largest element of R H - I of a good calibration, in units of 1 / snr."""
WORST_CONDITION = 1e3
"""Condition number of R H above which a reconstructor does not tell the modes apart."""
_WORST_INSTRUMENT = 1e6
"""Condition number of cov(seen, z) above which the pokes do not tell the modes apart."""
_OUTLIER_SIGMAS = 4.0
"""Standard deviations from the median to which outlying cycles are clipped."""
_MEDIAN_NOISE = 1.2
"""Ratio of the noise of the median of a few values to the noise of their mean."""
_NOISE_RATIO = 0.95
"""A later candidate is chosen if its noise is below this fraction of an earlier one's."""
_MEAN_SQUARE_ERRORS = 3.0
"""Standard errors by which the mean square of the elements may exceed its limit."""
_MAX_ELEMENT_ERRORS = 5.0
"""Standard errors by which the largest of some hundred elements may exceed its limit."""


class Cycle(NamedTuple):
    """Result of one cycle.

    Attributes:
        response: (pixels, modes) flux fractions per nm of wavefront.
        reference: (pixels,) flux fractions; None if all frames had a poke.
        flux_dn: mean flux of the frames, DN.
    """

    response: Array
    reference: Array | None
    flux_dn: float


class Initial(NamedTuple):
    """A reconstructor R_a that is independent of the calibration's frames: R is built from its rows.

    Attributes:
        matrix: (modes, pixels) nm per flux fraction; zero at bad pixels.
        estimator: how it was computed, as in `Calibration.estimator`.
    """

    matrix: Array
    estimator: str


class Sums(NamedTuple):
    """Sums over the cycles so far, from which another program may continue.

    Attributes:
        initial: R_a.
        answers: (cycles, modes, modes) R_a H of each cycle, without unit; files of release 0.1 have this name.
        response: (pixels, modes) sum of H.
        reference: (pixels,) sum of I0 over `references` cycles.
        references: number of cycles with frames without a poke.
        flux_dn: sum of the mean fluxes, DN.
    """

    initial: Initial
    answers: Array
    response: Array
    reference: Array
    references: int
    flux_dn: float

    @classmethod
    def none(cls, initial: Initial) -> "Sums":
        """Sums before the first cycle."""
        modes, pixels = initial.matrix.shape
        return cls(initial, np.zeros((0, modes, modes)), np.zeros((pixels, modes)), np.zeros(pixels), 0, 0.0)

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self.answers)

    def plus(self, cycle: Cycle) -> "Sums":
        """Sums with one more cycle."""
        return Sums(
            self.initial,
            np.concatenate([self.answers, (self.initial.matrix @ cycle.response)[None]]),
            self.response + cycle.response,
            self.reference + cycle.reference if cycle.reference is not None else self.reference,
            self.references + (cycle.reference is not None),
            self.flux_dn + cycle.flux_dn,
        )


class Measured(NamedTuple):
    """Result of all cycles.

    Attributes:
        response: (pixels, modes) H, flux fractions per nm of wavefront rms.
        initial: R_a, from which R is built.
        error: (modes,) standard error of the elements of each row of R H; infinite if unknown.
        reference: (pixels,) I0 in flux fractions; None if it was not measured.
        flux_dn: mean sum of the good pixels, DN.
        cycles: number of cycles.
    """

    response: Array
    initial: Initial
    error: Array
    reference: Array | None
    flux_dn: float
    cycles: int


def normalised(frames: npt.NDArray[np.number], dark: Array, good: Array) -> tuple[Array, Array]:
    """Frames (frames, pixels) minus the dark, each frame divided by its flux, and the fluxes (frames,) in DN.

    Raises:
        ValueError: a frame has no light.
    """
    light = np.asarray((frames - dark) * good, dtype=np.float64)
    flux = light.sum(axis=1)
    if not (flux > 0).all():
        raise ValueError("a frame has no light on the good pixels: is the star blocked, or the dark too bright?")
    light /= flux[:, None]
    return light, flux


def cycle_response(
    fractions: Array, flux_dn: Array, seen: Array, instruments: Array, used: Mask, slowest: float = 0.0
) -> Cycle:
    """Response from one cycle.

    Args:
        fractions: (frames, pixels), from `normalised`.
        flux_dn: (frames,) flux of each frame.
        seen: (frames, modes) modes of the mirror in each exposure, nm of wavefront.
        instruments: (frames, modes) instrumental variables: the poke alone in each exposure; `seen` in open loop.
        used: (frames,) whether a frame is usable.
        slowest: Frequency, cycles per frame, below which changes of the pokes are not used: most disturbance is there.

    Raises:
        ValueError: the pokes in the usable frames do not tell the modes apart.
    """
    x, z = seen[used], instruments[used]
    poked = z.any(axis=1)
    if not poked.any():
        raise ValueError("no frame with a poke is usable: all were lost or refused")
    y, x, z = fractions[used][poked], x[poked], z[poked]
    slow = _slow_changes(np.flatnonzero(used)[poked], len(used), slowest)
    z = z - slow @ (slow.T @ z)
    covariance = (x - x.mean(axis=0)).T @ z
    if not np.linalg.cond(covariance) < _WORST_INSTRUMENT:
        raise ValueError(
            f"the {len(z)} usable frames do not tell the {x.shape[1]} modes apart: too many frames were lost or refused"
        )
    response = np.linalg.solve(covariance.T, z.T @ y).T
    at_rest = fractions[used][~poked]
    reference = at_rest.mean(axis=0) if len(at_rest) else None
    return Cycle(response, reference, float(flux_dn[used].mean()))


def _slow_changes(times: Integers, frames: int, slowest: float) -> Array:
    """Orthonormal basis (times, functions) of slow changes in a piece: the mean, and all cosines below `slowest`."""
    orders = np.arange(1 + int(2 * frames * slowest))
    return np.linalg.qr(np.cos(np.pi * np.outer((times + 0.5) / frames, orders)))[0]


def fit_response(sums: Sums) -> Measured:
    """Response, standard error and reference from all cycles; ValueError if there is no cycle."""
    n = sums.cycles
    if n < 1:
        raise ValueError("no cycle was measured")
    response, clipped = sums.response / n, without_outliers(sums.answers)
    mean = sums.answers.mean(axis=0)
    if np.linalg.cond(mean) < WORST_CONDITION:
        response = response @ np.linalg.solve(mean, clipped.mean(axis=0))
    reference = sums.reference / sums.references if sums.references else None
    return Measured(response, sums.initial, row_error(clipped), reference, sums.flux_dn / n, n)


def without_outliers(products: Array) -> Array:
    """Products R_a H (cycles, modes, modes), without unit, with outliers clipped near the median.

    A transient of the wavefront then affects one cycle, not the mean.
    """
    median = np.median(products, axis=0)
    # 1.48: standard deviation / median absolute deviation; one scale per row, as the elements of a row have equal noise
    scale = 1.48 * np.median(np.abs(products - median), axis=(0, 2))[:, None]
    return np.clip(products, median - _OUTLIER_SIGMAS * scale, median + _OUTLIER_SIGMAS * scale)


def row_error(products: Array) -> Array:
    """Standard error (modes,) of the elements of each row of R H, for the R built from all cycles.

    It comes from the scatter of the cycles and so includes all disturbances: photon noise, read noise, vibration.

    Args:
        products: (cycles, modes, modes) R_a H of each cycle, without unit.

    Returns:
        Infinite for a single cycle, or if the pokes do not tell the modes apart.
    """
    n, modes, _ = products.shape
    mean = products.mean(axis=0)
    if n < 2 or not np.linalg.cond(mean) < WORST_CONDITION:
        return np.full(modes, np.inf)
    scatter = np.linalg.solve(mean, products - mean)
    return np.asarray(np.sqrt((scatter**2).sum(axis=0).mean(axis=1) / (n - 1) / n))


def best_initial(candidates: list[Initial], response: Array, mode: int, variance: Array) -> Initial:
    """The candidate with the least noise in a mode; a later one replaces it if below `_NOISE_RATIO` times its noise.

    The response (pixels,) to a poke of the mode is in flux fractions; `variance` (pixels,) is a frame's noise variance.
    """

    def noise(initial: Initial) -> float:
        row = initial.matrix[mode]
        seen = abs(float(row @ response))
        return float(np.sqrt(row**2 @ variance)) / seen if seen > 0 else np.inf

    best, *later = candidates
    for each in later:
        if noise(each) < _NOISE_RATIO * noise(best):
            best = each
    return best


def cross_talk(reconstructor: npt.NDArray[np.floating], response: npt.NDArray[np.floating]) -> Array:
    """Cross-talk R H - I (modes, modes), without unit, of R (modes, pixels) and H (pixels, modes)."""
    product = np.asarray(reconstructor, np.float64) @ np.asarray(response, np.float64)
    return np.asarray(product - np.eye(len(product)))


def correlation(response: npt.NDArray[np.floating], other: npt.NDArray[np.floating]) -> float:
    """Correlation of the responses (pixels,), any unit, to two pokes; negative if the responses have opposite signs."""
    norms = float(np.linalg.norm(response) * np.linalg.norm(other))
    return float(response @ other) / max(norms, 1e-300)


class Check(NamedTuple):
    """Check of R with frames that were not used for it.

    Attributes:
        rms: rms of the elements of R H - I, with the noise of these frames subtracted.
        largest: largest element of R H - I, with the noise of these frames included.
        error: (modes,) standard error of the elements of each row, from the noise of these frames.
        cycles: number of cycles.
    """

    rms: float
    largest: float
    error: Array
    cycles: int

    def within(self, rms: float, largest: float) -> bool:
        """Whether the cross-talk is below these limits, within the noise of these frames."""
        modes = len(self.error)
        mean_square_tolerance = _MEAN_SQUARE_ERRORS * float(np.sqrt(2 * (self.error**4).sum() / modes**3))
        return bool(self.rms**2 <= rms**2 + mean_square_tolerance and self.largest <= self.bound(largest))

    def bound(self, largest: float) -> float:
        """Largest element that these frames may show, with their noise, if no true element is above `largest`."""
        return largest + _MAX_ELEMENT_ERRORS * float(self.error.max())


def check(products: Array, expected: Array, error: Array) -> Check:
    """Cross-talk of a reconstructor, from cycles that were not used for it.

    Args:
        products: (cycles, modes, modes) R H of each cycle, without unit.
        expected: (modes, modes) R H without errors: the identity, unless combinations of modes are suppressed.
        error: (modes,) standard error of the elements of each row in one cycle.
    """
    talk = np.median(products, axis=0) - expected  # a transient of the wavefront affects only one cycle
    noise = _MEDIAN_NOISE * error / np.sqrt(len(products))
    power = float((talk**2).mean() - (noise**2).mean())
    return Check(float(np.sqrt(max(power, 0.0))), float(np.abs(talk).max()), noise, len(products))
