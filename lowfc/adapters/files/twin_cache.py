"""Cache of optical models: twin, mirror and contrast form are built once, then read from files named by their inputs.

A name is a hash of all inputs and of the source of the optics, so that files of other versions are never read.
"""

import functools
import hashlib
import io
import logging
import os
from collections.abc import Callable
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

import lowfc.optics
from lowfc.adapters.files.whole_file import write_whole
from lowfc.arrays import Array
from lowfc.contract.errors import DataFileError
from lowfc.optics.chain.added_contrast import contrast_form
from lowfc.optics.chain.band import Band, monochromatic
from lowfc.optics.chain.coronagraph import Coronagraph
from lowfc.optics.chain.mirror import Mirror
from lowfc.optics.chain.relay import ApertureMask
from lowfc.optics.chain.sensor import Sensor
from lowfc.optics.twin.twin import Operator, Twin, TwinSpec
from lowfc.optics.twin.twin_build import build
from lowfc.optics.twin.twin_mirror import TwinMirror, twin_mirror

_HASHED_AS = 3
"""Part of every operator hash, and so of the identity of every computed calibration: do not change it."""

_TWIN_ARRAYS = ("operator_hash", "axis", "used", "area_weights", "to_pixels")
_OPERATOR_ARRAYS = ("modes", "to_modes", "to_coefficients", "basis")

_Cached = TypeVar("_Cached")

_log = logging.getLogger(__name__)


def operator_hash(sensor: Sensor, spec: TwinSpec, band: Band) -> str:
    """SHA-256, hexadecimal, of every array and number that the twin depends on."""
    numbers = (_HASHED_AS, sensor.wavelength_nm, sensor.samples_per, sensor.binning, sensor.pixels)
    arrays: dict[str, NDArray[Any]] = {"pupil": sensor.pupil, "focal_mask": sensor.focal_mask}
    relay: tuple[object, ...] = (type(sensor.relay).__name__,)
    if isinstance(sensor.relay, ApertureMask):
        arrays["relay_mask"] = sensor.relay.transmission
    else:
        relay += astuple(sensor.relay)
    return _digest(arrays, repr((numbers, relay, astuple(spec), astuple(band))))


@functools.cache
def source_hash() -> str:
    """SHA-256, hexadecimal, of the source of `lowfc.optics` and of this module."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for path in sorted(Path(lowfc.optics.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


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
    """Load the twin from the cache, or build and cache it.

    Args:
        sensor: Optics of the sensor.
        spec: Compression of the twin.
        band: Wavelengths; the central wavelength alone when None.
        progress: Function called with the completed and total steps, only while building.
        cache_dir: Folder of the cache; `default_cache_dir()` when None.
        notice: Function called with a sentence if a file is damaged or cannot be written; neither is fatal.
    """
    band = monochromatic(sensor.wavelength_nm) if band is None else band
    key = operator_hash(sensor, spec, band)
    return _cached(
        _file("twin", key, cache_dir),
        lambda content: _unpack(content, key, spec),
        lambda: build(sensor, spec, band, key, progress),
        _pack,
        notice,
    )


def load_or_fit_mirror(
    sensor: Sensor,
    twin: Twin,
    mirror: Mirror,
    cache_dir: Path | None = None,
    notice: Callable[[str], None] = _log.warning,
) -> TwinMirror:
    """Load a mirror on the twin's nodes from the cache, or fit and cache it; arguments as for `load_or_build`."""
    return _cached(
        _file("mirror", repr((twin.operator_hash, astuple(mirror))), cache_dir),
        lambda content: TwinMirror(**_arrays(content)),
        lambda: twin_mirror(sensor, twin, mirror),
        lambda fitted: _packed({part.name: getattr(fitted, part.name) for part in fields(fitted)}),
        notice,
    )


def load_or_compute_form(
    coronagraph: Coronagraph,
    noll: tuple[int, ...],
    wavelength_nm: float,
    cache_dir: Path | None = None,
    notice: Callable[[str], None] = _log.warning,
) -> Array:
    """Load a `contrast_form` (modes, modes), per nm^2, from the cache, or compute and cache it."""
    arrays, lyot = {"pupil": coronagraph.pupil}, coronagraph.lyot
    if lyot is not None:
        arrays |= {"opaque": lyot.opaque, "stop": lyot.stop}
    numbers = coronagraph.dark_zone, lyot and lyot.samples_per, noll, wavelength_nm
    return _cached(
        _file("contrast", _digest(arrays, repr(numbers)), cache_dir),
        lambda content: _arrays(content)["form"],
        lambda: contrast_form(coronagraph, noll, wavelength_nm),
        lambda form: _packed({"form": form}),
        notice,
    )


def _file(kind: str, key: str, cache_dir: Path | None) -> Path:
    """File of this key for the present source code."""
    name = f"{kind}-{_digest({}, source_hash() + key)[:32]}.npz"
    return (default_cache_dir() if cache_dir is None else cache_dir) / name


def _cached(
    path: Path,
    unpack: Callable[[bytes], _Cached],
    make: Callable[[], _Cached],
    pack: Callable[[_Cached], bytes],
    notice: Callable[[str], None],
) -> _Cached:
    """Read an object from a file; if it is missing or damaged, make and write the object."""
    try:
        return unpack(path.read_bytes())
    except FileNotFoundError:
        pass
    except Exception as error:  # a damaged file fails in zipfile, zlib, numpy or the checks below: always rebuild
        notice(f"the cached {path} cannot be used and is built again: {type(error).__name__}: {error}")
    made = make()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, pack(made))
    except (OSError, DataFileError) as error:
        notice(f"{path} cannot be written and will be built again next time: {error}")
    return made


def _digest(arrays: dict[str, NDArray[Any]], extra: str = "") -> str:
    digest = hashlib.sha256(extra.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _pack(twin: Twin) -> bytes:
    arrays: dict[str, NDArray[Any]] = {name: np.array(getattr(twin, name)) for name in _TWIN_ARRAYS}
    arrays["band"] = np.array([(operator.wavelength_nm, operator.weight) for operator in twin.operators])
    for i, operator in enumerate(twin.operators):
        arrays |= {f"{name}_{i}": getattr(operator, name) for name in _OPERATOR_ARRAYS}
    return _packed(arrays)


def _packed(arrays: dict[str, NDArray[Any]]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)
    return stream.getvalue()


def _arrays(content: bytes) -> dict[str, NDArray[Any]]:
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:  # each array has a checksum in the archive
        return {name: stored[name] for name in stored.files}


def _unpack(content: bytes, key: str, spec: TwinSpec) -> Twin:
    arrays = _arrays(content)
    if str(arrays["operator_hash"]) != key:
        raise ValueError("it was made from other optics")
    operators = tuple(
        Operator(nm, weight, *(arrays[f"{name}_{i}"] for name in _OPERATOR_ARRAYS))
        for i, (nm, weight) in enumerate(arrays["band"].tolist())
    )
    return Twin(spec, arrays["axis"], arrays["used"], arrays["area_weights"], operators, arrays["to_pixels"], key)
