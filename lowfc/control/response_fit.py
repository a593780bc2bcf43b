"""Reference image and response matrix from frames under known pokes, and what they are worth.

Each cycle of pokes, or piece of a dither, gives a response of its own: H = cov(frames, z) cov(seen, z)^-1, where `seen`
is what the mirror did in each exposure and z the instrument. Open loop both are the poke. With the loop closed, `seen`
is the poke and the loop's own command, which follows noise and disturbance; z is the poke alone, which does not, so
that the loop's reaction does not bias the response. The scatter of the cycles is the standard error.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_WORST_INSTRUMENT = 1e6
"""Condition number of cov(seen, z) above which the pokes do not tell the modes apart."""


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


class Sums(NamedTuple):
    """Of the cycles so far; another program may go on from them.

    Attributes:
        cycles: how many.
        response: (pixels, modes) sum.
        squares: (pixels, modes) sum of the squares.
        reference: (pixels,) sum over `references` cycles.
        flux_dn: sum.
    """

    cycles: int
    response: Array
    squares: Array
    reference: Array
    references: int
    flux_dn: float

    @classmethod
    def none(cls, pixels: int, modes: int) -> "Sums":
        """Of no cycle."""
        return cls(0, np.zeros((pixels, modes)), np.zeros((pixels, modes)), np.zeros(pixels), 0, 0.0)

    def plus(self, cycle: Cycle) -> "Sums":
        """With one cycle more."""
        rested = cycle.reference is not None
        return Sums(
            self.cycles + 1,
            self.response + cycle.response,
            self.squares + cycle.response**2,
            self.reference + cycle.reference if cycle.reference is not None else self.reference,
            self.references + rested,
            self.flux_dn + cycle.flux_dn,
        )


class Measured(NamedTuple):
    """What the cycles say.

    Attributes:
        response: (pixels, modes) H, flux fractions per nm of wavefront rms.
        error: (pixels, modes) its standard error; None from a single cycle.
        reference: (pixels,) I0 in flux fractions; None where it was not measured.
        flux_dn: mean sum of the good pixels.
        cycles: how many.
    """

    response: Array
    error: Array | None
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


def cycle_response(fractions: Array, flux_dn: Array, seen: Array, instruments: Array, used: Array) -> Cycle:
    """The response that one cycle shows.

    Args:
        fractions: (frames, pixels), from `normalised`.
        flux_dn: (frames,).
        seen: (frames, modes) what the mirror did in each exposure, nm of wavefront.
        instruments: (frames, modes) the poke alone in each exposure; `seen` itself where the loop is open.
        used: (frames,) 1 where a frame may be used, else 0.

    Raises:
        ValueError: the pokes in the frames that may be used do not tell the modes apart.
    """
    kept = used > 0
    x, z = seen[kept], instruments[kept]
    poked = z.any(axis=1)
    if not poked.any():
        raise ValueError("no frame with a poke may be used: frames were lost or refused throughout")
    y, x, z = fractions[kept][poked], x[poked], z[poked]
    z = z - z.mean(axis=0)
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


def measured(sums: Sums) -> Measured:
    """Response, standard error and reference of all cycles.

    Raises:
        ValueError: there is no cycle.
    """
    n = sums.cycles
    if n < 1:
        raise ValueError("no cycle was measured")
    response, error = sums.response / n, None
    if n > 1:
        spread = np.maximum(sums.squares / n - response**2, 0) * (n / (n - 1))
        error = np.sqrt(spread / n)
    reference = sums.reference / sums.references if sums.references else None
    return Measured(response, error, reference, sums.flux_dn / n, n)


def cross_talk(reconstructor: npt.NDArray[np.floating], response: npt.NDArray[np.floating]) -> Array:
    """R H - I (modes, modes): how a reconstructor answers to another's response matrix."""
    product = np.asarray(reconstructor, np.float64) @ np.asarray(response, np.float64)
    return np.asarray(product - np.eye(len(product)))


def cross_talk_error(reconstructor: Array, error: Array) -> Array:
    """Standard error (modes, modes) of R H - I, from that of a measured H, (pixels, modes), behind R (modes, pixels).

    The errors of a column's pixels are taken as independent, as photon and read noise are.
    """
    return np.asarray(np.sqrt(reconstructor**2 @ error**2))


class LinearRange(NamedTuple):
    """How far the sensor is linear.

    Attributes:
        amplitude_nm: (amplitudes, modes) poked, rising, nm rms of wavefront.
        gain: (amplitudes, modes) what R made of each, over what it was.
        range_nm: (modes,) amplitude up to which the gain stays within the tolerance of 1; the largest poked where it
            does throughout, 0 where the smallest is off.
    """

    amplitude_nm: Array
    gain: Array
    range_nm: Array


def linear_range(modes_nm: Array, poked_nm: Array, block: npt.NDArray[np.intp], tolerance: float = 0.1) -> LinearRange:
    """How far the sensor is linear, from frames under pushes and pulls as `poke_plan.ladder` orders them.

    Args:
        modes_nm: (frames, modes) R (I - I0).
        poked_nm: (frames, modes) the poke in each, zero but for one mode.
        block: (frames,) which pair of push and pull it belongs to.
        tolerance: Deviation of the gain from 1 that still counts as linear.

    Raises:
        ValueError: a mode was not poked both ways.
    """
    found: list[dict[float, float]] = [{} for _ in range(modes_nm.shape[1])]
    for pair in np.unique(block):
        poke, answer = poked_nm[block == pair], modes_nm[block == pair]
        mode = int(np.abs(poke).max(axis=0).argmax())
        along = poke[:, mode]
        if (along > 0).any() and (along < 0).any():
            apart = answer[along > 0, mode].mean() - answer[along < 0, mode].mean()
            amplitude = float(np.abs(along).max())
            found[mode][amplitude] = apart / (2 * amplitude)
    levels = min(map(len, found))
    if not levels:
        raise ValueError("the linear range needs every mode pushed and pulled: frames were lost or refused")
    amplitudes = np.array([sorted(each)[:levels] for each in found]).T
    gain = np.array([[each[a] for a in sorted(each)[:levels]] for each in found]).T
    ranges = np.empty(len(found))
    for mode in range(len(found)):
        off = np.append(np.abs(gain[:, mode] - 1), np.inf) > tolerance
        first = int(off.argmax())
        ranges[mode] = amplitudes[first - 1, mode] if first else 0.0
        if 0 < first < levels:
            before, after = np.abs(gain[first - 1 : first + 1, mode] - 1)
            part = (tolerance - before) / (after - before)
            ranges[mode] += part * (amplitudes[first, mode] - amplitudes[first - 1, mode])
    return LinearRange(amplitudes, gain, ranges)
