"""Virtual integrators: residuals of loops with other gains on the same pseudo-open-loop modes."""

from typing import NamedTuple

import numpy as np

from lowfc.arrays import Single

Weights = tuple[tuple[int, np.float32], ...]
"""(index in `history_nm`, fraction) of each command that an exposure sees."""


class VirtualIntegrators(NamedTuple):
    """Integrators in parallel with the real loop, one for each row; they move no mirror.

    A frame's noise is independent of the earlier commands. The difference of two rows' squared errors therefore has the
    same mean as the difference of their squared true residuals, for any noise.

    Attributes:
        gain: (rows, modes); 0 is the open loop.
        kept: (modes,) 1 - leak.
        limit_nm: (modes,) largest command, wavefront rms.
        weights: which commands are seen in an exposure, as in the loop.
        history_nm: commands (rows, modes), newest first.
    """

    gain: Single
    kept: Single
    limit_nm: Single
    weights: Weights
    history_nm: tuple[Single, ...]

    @classmethod
    def at_rest(cls, gain: Single, kept: Single, limit_nm: Single, weights: Weights) -> "VirtualIntegrators":
        """Integrators before their first command."""
        lags = 1 + max(lag for lag, _ in weights)
        return cls(gain, kept, limit_nm, weights, (np.zeros_like(gain),) * lags)

    def advanced(self, pol_nm: Single) -> tuple["VirtualIntegrators", Single]:
        """A copy one frame later, and the errors (rows, modes), nm of wavefront rms, that its loops would measure."""
        error_nm = pol_nm
        for lag, weight in self.weights:
            error_nm = error_nm + (self.history_nm[lag] if weight == 1 else weight * self.history_nm[lag])
        command_nm = self.kept * self.history_nm[0] - self.gain * error_nm
        np.maximum(command_nm, -self.limit_nm, out=command_nm)
        np.minimum(command_nm, self.limit_nm, out=command_nm)
        return self._replace(history_nm=(command_nm, *self.history_nm[:-1])), error_nm

    def held(self, frames: int = 1) -> "VirtualIntegrators":
        """A copy some frames later, without measurements: commands are held, as in the loop."""
        held = self.history_nm[:1] * min(frames, len(self.history_nm))
        return self._replace(history_nm=(held + self.history_nm)[: len(self.history_nm)])
