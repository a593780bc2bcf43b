"""Template of a mirror driver: `apply` receives commands that are already within the mirror's limits.

Example: lowfc mirror examples/mirror.py:MyMirror --run bench --config bench.toml
"""

import numpy as np

from lowfc.device import Configuration, DriverOptions, Single, geometry


class MyMirror:
    """A mirror with units of `mirror.nm_per_unit`, in steps of a hundredth."""

    def __init__(self, options: DriverOptions, config: Configuration) -> None:
        """Open the mirror; its actuators and limits are those of [mirror]."""
        self.geometry = geometry(config)
        self.nm_per_unit = config.mirror.nm_per_unit

    def apply(self, actuators_nm: Single) -> Single:
        """Move the mirror to this shape (rows, columns), nm of surface from flat; return the shape reached."""
        units = np.round(actuators_nm / self.nm_per_unit, 2)  # the unit of your hardware, and its smallest step
        return (units * self.nm_per_unit).astype(np.float32)

    def close(self) -> None:
        """Release the mirror."""
