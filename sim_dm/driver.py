"""The simulated mirror as a driver: rounding to driver steps, settling, actuator errors, dead and stuck actuators."""

from math import expm1

import numpy as np

from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration
from lowfc.device import DriverOptions, geometry
from sim_dm.actuators import Actuators


class SimulatedMirror:
    """The mirror that the section [mirror] of a configuration describes."""

    def __init__(self, options: DriverOptions, config: Configuration) -> None:
        """Start with a flat surface except at stuck actuators."""
        section, self.geometry = config.mirror, geometry(config)
        grid = section.rows, section.columns
        fixed_nm = {**dict.fromkeys(section.dead, 0.0), **{int(index): nm for index, nm in section.stuck_nm.items()}}
        self._fixed, self._fixed_nm = list(fixed_nm), list(fixed_nm.values())
        self._settling_ns = section.settling_us * 1e3
        self._surface_nm = self._with_fixed(np.zeros(grid, np.float32))
        errors = section.gain_error, section.hysteresis, section.creep
        self._actuators = Actuators(grid, *errors, config.seed) if any(errors) else None

    def apply(self, actuators_nm: Single) -> Single:
        """Move, and return the settled surface."""
        return self.settle(actuators_nm, np.inf)

    def settle(self, actuators_nm: Single, elapsed_ns: float) -> Single:
        """Surface at the actuators, nm, after a first-order response over `elapsed_ns`; see `MirrorExtras.settle`."""
        step = np.float32(self.geometry.step_nm)
        reached_nm = actuators_nm / step
        np.rint(reached_nm, out=reached_nm)
        reached_nm *= step
        if self._actuators is not None:
            reached_nm = self._actuators.reach(reached_nm, elapsed_ns)
        if self._settling_ns > 0 and elapsed_ns <= 20 * self._settling_ns:
            reached_nm -= self._surface_nm
            reached_nm *= np.float32(-expm1(-max(elapsed_ns, 0) / self._settling_ns))
            reached_nm += self._surface_nm
        self._surface_nm = self._with_fixed(reached_nm)
        return self._surface_nm

    def close(self) -> None:
        """Do nothing: no hardware is held."""

    def _with_fixed(self, surface_nm: Single) -> Single:
        """Set dead and stuck actuators in a surface, in place, and return it."""
        if self._fixed:
            surface_nm.flat[self._fixed] = self._fixed_nm
        return surface_nm
