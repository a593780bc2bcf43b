"""What to play on the mirror so that the sensor's response can be measured: shapes, their order, frames to leave out.

Every pattern is pushed and pulled in the order + - - + - + + -, the signs of the Thue-Morse sequence, whose eight are
orthogonal to a drift that is constant, linear or quadratic in time.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import hadamard

from lowfc.arrays import Array, Mask

SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1], dtype=np.float64)
"""Of the pushes and pulls of one pattern."""


@dataclass(frozen=True, slots=True)
class Plan:
    """One cycle of pokes, or one piece of a dither.

    Attributes:
        table: (frames, columns) amplitudes of each frame's command, in the unit of its shapes: nm rms of wavefront for
            modes, nm of surface for single actuators.
        used: (frames,) whether the exposure that sees this row, and nothing else, may be used.
        per_column: frames of the cycle that measure each column.
    """

    table: Array
    used: Mask
    per_column: int

    def __len__(self) -> int:
        return len(self.table)


def poke_patterns(columns: int, amplitude: float) -> Array:
    """(columns, columns): one mode, or one actuator, after the other."""
    return amplitude * np.eye(columns)


def hadamard_patterns(columns: int, amplitude: float) -> Array:
    """(patterns, columns): all modes at once, each with signs that are orthogonal to those of all others."""
    order = 1 << max(columns - 1, 0).bit_length()
    return amplitude * np.asarray(hadamard(order), dtype=np.float64)[:, :columns]


def cycle(patterns: Array, hold: int, settle: int, rest: int, *, backwards: bool = False) -> Plan:
    """Rest, then every pattern pushed and pulled.

    Args:
        patterns: (patterns, columns), from `poke_patterns` or `hadamard_patterns`.
        hold: Frames of each push or pull that are used.
        settle: Frames after each change that are left out: where the delay is a fraction, and the mirror is moving.
        rest: Frames without a poke that are used, for the reference image.
        backwards: Take the patterns in the opposite order; every other cycle, so that what wanders more slowly than a
            pattern averages out between them, too.

    Raises:
        ValueError: no frame would be used.
    """
    if hold < 1 or settle < 0 or rest < 0:
        raise ValueError(f"a poke is held for 1 frame or more, after none or more; got {hold}, {settle} and {rest}")
    order = np.arange(len(patterns))[:: -1 if backwards else 1]
    states = (patterns[order, None, :] * SIGNS[:, None]).reshape(-1, patterns.shape[1])
    resting = rest + settle if rest else 0
    table = np.vstack([np.zeros((resting, patterns.shape[1])), np.repeat(states, hold + settle, axis=0)])
    poked = np.tile(np.arange(hold + settle) >= settle, len(states))
    used = np.concatenate([np.arange(resting) >= settle, poked])
    per_column = int(np.count_nonzero(table[used], axis=0).min())
    return Plan(table, used, per_column)


def dither(columns: int, amplitude: float, frames: int, hold: int, seed: int) -> Plan:
    """Pseudo-random pushes and pulls of all modes at once, to be played with the loop closed.

    Columns are modes, the amplitude is in nm rms of wavefront, and signs change every `hold` frames: 1 is quickest, and
    least answered by the loop. Each piece has a seed of its own.
    """
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([seed, 7])))
    states = rng.integers(0, 2, (-(-frames // hold), columns)) * 2.0 - 1.0
    table = amplitude * np.repeat(states, hold, axis=0)[:frames]
    return Plan(table, np.ones(frames, np.bool_), frames)


def frames_for(snr: float, noise_nm: float, amplitude_nm: float) -> int:
    """Frames of pokes of this amplitude after which R knows a mode of this noise in one frame to 1 / snr."""
    return int(np.ceil((snr * noise_nm / amplitude_nm) ** 2))


def seen(table: Array, weights: Array, sequence: npt.NDArray[np.integer], commanded: Mask) -> Array:
    """What of a table (frames, columns) each exposure saw.

    Args:
        table: A row for each frame from the play's first on; before and after it, zeros.
        weights: (lags,) part of the row of `lag` frames before that an exposure sees; sums to 1.
        sequence: (exposures,) rising, counted from the frame whose command was the first to have a row.
        commanded: (exposures,) whether a command was made of the frame; where not, or where the frame is missing, the
            mirror kept the row before.

    Returns:
        (exposures, columns).
    """
    lags = len(weights) - 1
    first = min(int(sequence[0]), 0) - lags
    last = max(int(sequence[-1]), 0)
    row = np.full(last - first + 1, -1)  # place in the padded table, whose last row is zeros
    obeyed = np.zeros(row.size, np.bool_)
    obeyed[sequence[commanded] - first] = True
    obeyed[: max(int(sequence[0]) - first, 0)] = True  # what was before is not known to have gone wrong
    places = np.arange(first, last + 1)
    row = np.where((places >= 0) & (places < len(table)), places, len(table))
    newest = np.maximum.accumulate(np.where(obeyed, np.arange(row.size), 0))
    padded = np.vstack([table, np.zeros((1, table.shape[1]))])
    in_force = padded[row[newest]]
    at = sequence - first
    return np.asarray(sum(weight * in_force[at - lag] for lag, weight in enumerate(weights)))


def usable(plan: Plan, sequence: npt.NDArray[np.integer], commanded: Mask, lag: int) -> Mask:
    """(exposures,) whether an exposure sees a row that may be used, and every command that it sees was made.

    Args:
        plan: What was played.
        sequence: (exposures,) rising, counted from the first frame whose command had a row.
        commanded: (exposures,) whether a command was made of the frame.
        lag: Whole frames from a row's frame to the exposure that sees it.
    """
    place = sequence - lag
    within = (place >= 0) & (place < len(plan))
    made = set(sequence[commanded].tolist())
    whole = [all(n in made or n < 0 for n in range(at - lag - 1, at + 1)) for at in sequence.tolist()]
    seen_whole = plan.used[np.clip(place, 0, len(plan) - 1)] & np.array(whole, dtype=np.bool_)
    return np.asarray(within & seen_whole, dtype=np.bool_)
