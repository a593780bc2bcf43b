"""A mirror of your own: what `apply` is given goes to its driver, already within the mirror's limits.

Example: lowfc mirror examples/mirror.py:MyMirror --run bench --config bench.toml
"""

import numpy as np

from lowfc.device import Configuration, DriverOptions, Single, geometry


class MyMirror:
    """A mirror that takes units of `mirror.nm_per_unit`, in steps of a hundredth."""

    def __init__(self, options: DriverOptions, config: Configuration) -> None:
        """Open the mirror; its actuators and limits are those of [mirror]."""
        self.geometry = geometry(config)
        self.nm_per_unit = config.mirror.nm_per_unit

    def apply(self, actuators_nm: Single) -> Single:
        """Move the mirror to these (rows, columns) nm of surface from flat; return where it is."""
        units = np.round(actuators_nm / self.nm_per_unit, 2)  # what your driver takes, and its least step
        return (units * self.nm_per_unit).astype(np.float32)

    def close(self) -> None:
        """Let go of the mirror."""
