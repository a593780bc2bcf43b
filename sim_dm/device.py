"""The simulated mirror: rounding to driver steps, settling, dead and stuck actuators; pure functions."""

from dataclasses import dataclass
from functools import cached_property
from math import expm1

import numpy as np

from lowfc.arrays import Single, Whole
from lowfc.device.mirror_protection import MirrorProtection, Status


@dataclass(frozen=True)
class Device(MirrorProtection):
    """Properties of the mirror in addition to those of its protection.

    Attributes:
        settling_ns: time constant of the actuators.
        fixed_nm: (rows, columns) height of dead and stuck actuators, NaN for working ones.
    """

    settling_ns: float
    fixed_nm: Single

    @cached_property
    def fixed(self) -> Whole | None:
        """Flat indices of dead and stuck actuators; None if all work."""
        found = np.flatnonzero(np.isfinite(self.fixed_nm))
        return found if found.size else None


def initial(device: Device) -> Status:
    """Initial status: flat, waiting for the first command."""
    flat = np.zeros(device.grid, np.float32)
    return Status(flat, _at_rest(device, flat))


def rounded(device: Device, driven_nm: Single) -> Single:
    """Round a command to the driver's steps."""
    step = np.float32(device.step_nm)
    found = driven_nm / step
    np.rint(found, out=found)
    found *= step
    return found


def responded(device: Device, reached_nm: Single, surface_nm: Single, elapsed_ns: float) -> Single:
    """First-order response of the actuators, from `surface_nm`, `elapsed_ns` ago, towards `reached_nm`."""
    found = reached_nm
    if device.settling_ns > 0 and elapsed_ns <= 20 * device.settling_ns:
        found = found - surface_nm
        found *= np.float32(-expm1(-max(elapsed_ns, 0) / device.settling_ns))
        found += surface_nm
    return _at_rest(device, found)


def _at_rest(device: Device, surface_nm: Single) -> Single:
    """Keep dead and stuck actuators in place."""
    if device.fixed is None:
        return surface_nm
    found = surface_nm.copy()
    found.flat[device.fixed] = device.fixed_nm.flat[device.fixed]
    return found
