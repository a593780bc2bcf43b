"""Linear conversion from nm of surface to drive values, clipped and in the vendor's order of channels."""

import numpy as np

from lowfc.adapters.files.mirror_maps import shape_of
from lowfc.arrays import Array, Single, single
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError
from lowfc.device.driver import DriverOptions


class VoltOptions(DriverOptions):
    """Options of a mirror driven by one value for each channel: volts, or a fraction of their range.

    Files are FITS or .npy, (rows, columns). A value higher by 1 raises the surface by `mirror.nm_per_unit` x gain nm.
    """

    zero: float = 0.5
    """Value of an actuator at 0 nm of surface."""
    zero_map: str = ""
    """File of each actuator's value at 0 nm of surface; empty: `zero` for all."""
    gain_map: str = ""
    """File of each actuator's gain, relative to mirror.nm_per_unit; empty: 1 for all."""
    lowest: float = 0.0
    """Lowest value sent."""
    highest: float = 1.0
    """Highest value sent."""
    order: str = ""
    """File of each actuator's channel number, from 0; -1 for an actuator without channel; empty: row by row."""


class VoltMap:
    """Converts a surface to channel values and back, linearly; `channels` is the number of channels, wired or not."""

    def __init__(self, options: VoltOptions, config: Configuration, channels: int | None = None) -> None:
        """Read the maps; `channels` is the number of channels of the electronics, if known.

        Raises:
            ConfigurationError: a map cannot be read, does not fit the mirror, or has impossible values.
        """
        grid = (config.mirror.rows, config.mirror.columns)

        def read(key: str, file: str, default: Array) -> Array:
            return shape_of(config, f"option {key}", file, units=()).astype(float) if file else default

        zero = read("zero_map", options.zero_map, np.full(grid, options.zero))
        gain = read("gain_map", options.gain_map, np.ones(grid))
        order = read("order", options.order, np.arange(zero.size, dtype=float).reshape(grid)).ravel()
        if (order % 1).any() or order.max() >= 1 << 16:
            raise ConfigurationError("option order: every value must be a whole number below 65536")
        self._wired = np.flatnonzero(order >= 0)
        if not self._wired.size:
            raise ConfigurationError("option order: no actuator has a channel; channel numbers begin with 0")
        self._channel = order[self._wired].astype(int)
        self.channels = int(self._channel.max()) + 1 if channels is None else channels
        if len(set(self._channel)) < len(self._channel) or self._channel.max() >= self.channels:
            raise ConfigurationError(
                f"option order ({options.order or 'none: row by row'}): each actuator needs its own channel below "
                f"{self.channels}, or -1 if it has none; got {self._channel.min()} to {self._channel.max()} for "
                f"{len(self._channel)} actuators"
            )
        if not (gain.ravel()[self._wired] > 0).all():
            raise ConfigurationError("option gain_map: the gain of every actuator with a channel must be above 0")
        self._zero = zero.ravel()[self._wired]
        self._nm_per_value = (gain * config.mirror.nm_per_unit).ravel()[self._wired]
        self._range = low, high = options.lowest, options.highest
        if not (low <= self._zero.min() <= self._zero.max() <= high):
            raise ConfigurationError(f"options zero, zero_map: values at 0 nm must be within {low:g} to {high:g}")
        self._grid = grid

    def values(self, actuators_nm: Single) -> Array:
        """Values (channels,), clipped, for actuators (rows, columns) in nm of surface; 0 for unused channels."""
        values = np.zeros(self.channels)
        wired_nm = actuators_nm.ravel()[self._wired]
        values[self._channel] = np.clip(self._zero + wired_nm / self._nm_per_value, *self._range)
        return values

    def surface_nm(self, values: Array) -> Single:
        """Actuators (rows, columns) in nm of surface for values (channels,); 0 for actuators without a channel."""
        surface = np.zeros(self._grid)
        surface.flat[self._wired] = (values[self._channel] - self._zero) * self._nm_per_value
        return single(surface)
