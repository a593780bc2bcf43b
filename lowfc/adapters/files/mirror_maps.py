"""Maps of the mirror from FITS or .npy files: shapes, and the map of active actuators."""

from pathlib import Path

import numpy as np

from lowfc.arrays import Mask, Single, single
from lowfc.contract.codecs.input_file import user_path
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError, DataFileError, raised_as

_NM = ("nm", "nanometer", "nanometers")


def read_shape(path: Path, units: tuple[str, ...] = _NM) -> Single:
    """Read a mirror's shape (rows, columns): the first image of a FITS file, or a .npy file.

    `units` are the spellings of the unit that a FITS file may state; nothing is converted.

    Raises:
        DataFileError: the file is missing or damaged, or has no such array.
    """
    from lowfc.adapters.files.array_file import read_array  # astropy is slow to import

    shape = read_array(path, "a mirror's shape is an array (rows, columns)", (2,), units)
    return single(shape)


def active_actuators(config: Configuration) -> Mask | None:
    """Read the map of active actuators (rows, columns) of `mirror.active`; None if all are active.

    Raises:
        ConfigurationError: the file is missing or damaged, or does not fit the mirror; a value is not 0 or 1; no value
            is 1.
    """
    if not config.mirror.active:
        return None
    active = shape_of(config, "mirror.active", config.mirror.active, units=())
    if not np.isin(active, (0, 1)).all():
        raise ConfigurationError(f"mirror.active = {config.mirror.active!r}: every value must be 0 or 1")
    if not active.any():
        raise ConfigurationError(f"mirror.active = {config.mirror.active!r}: no actuator is active")
    return np.asarray(active, dtype=np.bool_)


def flat_nm(config: Configuration) -> Single | None:
    """Read the flat map (rows, columns) of `mirror.flat`, nm of surface, 0 at inactive actuators; None without one.

    Raises:
        ConfigurationError: the file, or that of `mirror.active`, is missing, damaged or does not fit the mirror.
    """
    if not config.mirror.flat:
        return None
    flat = shape_of(config, "mirror.flat", config.mirror.flat)
    active = active_actuators(config)
    return flat if active is None else np.where(active, flat, np.float32(0))


def shape_of(config: Configuration, key: str, file: str, units: tuple[str, ...] = _NM) -> Single:
    """Read one value per actuator (rows, columns), such as a shape in nm of surface; `key` names the file in errors.

    If `units` is not empty, a FITS file that states another unit is refused.

    Raises:
        ConfigurationError: the file is missing, damaged or does not fit the mirror.
    """
    with raised_as(ConfigurationError, DataFileError, key):
        values = read_shape(user_path(file), units)
    grid = (config.mirror.rows, config.mirror.columns)
    if values.shape != grid:
        raise ConfigurationError(
            f"{key} = {file!r}: {values.shape[0]} x {values.shape[1]} values, the mirror has {grid[0]} x {grid[1]} "
            "actuators"
        )
    if not np.isfinite(values).all():
        raise ConfigurationError(f"{key} = {file!r}: every value must be finite")
    return values
