"""Probe sequences to measure the sensor's response: shapes, their order, and the frames to ignore.

Every pattern is pushed and pulled in the order + - - + - + + -, the first eight signs of the Thue-Morse sequence, which
are orthogonal to a drift that is constant, linear or quadratic in time.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import hadamard

from lowfc.arrays import Array, Mask

SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1], dtype=np.float64)
"""Signs of the pushes and pulls of one pattern."""


@dataclass(frozen=True, slots=True)
class Plan:
    """One cycle of pokes, or one piece of a dither.

    Attributes:
        table: (frames, columns) amplitudes of each frame's command, in the unit of its shapes: nm rms of wavefront for
            modes, nm of surface for single actuators.
        used: (frames,) whether an exposure that sees only this row may be used.
        per_column: number of used frames in which a column is poked; if columns differ, the least number.
    """

    table: Array
    used: Mask
    per_column: int

    def __len__(self) -> int:
        return len(self.table)


def poke_patterns(columns: int, amplitude: float) -> Array:
    """Patterns (columns, columns): one mode, or one actuator, after the other."""
    return amplitude * np.eye(columns)


def hadamard_patterns(columns: int, amplitude: float) -> Array:
    """Patterns (patterns, columns) of all modes at once, each with signs that are orthogonal to those of the others."""
    order = 1 << max(columns - 1, 0).bit_length()
    return amplitude * np.asarray(hadamard(order), dtype=np.float64)[:, :columns]


def cycle(patterns: Array, hold: int, settle: int, rest: int, *, backwards: bool = False) -> Plan:
    """Rest frames, then every pattern pushed and pulled.

    Args:
        patterns: (patterns, columns), from `poke_patterns` or `hadamard_patterns`.
        hold: Used frames of each push or pull.
        settle: Ignored frames after each change, in which the mirror moves or a fractional delay mixes two rows.
        rest: Used frames without a poke, for the reference image.
        backwards: Reverse the order of the patterns; with every other cycle backwards, slow drifts average out.

    Raises:
        ValueError: `hold` is below 1, or `settle` or `rest` below 0.
    """
    if hold < 1 or settle < 0 or rest < 0:
        raise ValueError(f"hold must be 1 frame or more, settle and rest 0 or more; got {hold}, {settle} and {rest}")
    order = np.arange(len(patterns))[:: -1 if backwards else 1]
    states = (patterns[order, None, :] * SIGNS[:, None]).reshape(-1, patterns.shape[1])
    resting = rest + settle if rest else 0
    table = np.vstack([np.zeros((resting, patterns.shape[1])), np.repeat(states, hold + settle, axis=0)])
    poked = np.tile(np.arange(hold + settle) >= settle, len(states))
    used = np.concatenate([np.arange(resting) >= settle, poked])
    per_column = int(np.count_nonzero(table[used], axis=0).min())
    return Plan(table, used, per_column)


def dither(columns: int, amplitude: float, frames: int, hold: int, seed: int) -> Plan:
    """Pseudo-random pushes and pulls of all modes at once, to be played in a closed loop.

    Columns are modes, the amplitude is in nm rms of wavefront, and signs may change every `hold` frames: with a hold of
    1, the loop corrects the smallest part of the pokes. Each piece has its own seed.
    """
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([seed, 7])))
    states = rng.integers(0, 2, (-(-frames // hold), columns)) * 2.0 - 1.0
    table = amplitude * np.repeat(states, hold, axis=0)[:frames]
    return Plan(table, np.ones(frames, np.bool_), frames)


def frames_for_snr(snr: float, noise_nm: float, amplitude_nm: float) -> int:
    """Number of frames with pokes of this amplitude that determine R H to 1 / snr, for this noise per frame."""
    return int(np.ceil((snr * noise_nm / amplitude_nm) ** 2))


def seen_rows(table: Array, weights: Array, sequence: npt.NDArray[np.integer], commanded: Mask) -> Array:
    """Rows of a table (frames, columns) that exposures saw.

    Args:
        table: A row for each frame from the first one of the sequence; before and after it, zeros.
        weights: (lags,) fraction of an exposure during which it sees the row 0, 1, ... frames before its own; sum 1.
        sequence: (exposures,) frame numbers, ascending; 0 is the frame whose command had the first row.
        commanded: (exposures,) whether the frame led to a command; if not, or if the frame is missing, the mirror kept
            the previous row.

    Returns:
        (exposures, columns).
    """
    first = int(sequence[0]) - len(weights)
    frames = np.arange(first, int(sequence[-1]) + 1)
    row = np.where((frames >= 0) & (frames < len(table)), frames, len(table))  # the padded table ends with zeros
    applied = np.zeros(row.size, np.bool_)
    applied[sequence[commanded] - first] = True
    applied[: len(weights)] = True  # earlier commands are assumed to have been applied
    newest = np.maximum.accumulate(np.where(applied, np.arange(row.size), 0))
    padded = np.vstack([table, np.zeros((1, table.shape[1]))])
    in_force = padded[row[newest]]
    at = sequence - first
    return np.asarray(sum(weight * in_force[at - lag] for lag, weight in enumerate(weights)))


def usable_exposures(plan: Plan, sequence: npt.NDArray[np.integer], commanded: Mask, lag: int) -> Mask:
    """Whether each exposure (exposures,) sees a usable row, with a command from each frame that acts on it.

    Args:
        plan: The plan that was played.
        sequence: (exposures,) frame numbers, ascending; 0 is the frame whose command had the first row.
        commanded: (exposures,) whether the frame led to a command.
        lag: Whole frames from a row's frame to the exposure that sees it.
    """
    place = sequence - lag
    within = (place >= 0) & (place < len(plan))
    sent = set(sequence[commanded].tolist())
    complete = [all(n in sent or n < 0 for n in range(at - lag - 1, at + 1)) for at in sequence.tolist()]
    used = plan.used[np.clip(place, 0, len(plan) - 1)]
    return np.asarray(within & used & np.array(complete, dtype=np.bool_), dtype=np.bool_)
