"""Template of a mirror driver: `apply` receives commands that are already within the mirror's limits.

Example: lowfc mirror examples/mirror.py:MyMirror --run bench --config bench.toml
"""

from dataclasses import replace

import numpy as np

from lowfc.device import Configuration, DriverOptions, Single, geometry

STEP = 0.01
"""Smallest step of the hardware, in its unit."""


class MyMirror:
    """One unit of the hardware moves the surface by `mirror.nm_per_unit` nm."""

    def __init__(self, options: DriverOptions, config: Configuration) -> None:
        """Open the mirror; its actuators and limits are those of [mirror]."""
        self.nm_per_unit = config.mirror.nm_per_unit
        # lowfc tightens the limits by one step, so that rounding cannot exceed them
        self.geometry = replace(geometry(config), step_nm=STEP * self.nm_per_unit)

    def apply(self, actuators_nm: Single) -> Single:
        """Move the mirror to this shape (rows, columns), nm of surface from flat; return the shape reached."""
        units = STEP * np.round(actuators_nm / (STEP * self.nm_per_unit))
        # send `units` to the hardware here
        return (units * self.nm_per_unit).astype(np.float32)

    def close(self) -> None:
        """Release the mirror."""
