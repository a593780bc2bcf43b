"""Load pupils from files; build sensors and coronagraphs from the section [sensor] of the configuration."""

import contextlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lowfc.adapters.files.layouts import layout_warnings, load_layout
from lowfc.arrays import Array
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import ConfigurationError, DataFileError, nearest, raised_as
from lowfc.contract.sections import SENSORS, SensorSection, sensor_keys
from lowfc.control.loop.wording import counted
from lowfc.optics.chain import sam as sams
from lowfc.optics.chain.coronagraph import DARK_ZONE, Coronagraph, LyotStop, Wedge
from lowfc.optics.chain.focal_mask import bowtie, disk, phase_spot
from lowfc.optics.chain.grid import SAMPLES, pupil_axis
from lowfc.optics.chain.pupil import circle, circle_with_bar, from_quarter, prolate
from lowfc.optics.chain.relay import ApertureMask, Defocus, PupilImage, Relay, fresnel_distance
from lowfc.optics.chain.sensor import Sensor

_DATA = resources.files("lowfc") / "data"
_MAX_BYTES = 1 << 30
PUPIL_IMAGE_PIXELS = 40  # across the image of a Zernike sensor
_MAX_PROLATE_RADIUS = 7.0  # lambda / D; beyond, double precision mixes the prolate function with the next orders
_PUPILS_WITH_LYOT_STOP = ("circle", "prolate")
_LYOT_OUTER = 12.0
"""Outer radius of the annular dark zone with a Lyot stop, lambda / D; the inner radius is the mask's edge."""
_log = logging.getLogger(__name__)


def load_pupil(samples: int = SAMPLES, file: Traversable = _DATA / "spc_quarter128.npz") -> Array:
    """Load a pupil (samples, samples), by default the shaped pupil, made for 1e-9 contrast in `DARK_ZONE`.

    Args:
        samples: Samples across the diameter, a multiple of twice the quadrant's samples (256 for the shaped pupil).
        file: An npz file whose array `quarter` is the quadrant x >= 0, y >= 0.

    Raises:
        DataFileError: The file is missing or damaged, holds no quadrant, or one that transmits beyond the circle.
        ConfigurationError: `samples` is not a multiple of twice the quadrant's samples.
    """
    with _opened(file) as arrays:
        quarter = np.asarray(arrays["quarter"])
    with raised_as(DataFileError, ValueError, file):
        from_quarter(quarter, 2 * max(cells := len(np.atleast_1d(quarter)), 1))
        corner = np.arange(cells)  # coordinate of each cell's corner nearest to the centre, cells
        beyond = quarter[corner[:, None] ** 2 + corner**2 >= cells**2]
        if beyond.any():
            excess = f"up to {float(beyond.max()):g} in {counted(int(np.count_nonzero(beyond)), 'cell')}"
            raise ValueError(
                f"`quarter` must be 0 beyond the pupil's circle, with a radius of {cells} cells, got {excess}: "
                "set these to 0, or scale the opening down"
            )
    with raised_as(ConfigurationError, ValueError, file):
        return from_quarter(quarter, samples)


def load_dark_zone(file: Traversable) -> Wedge:
    """Load the dark zone for which `lowfc design spc` made a pupil; `DARK_ZONE` if the file has no array `made_by`.

    Raises:
        DataFileError: The file is missing or damaged, or the request in `made_by` has no valid dark zone.
    """
    with _opened(file) as arrays:
        if "made_by" not in arrays:
            return DARK_ZONE
        try:
            request = json.loads(str(arrays["made_by"]))
            zone = Wedge(*(float(request[key]) for key in ("inner", "outer", "half_angle_deg")))
            if zone.outer > SAMPLES / 2:
                raise ValueError(f"the outer radius must be at most {SAMPLES // 2} lambda/D, got {zone.outer:g}")
            if not zone.is_sampled:
                raise ValueError("the dark zone is too thin for a science image of two samples per lambda/D")
        except Exception as error:  # `made_by` may hold anything
            raise DataFileError(
                f"{file}: `made_by` must be the request of `lowfc design spc`, a text with `inner`, `outer` and "
                f"`half_angle_deg` of its dark zone, or be omitted: {error!r}"
            ) from error
    return zone


@lru_cache
def _shaped_pupil() -> Array:
    return _read_only(load_pupil())


@lru_cache(maxsize=8)
def _transmission(layout: sams.Layout, samples: int, hole_samples: int) -> Array:
    return _read_only(sams.transmission(layout, samples, hole_samples))


def _read_only(shared: Array) -> Array:
    shared.flags.writeable = False
    return shared


