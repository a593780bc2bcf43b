"""Reference image and response matrix from frames under known pokes, and what they are worth.

Each cycle of pokes, or piece of a dither, gives a response of its own: H = cov(frames, z) cov(seen, z)^-1, where `seen`
is what the mirror did in each exposure and z the instrument. Open loop both are the poke. With the loop closed, `seen`
is the poke and the loop's own command, which follows noise and disturbance; z is the poke alone, which does not, so
that the loop's reaction does not bias the response. The scatter of the cycles is the standard error.

R is built from a reconstructor R_a that does not know these frames: R = (R_a H)^-1 R_a, see `regularised`.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Whole

LEAST_CYCLES = 4
"""So that their scatter says something."""
MOST_RMS = 1.2
"""Rms of the elements of R H - I, in units of 1 / snr, that a calibration promises."""
MOST_LARGEST = 4.0
"""The largest of them."""
WORST_ANSWER = 1e3
"""Condition number of R H above which a reconstructor does not tell the modes apart."""
_WORST_INSTRUMENT = 1e6
"""Condition number of cov(seen, z) above which the pokes do not tell the modes apart."""
_OUTLIER = 4.0
"""Standard deviations from the median within which a cycle counts as it is."""
_OF_A_MEDIAN = 1.2
"""Noise of the median of a few values over that of their mean."""
_BETTER = 0.95
"""Times the noise of an earlier candidate below which a later one is taken."""
_SURE = 3.0
"""Standard errors that the square of their rms may be off by."""
_FAR = 5.0
"""Standard errors that the largest of some hundred elements may be off by."""


class Cycle(NamedTuple):
    """What one cycle shows.

    Attributes:
        response: (pixels, modes) flux fractions per nm of wavefront.
        reference: (pixels,) flux fractions; None where no frame was without a poke.
        flux_dn: mean of the frames.
    """

    response: Array
    reference: Array | None
    flux_dn: float


class Initial(NamedTuple):
    """A reconstructor made without the frames of the calibration: the measured one is built from its rows.

    Attributes:
        matrix: (modes, pixels) nm per flux fraction; zero at bad pixels.
        estimator: how it was made, as in `Calibration.estimator`.
    """

    matrix: Array
    estimator: str


class Sums(NamedTuple):
    """Of the cycles so far; another program may go on from them.

    Attributes:
        initial: the reconstructor that the answers are of.
        answers: (cycles, modes, modes) what it makes of the response of each cycle.
        response: (pixels, modes) sum.
        reference: (pixels,) sum over `references` cycles.
        references: cycles with frames without a poke.
        flux_dn: sum.
    """

    initial: Initial
    answers: Array
    response: Array
    reference: Array
    references: int
    flux_dn: float

    @classmethod
    def none(cls, initial: Initial) -> "Sums":
        """Of no cycle."""
        modes, pixels = initial.matrix.shape
        return cls(initial, np.zeros((0, modes, modes)), np.zeros((pixels, modes)), np.zeros(pixels), 0, 0.0)

    @property
    def cycles(self) -> int:
        """How many."""
        return len(self.answers)

    def plus(self, cycle: Cycle) -> "Sums":
        """With one cycle more."""
        rested = cycle.reference is not None
        return Sums(
            self.initial,
            np.concatenate([self.answers, (self.initial.matrix @ cycle.response)[None]]),
            self.response + cycle.response,
            self.reference + cycle.reference if cycle.reference is not None else self.reference,
            self.references + rested,
            self.flux_dn + cycle.flux_dn,
        )


class Measured(NamedTuple):
    """What the cycles say.

    Attributes:
        response: (pixels, modes) H, flux fractions per nm of wavefront rms.
        initial: the reconstructor that R is built from.
        error: (modes,) standard error of the elements of each row of R H; infinite where it is not known.
        reference: (pixels,) I0 in flux fractions; None where it was not measured.
        flux_dn: mean sum of the good pixels.
        cycles: how many.
    """

    response: Array
    initial: Initial
    error: Array
    reference: Array | None
    flux_dn: float
    cycles: int


def normalised(frames: npt.NDArray[np.number], dark: Array, good: Array) -> tuple[Array, Array]:
    """Frames (frames, pixels) less the dark, each over its own flux, and the fluxes (frames,) in DN.

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
    fractions: Array, flux_dn: Array, seen: Array, instruments: Array, used: Array, slowest: float = 0.0
) -> Cycle:
    """The response that one cycle shows.

    Args:
        fractions: (frames, pixels), from `normalised`.
        flux_dn: (frames,).
        seen: (frames, modes) what the mirror did in each exposure, nm of wavefront.
        instruments: (frames, modes) the poke alone in each exposure; `seen` itself where the loop is open.
        used: (frames,) 1 where a frame may be used, else 0.
        slowest: What the pokes have below this frequency, in cycles per frame, is not used: there the wavefront moves
            most.

    Raises:
        ValueError: the pokes in the frames that may be used do not tell the modes apart.
    """
    kept = used > 0
    x, z = seen[kept], instruments[kept]
    poked = z.any(axis=1)
    if not poked.any():
        raise ValueError("no frame with a poke may be used: frames were lost or refused throughout")
    y, x, z = fractions[kept][poked], x[poked], z[poked]
    slow = _slow(np.flatnonzero(kept)[poked], len(used), slowest)
    z = z - slow @ (slow.T @ z)
    together = (x - x.mean(axis=0)).T @ z
    if not np.linalg.cond(together) < _WORST_INSTRUMENT:
        raise ValueError(
            f"the {len(z)} frames that may be used do not tell the {x.shape[1]} modes apart: too many frames were "
            "lost or refused"
        )
    response = np.linalg.solve(together.T, z.T @ y).T
    at_rest = fractions[kept][~poked]
    reference = at_rest.mean(axis=0) if len(at_rest) else None
    return Cycle(response, reference, float(flux_dn[kept].mean()))


