"""PI laws, leaky or not, with notches in their rejection: each notch is a resonator that removes one line."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, solve_discrete_are

from lowfc.arrays import Array
from lowfc.control.laws.linear_law import Block, LinearLaw, law_from_blocks
from lowfc.control.laws.stability import delay_weights

_COMMAND_NOISE = 1e-6  # noise variance of limited commands in `_correction`; the Riccati equation needs one above 0
_STATE_NOISE = 1e-3
"""Variance of unknown changes of the states in `_correction`: with a larger value, the return from a limit takes
longer; with a smaller one, wrong states last longer."""


class Notch(NamedTuple):
    """A notch: at `frequency_hz`, the rejection (error / POL) is divided by `depth`.

    `width_hz` is the width between its -3 dB points if the notch is deep (at a depth of 4, they are 6 % closer).
    Neighbouring notches deepen each other.
    """

    frequency_hz: float
    width_hz: float
    depth: float


def pi_notch(
    noll: tuple[int, ...],
    gain: Array,
    proportional: Array,
    leak: Array,
    notches: Sequence[Sequence[Notch]],
    delay_frames: float,
    rate_hz: float,
) -> LinearLaw:
    """A PI law with a resonator for each notch; the phase of a resonator compensates the delay at its frequency.

    Without notches c[k] = (1 - leak) (c[k-1] + proportional e[k-1]) - (gain + proportional) e[k]. Its states follow the
    command after limits, so that limits cause no wind-up and closing starts from the held command. Check its stability
    with `lowfc.control.laws.margins`.

    Args:
        noll: Noll index of each mode.
        gain: (modes,) integral gain, per frame.
        proportional: (modes,) proportional gain, without unit.
        leak: (modes,) leak of the integral, per frame.
        notches: Notches of each mode.
        delay_frames: Delay, as in `lowfc.control.laws.stability.delay_weights`.
        rate_hz: Frame rate.

    Raises:
        ValueError: wrong array lengths or impossible values.
    """
    for name, values in (("gain", gain), ("proportional", proportional), ("leak", leak), ("notches", notches)):
        if len(values) != len(noll):
            raise ValueError(f"{name} must be given for each of {len(noll)} modes, got {len(values)}")
    for notch in (notch for mode_notches in notches for notch in mode_notches):
        if not (0 < notch.frequency_hz < rate_hz / 2 and 0 < notch.width_hz < rate_hz / 2 and notch.depth > 1):
            raise ValueError(
                f"a notch lies between 0 and {rate_hz / 2:g} Hz, has a width in the same range and a depth above 1, "
                f"got {notch}"
            )
    modes = zip(gain.tolist(), proportional.tolist(), leak.tolist(), notches, strict=True)
    blocks = [_block(*mode, delay_frames, rate_hz) for mode in modes]
    name = "pi-notch" if any(notches) else "pi"
    return law_from_blocks(blocks, "error", name, noll, delay_frames, rate_hz)


def _block(
    gain: float, proportional: float, leak: float, notches: Sequence[Notch], delay_frames: float, rate_hz: float
) -> Block:
    """Block of one mode, u = C s, s[k] = P s[k-1] + B e[k]; s: integral, error and a rotating pair per notch."""
    weights = delay_weights(delay_frames)
    residues: list[tuple[complex, complex]] = []  # pole, residue

    def law(z: complex) -> complex:
        response = gain / (1 - (1 - leak) / z) + proportional
        for pole, residue in residues:
            response += residue / (1 - pole / z) + residue.conjugate() / (1 - pole.conjugate() / z)
        return response

    for notch in notches:
        omega = 2 * np.pi * notch.frequency_hz / rate_hz
        z = complex(np.exp(1j * omega))
        # The resonator R makes S = S0 / (1 + R G S0), G = `seen`; with R G S0 = (depth - 1) a / (a + i (w - w0)) it is
        # a notch of this depth and, if it is deep, of width 2 a depth between its -3 dB points.
        pole = complex(np.exp(-np.pi * notch.width_hz / rate_hz / notch.depth) * z)
        seen = complex(np.polynomial.polynomial.polyval(1 / z, weights)) / z
        target = (notch.depth - 1) * (1 / seen + law(z))
        near, far = 1 / (1 - pole / z), 1 / (1 - pole.conjugate() / z)
        parts = np.array([[(near + far).real, (far - near).imag], [(near + far).imag, (near - far).real]])
        real, imaginary = np.linalg.solve(parts, [target.real, target.imag])
        residues.append((pole, complex(real, imaginary)))

    rotations = [np.array([[pole.real, -pole.imag], [pole.imag, pole.real]]) for pole, _ in residues]
    P = block_diag([[1 - leak]], [[0.0]], *rotations)
    B = np.array([-gain, 1.0, *([1.0, 0.0] * len(residues))])
    C = np.array([1.0, -proportional])
    for _, residue in residues:
        C = np.append(C, [-2 * residue.real, 2 * residue.imag])
    M = _correction(P, B, C)
    F = P @ (np.eye(len(P)) - np.outer(M, C))
    return Block(F, B, P @ M, F, C)


def _correction(P: Array, B: Array, C: Array) -> Array:
    """M (states,): share of each state in the correction after a limit changed the command.

    C (s + M (c - C s)) = c for the limited command c. Without notches the integral takes all of it. Otherwise M is the
    steady Kalman gain of a law's states from its limited commands, for errors of variance 1 and small unknown changes.
    """
    if len(C) == 2:
        return np.array([1.0, 0.0])
    unknown = np.concatenate([[1.0, 0.0], np.repeat(1 / np.sum(C[2:].reshape(-1, 2) ** 2, axis=1), 2)])
    covariance = solve_discrete_are(
        P.T, C[:, None], np.outer(B, B) + _STATE_NOISE * np.diag(unknown), [[_COMMAND_NOISE]]
    )
    towards = covariance @ C
    return np.asarray(towards / (C @ towards))
