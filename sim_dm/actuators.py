"""Response of actuators to a command: gain errors, and the memory effects hysteresis and creep."""

import numpy as np

from lowfc.arrays import Array, Single

PLAY_NM = (1.0, 4.0, 16.0, 64.0, 256.0)
"""Half widths of the play operators, nm of surface; their range gives hysteresis in small and large moves."""
CREEP_S = (0.1, 1.0, 10.0, 100.0)
"""Time constants of the creep, a decade apart, so that creep grows with the logarithm of time."""


class Actuators:
    """Actuators of one mirror, initially flat.

    Hysteresis is a Prandtl-Ishlinskii model: a fraction of the command passes through play operators of several widths.
    Creep is a sum of first-order responses with time constants a decade apart.
    """

    def __init__(self, grid: tuple[int, int], gain_error: float, hysteresis: float, creep: float, seed: int) -> None:
        """Draw the gains.

        Args:
            grid: rows and columns.
            gain_error: rms of the gain errors, a fraction.
            hysteresis: fraction of the command that passes through the play operators.
            creep: fraction of a move that is added in each decade of time.
            seed: seed of the gains.
        """
        self._gain = 1 + gain_error * np.random.default_rng([seed, 5]).standard_normal(grid)
        self._hysteresis, self._creep = hysteresis, creep
        self._plays_nm = np.zeros((len(PLAY_NM), *grid))
        self._crept_nm = np.zeros((len(CREEP_S), *grid))

    def reach(self, driven_nm: Single, elapsed_ns: float) -> Single:
        """Positions (rows, columns) after this command has been applied for `elapsed_ns`, nm of surface."""
        position_nm: Array = driven_nm * self._gain
        if self._hysteresis:
            width_nm = np.array(PLAY_NM)[:, None, None]
            self._plays_nm = np.clip(self._plays_nm, position_nm - width_nm, position_nm + width_nm)
            position_nm = position_nm + self._hysteresis * (self._plays_nm.mean(axis=0) - position_nm)
        if self._creep:
            remaining = np.exp(-max(elapsed_ns, 0) / (1e9 * np.array(CREEP_S)))[:, None, None]
            self._crept_nm = position_nm + remaining * (self._crept_nm - position_nm)
            position_nm = position_nm + self._creep * self._crept_nm.sum(axis=0)
        return position_nm.astype(np.float32)
