"""The simulated mirror as a driver."""

import numpy as np

from lowfc.adapters.files.factory import mirror_limits
from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration
from lowfc.device import DriverOptions, geometry
from sim_dm.actuators import Actuators
from sim_dm.device import Device, initial, responded, rounded


def device(config: Configuration) -> Device:
    """The mirror of a configuration."""
    section = config.mirror
    fixed_nm = np.full((section.rows, section.columns), np.nan, np.float32)
    fixed_nm.flat[section.dead] = 0
    for index, height_nm in section.stuck_nm.items():
        fixed_nm.flat[int(index)] = height_nm
    return Device(
        fixed_nm.shape,
        mirror_limits(config),
        section.stroke_nm / 2**section.driver_bits,
        section.on_command_timeout == "flat",
        section.settling_us * 1e3,
        fixed_nm,
    )


class SimulatedMirror:
    """The mirror that the section [mirror] of a configuration describes."""

    def __init__(self, options: DriverOptions, config: Configuration) -> None:
        """Start flat except for stuck actuators."""
        self.geometry = geometry(config)
        self._device = device(config)
        self._surface_nm = initial(self._device).surface_nm
        errors = config.mirror.gain_error, config.mirror.hysteresis, config.mirror.creep
        self._actuators = Actuators(self._surface_nm.shape, *errors, config.seed) if any(errors) else None

    def apply(self, actuators_nm: Single) -> Single:
        """Move, and return the settled surface."""
        return self.settle(actuators_nm, np.inf)

    def settle(self, actuators_nm: Single, elapsed_ns: float) -> Single:
        """Positions of the actuators, `elapsed_ns` after the last call."""
        reached_nm = rounded(self._device, actuators_nm)
        if self._actuators is not None:
            reached_nm = self._actuators.reach(reached_nm, elapsed_ns)
        self._surface_nm = responded(self._device, reached_nm, self._surface_nm, elapsed_ns)
        return self._surface_nm

    def close(self) -> None:
        """Nothing is held."""