def sensor_from(
    section: SensorSection | None = None, wavelength_nm: float = 550.0, warn: Callable[[str], None] = _log.warning
) -> Sensor:
    """Build the optics of [sensor], at the sampling of Table 1 of the paper; a Zernike sensor has 40 x 40 pixels.

    Args:
        section: Section of the configuration; all defaults when None.
        wavelength_nm: Central wavelength.
        warn: Function called with each warning of `layout_warnings`.

    Raises:
        ConfigurationError: A name is unknown, or values are inconsistent.
        DataFileError: A file is missing or damaged, or a layout is impossible.
    """
    section = SensorSection() if section is None else section
    pupil = _pupil(section)
    with raised_as(ConfigurationError, ValueError, "sensor"):
        focal_mask = _focal_mask(section)
        match section.kind:
            case "clowfs":
                relay: Relay = Defocus(fresnel_distance(section.defocus_mm, section.focal_ratio, wavelength_nm))
            case "zwfs":
                return Sensor(pupil, focal_mask, PupilImage(), wavelength_nm, pixels=PUPIL_IMAGE_PIXELS)
            case "bar":
                relay = ApertureMask(circle_with_bar(len(pupil), section.bar_width, section.bar_angle_deg))
            case "open":
                relay = ApertureMask(circle(len(pupil)))
            case "sam":
                layout = _layout(section.sam)
                for text in layout_warnings(layout):
                    warn(text)
                relay = ApertureMask(_transmission(layout, len(pupil), section.hole_samples))
        return Sensor(pupil, focal_mask, relay, wavelength_nm)


def sensor_named(name: str) -> Sensor:
    """Build the sensor of this name in `SENSORS`, or the sparse-aperture sensor with the layout of this name."""
    return sensor_from(SensorSection.model_validate(sensor_keys(name)))


def coronagraph_from(section: SensorSection) -> Coronagraph:
    """Build the coronagraph of the science image: with a shaped pupil, or with a Lyot stop.

    Raises:
        ConfigurationError: There is no such pupil, or the Lyot stop is too small.
        DataFileError: The pupil's file is missing or damaged.
    """
    pupil = _pupil(section)
    if section.pupil not in _PUPILS_WITH_LYOT_STOP:
        return Coronagraph(
            pupil, DARK_ZONE if section.pupil == "shaped" else load_dark_zone(input_file.user_path(section.pupil))
        )
    u = pupil_axis(len(pupil))
    stop = (np.hypot(u[:, None], u) <= section.lyot_stop / 2.0).astype(np.float64)
    if not stop.any():
        raise ConfigurationError(f"sensor.lyot_stop = {section.lyot_stop:g}: no sample of the pupil is in the stop")
    zone = Wedge(section.focal_radius, _LYOT_OUTER, 90.0)
    return Coronagraph(pupil, zone, LyotStop(disk(radius=section.focal_radius), stop))


@contextlib.contextmanager
def _opened(file: Traversable) -> Iterator[Mapping[str, NDArray[np.generic]]]:
    """Open a pupil file; each of its arrays is read when it is looked up."""
    try:
        opened = input_file.opened(file, _MAX_BYTES) if isinstance(file, Path) else file.open("rb")
        with opened as stream, np.load(stream, allow_pickle=False) as arrays:
            yield arrays
    except DataFileError:
        raise
    except FileNotFoundError:
        raise DataFileError(f"there is no pupil file {file}") from None
    except Exception as error:  # zipfile, zlib and numpy each raise their own on a damaged file
        raise DataFileError(f"{file} is damaged, or not a pupil file with an array `quarter`: {error}") from error


def _layout(name: str) -> sams.Layout:
    try:
        return load_layout(name)
    except ConfigurationError as error:  # on the command line one option names a sensor or a layout
        if name.partition(":")[0].endswith(".json"):
            raise
        raise ConfigurationError(
            f"unknown sensor {name!r}{nearest(name, SENSORS)}; sensors: {', '.join(SENSORS)}; {error}"
        ) from None


def _pupil(section: SensorSection) -> Array:
    match section.pupil:
        case "shaped":
            return _shaped_pupil()
        case "circle":
            return circle(SAMPLES)
        case "prolate" if section.focal_radius <= _MAX_PROLATE_RADIUS:
            return prolate(SAMPLES, section.focal_radius)
        case "prolate":
            raise ConfigurationError(f"sensor.focal_radius must be at most {_MAX_PROLATE_RADIUS:g} for a prolate pupil")
    if section.pupil.endswith(".npz"):
        return load_pupil(file=input_file.user_path(section.pupil))
    hint = nearest(section.pupil, ("shaped", "circle", "prolate"))
    raise ConfigurationError(
        f"sensor.pupil = {section.pupil!r}: no such pupil{hint}; there are shaped, circle, prolate and *.npz"
    )


def _focal_mask(section: SensorSection) -> NDArray[np.inexact]:
    if section.focal_mask == "bowtie":
        if section.kind == "zwfs" or section.inner_radius:
            raise ValueError("a bowtie has neither a phase spot nor an inner radius; set focal_mask = 'disk'")
        return bowtie(radius=section.focal_radius)
    if section.kind == "zwfs":
        mask = phase_spot(radius=section.focal_radius, spot_diameter=section.spot_diameter)
        if not np.ptp(mask.imag[mask != 0]):
            raise ValueError(f"a spot of {section.spot_diameter} lambda/D delays none or all of the light on the disk")
        return mask
    if section.kind == "clowfs":
        if not section.inner_radius < section.focal_radius:
            raise ValueError(
                f"inner_radius, {section.inner_radius} lambda/D, must be below focal_radius, {section.focal_radius}"
            )
        annulus = disk(radius=section.focal_radius, inner_radius=section.inner_radius)
        if not annulus.any():
            raise ValueError(
                f"the annulus of {section.inner_radius} to {section.focal_radius} lambda/D is thinner than the "
                "sampling of the focal plane: reduce inner_radius"
            )
        return annulus
    return disk(radius=section.focal_radius)
