"""The twin's cache: built once, then read from a file named by a hash of everything it depends on."""

import hashlib
import io
import logging
import os
import tempfile
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lowfc.optics.band import Band, monochromatic
from lowfc.optics.sensor import Sensor
from lowfc.optics.twin import Operator, Twin, TwinSpec
from lowfc.optics.twin_build import build

FORMAT = 1
"""Raised whenever the construction or the file changes: files of another format are not looked at."""

_log = logging.getLogger(__name__)


def operator_hash(sensor: Sensor, spec: TwinSpec, band: Band) -> str:
    """SHA-256, hexadecimal, of every array and number that the twin depends on."""
    numbers = (FORMAT, sensor.wavelength_nm, sensor.samples_per, sensor.binning, sensor.pixels)
    arrays = {"pupil": sensor.pupil, "focal_mask": sensor.focal_mask, "relay_mask": sensor.relay_mask}
    return _digest(arrays, repr((numbers, astuple(spec), astuple(band))))


def default_cache_dir() -> Path:
    """`$XDG_CACHE_HOME/lowfc`, or `~/.cache/lowfc`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lowfc"


def load_or_build(
    sensor: Sensor,
    spec: TwinSpec,
    band: Band | None = None,
    progress: Callable[[int, int], None] | None = None,
    cache_dir: Path | None = None,
    notice: Callable[[str], None] = _log.warning,
) -> Twin:
    """The twin from the cache, or built and put there.

    Args:
        sensor: The optics.
        spec: How far they are compressed.
        band: The central wavelength alone when None.
        progress: Called with the steps done and the steps in all, only while building.
        cache_dir: `default_cache_dir()` when None.
        notice: Called with a sentence about a damaged file or a directory that cannot be written; neither is fatal.
    """
    band = monochromatic(sensor.wavelength_nm) if band is None else band
    key = operator_hash(sensor, spec, band)
    path = (default_cache_dir() if cache_dir is None else cache_dir) / f"twin-{key[:32]}.npz"
    try:
        return _unpack(path.read_bytes(), key, spec)
    except FileNotFoundError:
        pass
    except Exception as error:  # a damaged file fails in zipfile, zlib, numpy or the checks below: always rebuild
        notice(f"the cached twin {path} cannot be used and is built again: {type(error).__name__}: {error}")
    twin = build(sensor, spec, band, key, progress)
    try:
        _write(path, _pack(twin))
    except OSError as error:
        notice(f"the twin is not cached and will be built again next time: {error}")
    return twin


def _digest(arrays: dict[str, NDArray[Any]], extra: str = "") -> str:
    digest = hashlib.sha256(extra.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _pack(twin: Twin) -> bytes:
    arrays: dict[str, NDArray[Any]] = {
        "operator_hash": np.array(twin.operator_hash),
        "axis": twin.axis,
        "used": twin.used,
        "area_weights": twin.area_weights,
        "to_pixels": twin.to_pixels,
        "band": np.array([(operator.wavelength_nm, operator.weight) for operator in twin.operators]),
    }
    for i, operator in enumerate(twin.operators):
        arrays |= {
            f"to_modes_{i}": operator.to_modes,
            f"to_coefficients_{i}": operator.to_coefficients,
            f"basis_{i}": operator.basis,
        }
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, checksum=np.array(_digest(arrays)), **arrays)
    return stream.getvalue()


def _unpack(content: bytes, key: str, spec: TwinSpec) -> Twin:
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    if str(arrays.pop("checksum")) != _digest(arrays):
        raise ValueError("the checksum does not match the content")
    if str(arrays["operator_hash"]) != key:
        raise ValueError("it was made from other optics")
    operators = tuple(
        Operator(nm, weight, arrays[f"to_modes_{i}"], arrays[f"to_coefficients_{i}"], arrays[f"basis_{i}"])
        for i, (nm, weight) in enumerate(arrays["band"].tolist())
    )
    return Twin(spec, arrays["axis"], arrays["used"], arrays["area_weights"], operators, arrays["to_pixels"], key)


def _write(path: Path, content: bytes) -> None:
    """Write beside, then rename: a reader or a second writer never sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=path.stem, suffix=".part", delete=False) as stream:
        part = Path(stream.name)
        try:
            stream.write(content)
            stream.close()
            part.replace(path)
        except BaseException:
            part.unlink()
            raise