def _slow(times: Whole, frames: int, slowest: float) -> Array:
    """Orthonormal (times, any): the mean, and all cosines of a piece of so many frames below a frequency."""
    orders = np.arange(1 + int(2 * frames * slowest))
    return np.linalg.qr(np.cos(np.pi * np.outer((times + 0.5) / frames, orders)))[0]


def measured(sums: Sums) -> Measured:
    """Response, standard error and reference of all cycles.

    Raises:
        ValueError: there is no cycle.
    """
    n = sums.cycles
    if n < 1:
        raise ValueError("no cycle was measured")
    response, kept = sums.response / n, without_outliers(sums.answers)
    mean = sums.answers.mean(axis=0)
    if np.linalg.cond(mean) < WORST_ANSWER:
        response = response @ np.linalg.solve(mean, kept.mean(axis=0))
    reference = sums.reference / sums.references if sums.references else None
    return Measured(response, sums.initial, row_error(kept), reference, sums.flux_dn / n, n)


def without_outliers(answers: Array) -> Array:
    """Answers (cycles, modes, modes), without unit, kept near their median.

    A jolt of the wavefront spoils one cycle, not the mean.
    """
    median = np.median(answers, axis=0)
    # 1.48: from the median deviation to the standard deviation; of a row, for all its elements have the same noise
    scale = 1.48 * np.median(np.abs(answers - median), axis=(0, 2))[:, None]
    return np.clip(answers, median - _OUTLIER * scale, median + _OUTLIER * scale)


def row_error(answers: Array) -> Array:
    """Standard error (modes,) of the elements of each row of R H, for the R built from all cycles.

    It comes from the scatter of the cycles, so that whatever disturbed them is in it: photons, read-out, vibration.

    Args:
        answers: (cycles, modes, modes) what a reconstructor makes of the response of each cycle, without unit.

    Returns:
        Infinite from a single cycle, or where the pokes do not tell the modes apart.
    """
    n, modes, _ = answers.shape
    mean = answers.mean(axis=0)
    if n < 2 or not np.linalg.cond(mean) < WORST_ANSWER:
        return np.full(modes, np.inf)
    scatter = np.linalg.solve(mean, answers - mean)
    return np.asarray(np.sqrt((scatter**2).sum(axis=0).mean(axis=1) / (n - 1) / n))


def initial_of(candidates: list[Initial], picture: Array, mode: int, variance: Array) -> Initial:
    """The reconstructor that sees a poke best; an earlier one unless a later is better by more than `_BETTER`.

    The picture (pixels,) is the answer to a poke of the mode, in flux fractions; the variance (pixels,) a frame's.
    """

    def noise(initial: Initial) -> float:
        row = initial.matrix[mode]
        seen = abs(float(row @ picture))
        return float(np.sqrt(row**2 @ variance)) / seen if seen > 0 else np.inf

    best, *later = candidates
    for each in later:
        if noise(each) < _BETTER * noise(best):
            best = each
    return best


def cross_talk(reconstructor: npt.NDArray[np.floating], response: npt.NDArray[np.floating]) -> Array:
    """R H - I (modes, modes): how a reconstructor answers to another's response matrix."""
    product = np.asarray(reconstructor, np.float64) @ np.asarray(response, np.float64)
    return np.asarray(product - np.eye(len(product)))


def likeness(picture: npt.NDArray[np.floating], other: npt.NDArray[np.floating]) -> float:
    """Correlation of the images of two pokes (pixels,): negative where their signs are opposite."""
    norms = float(np.linalg.norm(picture) * np.linalg.norm(other))
    return float(picture @ other) / max(norms, 1e-300)


class Check(NamedTuple):
    """R against frames that were not used for it.

    Attributes:
        rms: of the elements of R H - I, less what the noise of these frames adds.
        largest: of the elements of R H - I, with that noise.
        error: (modes,) standard error that the noise of these frames gives the elements of each row.
        cycles: how many.
    """

    rms: float
    largest: float
    error: Array
    cycles: int

    def within(self, rms: float, largest: float) -> bool:
        """Whether the cross-talk is below this, as far as the noise of these frames lets them tell."""
        modes = len(self.error)
        unsure = _SURE * float(np.sqrt(2 * (self.error**4).sum() / modes**3))  # of the square of the rms
        return bool(self.rms**2 <= rms**2 + unsure and self.largest <= self.bound(largest))

    def bound(self, largest: float) -> float:
        """Largest element that these frames may show where none is above `largest`: their noise comes on top."""
        return largest + _FAR * float(self.error.max())


def check(answers: Array, wanted: Array, error: Array) -> Check:
    """Cross-talk of a reconstructor, from cycles that were not used for it.

    Args:
        answers: (cycles, modes, modes) what it makes of the response of each, without unit.
        wanted: (modes, modes) what it shall make of a response: one, unless combinations of modes are suppressed.
        error: (modes,) standard error of the elements of each row in one cycle.
    """
    talk = np.median(answers, axis=0) - wanted  # as a jolt of the wavefront spoils one cycle only
    noise = _OF_A_MEDIAN * error / np.sqrt(len(answers))
    power = float((talk**2).mean() - (noise**2).mean())
    return Check(float(np.sqrt(max(power, 0.0))), float(np.abs(talk).max()), noise, len(answers))
