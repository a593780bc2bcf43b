"""Driver for a voltage-driven mirror with the documented calls of Boston Micromachines' DM-SDK (module `bmc`).

It was tested with a stand-in for that module, not with hardware. For another vendor, replace these calls.

Example: lowfc mirror examples/boston_mirror.py:BostonMirror --run bench --config bench.toml --serial 17CW000#001
"""

import bmc

from lowfc.device import Configuration, ConfigurationError, Single, VoltMap, VoltOptions, geometry


class BostonMirror:
    """A mirror whose drive values are fractions of the voltage range, 0 to 1."""

    class Options(VoltOptions):
        """The mirror's serial number, in addition to the options of `VoltOptions`."""

        serial: str
        """Serial number of the mirror."""

    def __init__(self, options: Options, config: Configuration) -> None:
        """Open the mirror."""
        self.geometry = geometry(config)
        self.dm = bmc.BmcDm()
        self.check(self.dm.open_dm(options.serial))
        try:
            self.map = VoltMap(options, config, self.dm.num_actuators())
        except ConfigurationError:
            self.close()
            raise

    def apply(self, actuators_nm: Single) -> Single:
        """Send the values; return the surface by a linear estimate (a real stroke is roughly quadratic in voltage)."""
        values = self.map.values(actuators_nm)
        self.check(self.dm.send_data(values))
        return self.map.surface_nm(values)

    def close(self) -> None:
        """Release the mirror."""
        self.dm.close_dm()

    def check(self, status: int) -> None:
        """Raise OSError with the vendor's message if a call failed."""
        if status != bmc.NO_ERR:
            raise OSError(self.dm.error_string(status))
