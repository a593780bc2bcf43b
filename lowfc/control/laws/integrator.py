"""The integrator: gain, leak and limit of each mode."""

from dataclasses import dataclass, field

import numpy as np

from lowfc.arrays import Mask, Single, single

TIP_TILT = (2, 3)
"""Noll indices of tip and tilt, whose gains are set and judged separately from those of the other modes."""
MAX_KEPT_UNCORRECTED = np.float32(0.99)
"""Largest fraction of its command that a mode keeps from frame to frame while its automatic gain is 0: without a gain,
nothing else removes what an earlier gain put on the mirror."""


@dataclass(frozen=True, slots=True)
class Integrator:
    """Gain, leak and limit of each mode, each (modes,) float32; the limit is nm of wavefront rms.

    Attributes:
        uncorrected: (modes,) whether a mode is uncorrected because its automatic gain is 0.
        kept: (modes,) fraction of the command that is kept: 1 - leak; uncorrected modes at most `MAX_KEPT_UNCORRECTED`.
        rows: (3, modes) gain, kept and limit.
    """

    gain: Single
    leak: Single
    limit_nm: Single
    uncorrected: Mask | bool = False
    kept: Single = field(init=False)
    rows: Single = field(init=False)

    def __post_init__(self) -> None:
        if not self.gain.shape == self.leak.shape == self.limit_nm.shape:
            raise ValueError(
                f"gain, leak and limit must have the same length, got {self.gain.shape}, {self.leak.shape} "
                f"and {self.limit_nm.shape}"
            )
        for name, array, low, high in (
            ("gain", self.gain, 0, 4),
            ("leak", self.leak, 0, 1),
            ("limit_nm", self.limit_nm, 0, np.inf),
        ):
            if not (np.isfinite(array).all() and (array >= low).all() and (array <= high).all()):
                expected = f"between {low} and {high}" if np.isfinite(high) else f"finite and at least {low}"
                raise ValueError(f"every {name} must be {expected}, got {array.tolist()}")
        object.__setattr__(
            self, "kept", np.where(self.uncorrected, np.minimum(1 - self.leak, MAX_KEPT_UNCORRECTED), 1 - self.leak)
        )
        object.__setattr__(self, "rows", single([self.gain, self.kept, self.limit_nm]))


def integrate(integrator: Integrator, command_nm: Single, error_nm: Single) -> tuple[Single, bool]:
    """The next command, kept * command - gain * error, clipped to each mode's limit; and whether any mode was clipped.

    All arrays are (modes,) float32, nm of wavefront rms.
    """
    next_nm = integrator.kept * command_nm - integrator.gain * error_nm
    if np.count_nonzero(np.abs(next_nm) > integrator.limit_nm):
        return np.clip(next_nm, -integrator.limit_nm, integrator.limit_nm), True
    return next_nm, False


def injected_fraction(gain: Single) -> Single:
    """Fraction (modes,) of a frame's noise variance that an integrator puts on the mirror, for a delay of one frame."""
    return gain / (2 - gain)
