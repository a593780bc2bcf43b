"""Any control law as one linear system for all modes: PI, notches and Kalman filters are instances."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from lowfc.arrays import Array, Single, single
from lowfc.control.identity import identity
from lowfc.control.laws.stability import delay_weights

Signal = Literal["error", "pol"]

_LARGEST_POLE = 0.99
"""Largest pole of an integrator of POL modes in an open loop while frames are missing; below 1, for stability."""
MAX_STATES = 512
"""Largest number of states of a law; with it a step takes about 50 us."""
SIGNALS: tuple[Signal, ...] = ("error", "pol")


@dataclass(frozen=True, slots=True, eq=False)
class LinearLaw:
    """x[k] = F x[k-1] + G y[k] + U c[k-1], command[k] = K x[k]; single precision, as in the loop.

    y[k] is the error or the pseudo-open-loop modes of frame k, c the modal command after all limits. For a
    missing or refused frame, x[k] = A x[k-1] + U c[k-1].

    Attributes:
        signal: kind of y: error or pol.
        transition: (states, states) F.
        measurement_gain: (states, modes) G.
        command_gain: (states, modes) U.
        predict_only: (states, states) A.
        output: (modes, states) K.
        name: kind of the law, as displayed.
        noll: Noll index of each mode.
        delay_frames: delay for which it was made, as in `lowfc.control.laws.stability.delay_weights`.
        rate_hz: frame rate for which it was made.
        id: identity of the law.
        joined: (states, states + 2 modes) F, G and U side by side.
    """

    signal: Signal
    transition: Single
    measurement_gain: Single
    command_gain: Single
    predict_only: Single
    output: Single
    name: str
    noll: tuple[int, ...]
    delay_frames: float
    rate_hz: float
    id: str = field(init=False)
    joined: Single = field(init=False)

    def __post_init__(self) -> None:
        if self.signal not in SIGNALS:
            raise ValueError(f"the signal of a law must be one of {', '.join(SIGNALS)}, got {self.signal!r}")
        states, modes = self.transition.shape[0], len(self.noll)
        for name, shape in matrix_shapes(states, modes).items():
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            if array.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds values that are not finite")
            object.__setattr__(self, name, array)
        if not (states and modes) or states > MAX_STATES:
            raise ValueError(f"a law must have modes, and 1 to {MAX_STATES} states; got {modes} and {states}")
        delay_weights(self.delay_frames)  # raises for a wrong delay
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise ValueError(f"rate_hz must be above 0, got {self.rate_hz}")
        object.__setattr__(self, "joined", np.hstack([self.transition, self.measurement_gain, self.command_gain]))
        object.__setattr__(self, "id", identity((hashed, getattr(self, name)) for hashed, name in _IDENTITY))


def matrix_shapes(states: int, modes: int) -> dict[str, tuple[int, int]]:
    """Shape of each matrix of a law, by its name."""
    square, in_, out = (states, states), (states, modes), (modes, states)
    return {"transition": square, "measurement_gain": in_, "command_gain": in_, "predict_only": square, "output": out}


# The hashed names are those of release 0.1, so that laws keep their identities.
_IDENTITY = (
    ("signal", "signal"),
    ("follow", "transition"),
    ("gain", "measurement_gain"),
    ("kept", "command_gain"),
    ("coast", "predict_only"),
    *((name, name) for name in ("output", "name", "noll", "delay_frames", "rate_hz")),
)


def at_rest(law: LinearLaw) -> Single:
    """The state x (states,) before the first frame."""
    return np.zeros(len(law.transition), np.float32)


def predict_and_update(law: LinearLaw, x: Single, y: Single, command_nm: Single) -> Single:
    """The state (states,) after a frame, from its y (modes,), nm, and the last command after limits (modes,)."""
    after: Single = law.transition.dot(x)  # takes half a microsecond less than `@`
    after += law.measurement_gain.dot(y)
    after += law.command_gain.dot(command_nm)
    return after


def predict(law: LinearLaw, x: Single, command_nm: Single) -> Single:
    """The state (states,) after a missing or refused frame, from the last command after limits (modes,)."""
    after: Single = law.predict_only.dot(x)
    after += law.command_gain.dot(command_nm)
    return after


def respond(law: LinearLaw, x: Single) -> Single:
    """The command of the law (modes,), nm of wavefront rms, before any limit."""
    command_nm: Single = law.output.dot(x)
    return command_nm


class Block(NamedTuple):
    """The part of a law for one mode, which has s states: F (s, s), G (s,), U (s,), A (s, s), K (s,)."""

    transition: Array
    measurement_gain: Array
    command_gain: Array
    predict_only: Array
    output: Array


def law_from_blocks(
    blocks: Sequence[Block], signal: Signal, name: str, noll: tuple[int, ...], delay_frames: float, rate_hz: float
) -> LinearLaw:
    """Make a law from one block for each mode.

    Raises:
        ValueError: the numbers of blocks and modes differ, or the matrices of a block do not match.
    """
    if len(blocks) != len(noll):
        raise ValueError(f"a law of {len(noll)} modes needs as many blocks, got {len(blocks)}")
    ends = np.cumsum([len(block.output) for block in blocks])
    states = int(ends[-1])
    F, A = np.zeros((states, states)), np.zeros((states, states))
    G, U = np.zeros((states, len(noll))), np.zeros((states, len(noll)))
    K = np.zeros((len(noll), states))
    for mode, (block, end) in enumerate(zip(blocks, ends.tolist(), strict=True)):
        own = slice(end - len(block.output), end)
        F[own, own], A[own, own] = block.transition, block.predict_only
        G[own, mode], U[own, mode], K[mode, own] = block.measurement_gain, block.command_gain, block.output
    return LinearLaw(signal, single(F), single(G), single(U), single(A), single(K), name, noll, delay_frames, rate_hz)


def integrator_block(gain: float, leak: float, signal: Signal, delay_frames: float) -> Block:
    """The integrator c[k] = (1 - leak) c[k-1] - gain e[k], from the error or from pseudo-open-loop modes.

    With signal pol, e[k] = pol[k] + sum_j w_j c[k-1-j], for which the block stores commands. During missing frames pol
    is predicted to cancel the stored commands, so that the command keeps its value, apart from the leak. Above a gain
    of 0.99 / w_0 this prediction would be unstable in an open loop, so it is damped: the command then undoes part of
    its last change, at most a quarter at gains that keep the margins.
    """
    if signal == "error":
        return Block(np.zeros((1, 1)), np.array([-gain]), np.array([1 - leak]), np.zeros((1, 1)), np.ones(1))
    weights = delay_weights(delay_frames)
    registers = len(weights)  # x = pol[k], c[k-1], c[k-2], ...
    F = np.diag(np.ones(registers), -1)
    F[1, 0] = 0.0
    G, U = np.zeros(1 + registers), np.zeros(1 + registers)
    G[0] = U[1] = 1.0
    K = np.concatenate([[-gain], -gain * weights])
    K[1] += 1 - leak
    A = F.copy()
    A[0, 1:-1] = -weights[1:]
    share = min(1.0, _LARGEST_POLE / max(gain * weights[0], _LARGEST_POLE))
    A[0] -= weights[0] * (share * K + (1 - share) * np.eye(1 + registers)[1])
    return Block(F, G, U, A, K)


def integrator(
    gain: Iterable[float], leak: Iterable[float], noll: tuple[int, ...], delay_frames: float, rate_hz: float
) -> LinearLaw:
    """The loop's integrator, with gain and leak (modes,), as a linear law of the error, without its limits.

    Raises:
        ValueError: their lengths differ from the number of modes.
    """
    modes = zip(gain, leak, strict=True)
    blocks = [integrator_block(float(g), float(mode_leak), "error", delay_frames) for g, mode_leak in modes]
    return law_from_blocks(blocks, "error", "integrator", noll, delay_frames, rate_hz)
