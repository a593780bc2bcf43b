"""Pupils and sparse-aperture layouts from files, and a sensor built from their names."""

import json
import logging
from collections.abc import Callable
from difflib import get_close_matches
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.optics import focal_mask as focal_masks
from lowfc.optics import sam as sams
from lowfc.optics.pupil import from_quarter
from lowfc.optics.sensor import Sensor

DEFAULT_SAM = "sam27d07_bal14"

_DATA = resources.files("lowfc") / "data"
_log = logging.getLogger(__name__)


def load_pupil(samples: int = 512, file: Traversable = _DATA / "spc_quarter128.npz") -> NDArray[np.float64]:
    """The shaped pupil (samples, samples): 1e-9 between 4 and 20 lambda/D within 42.5 degrees of the x axis.

    Args:
        samples: Across the diameter, a multiple of 256.
        file: An npz file whose array `quarter` is the quadrant x >= 0, y >= 0.

    Raises:
        DataFileError: The file is missing, damaged or holds no such quadrant.
        ConfigurationError: The quadrant does not divide `samples`.
    """
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            quarter = np.asarray(arrays["quarter"], dtype=np.float64)
    except FileNotFoundError:
        raise DataFileError(f"there is no pupil file {file}") from None
    except Exception as error:  # zipfile, zlib and numpy each raise their own on a damaged file
        raise DataFileError(f"{file} is damaged, or not a pupil file with an array `quarter`: {error}") from error
    try:
        from_quarter(quarter, 2 * len(quarter))
    except ValueError as error:
        raise DataFileError(f"{file}: {error}") from error
    try:
        return from_quarter(quarter, samples)
    except ValueError as error:
        raise ConfigurationError(f"pupil sampling: {error}") from error


def layout_names() -> list[str]:
    """Names of the layouts that are shipped."""
    return sorted(_read_layouts(_DATA / "sam_layouts.json"))


def load_layout(name: str) -> sams.Layout:
    """A layout by name, checked.

    Args:
        name: A shipped layout, `file.json` with one layout, or `file.json:name` with several. A file has the shape of
            the shipped one: {"layouts": {name: {"purpose", "hole_diameter", "holes": [[x, y], ...]}}} in pupil
            diameters; a single layout may stand alone, without "layouts".

    Raises:
        ConfigurationError: No layout has that name.
        DataFileError: The file is missing, damaged, or its holes overlap or leave the pupil.
    """
    path, suffix, inner = name.partition(".json")
    file: Traversable = Path(path + suffix) if suffix else _DATA / "sam_layouts.json"
    layouts = _read_layouts(file)
    wanted = inner.removeprefix(":") if suffix else name
    if not wanted and len(layouts) == 1:
        wanted = next(iter(layouts))
    if wanted not in layouts:
        known = ", ".join(sorted(layouts))
        if not wanted:
            raise ConfigurationError(f"{file} holds several layouts; say which as {file}:name, of {known}")
        raise ConfigurationError(f"no sparse-aperture layout is called {wanted!r}{_nearest(wanted, layouts)}; {known}")
    return _parse(file, wanted, layouts[wanted])


def layout_warnings(layout: sams.Layout) -> list[str]:
    """What a user should know about a layout that is legal but of little use."""
    if sams.is_even_symmetric(layout):
        return [
            f"{layout.name} is symmetric about the pupil's centre: it cannot sense even modes such as focus and "
            "astigmatism; move at least one hole"
        ]
    return []


def sensor_from(
    sam: str = DEFAULT_SAM,
    focal_mask: str = "disk",
    wavelength_nm: float = 550.0,
    warn: Callable[[str], None] = _log.warning,
) -> Sensor:
    """The paper's sensor (Table 1) with the shipped shaped pupil.

    Args:
        sam: See `load_layout`.
        focal_mask: "disk" of 4 lambda/D, or "bowtie" (Fig. 3).
        wavelength_nm: The central wavelength.
        warn: Called with each of `layout_warnings`.

    Raises:
        ConfigurationError: A name is not known, or the wavelength is not positive.
        DataFileError: A file is missing or damaged, or a layout is impossible.
    """
    makers = {"disk": focal_masks.disk, "bowtie": focal_masks.bowtie}
    if focal_mask not in makers:
        raise ConfigurationError(
            f"no focal-plane mask is called {focal_mask!r}{_nearest(focal_mask, makers)}; {', '.join(makers)}"
        )
    layout = load_layout(sam)
    for text in layout_warnings(layout):
        warn(text)
    pupil = load_pupil()
    try:
        return Sensor(pupil, makers[focal_mask](), sams.transmission(layout, len(pupil)), wavelength_nm)
    except ValueError as error:
        raise ConfigurationError(f"sensor: {error}") from error


def _read_layouts(file: Traversable) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataFileError(f"there is no layout file {file}") from None
    except (OSError, ValueError) as error:
        raise DataFileError(f"{file} is not a readable JSON file: {error}") from error
    if isinstance(content, dict) and "holes" in content:
        return {str(content.get("name", Path(file.name).stem)): content}
    layouts = content.get("layouts") if isinstance(content, dict) else None
    if not isinstance(layouts, dict) or not layouts:
        raise DataFileError(f'{file} holds no layouts: expected {{"layouts": {{name: ...}}}} or one with "holes"')
    return layouts


def _parse(file: Traversable, name: str, entry: Any) -> sams.Layout:
    try:
        holes = tuple((float(x), float(y)) for x, y in entry["holes"])
        layout = sams.Layout(name, str(entry.get("purpose", "")), float(entry["hole_diameter"]), holes)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataFileError(
            f'{file}: layout {name} must have "hole_diameter" and "holes" as pairs [x, y], in pupil diameters '
            f"({type(error).__name__}: {error})"
        ) from error
    try:
        sams.check(layout)
    except ValueError as error:
        raise DataFileError(f"{file}: {error}") from error
    return layout


def _nearest(wanted: str, known: dict[str, Any]) -> str:
    close = get_close_matches(wanted, known, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
