"""Sparse-aperture layouts: those shipped with lowfc, and those in a user's files."""

import json
import re
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from lowfc.contract.codecs import input_file
from lowfc.contract.errors import ConfigurationError, DataFileError, brief, nearest, raised_as
from lowfc.optics.chain import sam as sams

SHIPPED = resources.files("lowfc") / "data" / "sam_layouts.json"

_MAX_BYTES = 1 << 24


def layout_names() -> list[str]:
    """Names of the shipped layouts."""
    return sorted(_read_layouts(SHIPPED))


def load_layout(name: str) -> sams.Layout:
    """Load a layout by name and check it.

    Args:
        name: A shipped layout, `file.json` with one layout, or `file.json:name` with several. A file has the form
            of the shipped one: {"layouts": {name: {"purpose", "hole_diameter", "holes": [[x, y], ...]}}}; a hole
            [x, y, diameter] has its own size. Positions and diameters are in pupil diameters. A single layout may stand
            alone, without "layouts".

    Raises:
        ConfigurationError: No layout has that name, or the file holds several and none is named.
        DataFileError: The file is missing or damaged, or the layout's holes overlap or leave the pupil.
    """
    in_file = re.fullmatch(r"(.*\.json)(?::(.*))?", name)
    file: Traversable = input_file.user_path(in_file[1]) if in_file else SHIPPED
    layouts = _read_layouts(file)
    chosen = (in_file[2] or "") if in_file else name
    if not chosen and len(layouts) == 1:
        chosen = next(iter(layouts))
    if chosen not in layouts:
        names = ", ".join(sorted(layouts))
        if not chosen:
            raise ConfigurationError(f"{file} holds several layouts; choose one with {file}:NAME; it has {names}")
        raise ConfigurationError(
            f"no sparse-aperture layout is called {chosen!r}{nearest(chosen, layouts)}: there are {names}"
        )
    return parse_layout(file, chosen, layouts[chosen])


def parse_layout(file: Traversable, name: str, entry: Any) -> sams.Layout:
    """Make a layout from its entry in a JSON file and check it.

    Args:
        file: File of the layout, for errors.
        name: Name of the layout.
        entry: "hole_diameter", "holes" and optionally "purpose", as in `load_layout`.

    Raises:
        DataFileError: The entry is malformed, or its holes overlap or leave the pupil.
    """
    try:
        holes = tuple(_hole(hole, entry) for hole in entry["holes"])
        layout = sams.Layout(name, str(entry.get("purpose", "")), holes)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise DataFileError(
            f'{file}: layout {name} must have "hole_diameter" and "holes" as pairs [x, y], or as [x, y, diameter], in '
            f"pupil diameters ({type(error).__name__}: {brief(str(error))})"
        ) from error
    with raised_as(DataFileError, ValueError, file):
        sams.check(layout)
    return layout


def layout_warnings(layout: sams.Layout) -> list[str]:
    """Warnings about a layout that is valid but of little use."""
    if sams.is_even_symmetric(layout):
        return [
            f"{layout.name} is symmetric about the pupil's centre: it cannot sense even modes such as focus and "
            "astigmatism; move at least one hole"
        ]
    return []


def _read_layouts(file: Traversable) -> dict[str, Any]:
    try:
        content = json.loads(input_file.read_whole(file, _MAX_BYTES) if isinstance(file, Path) else file.read_bytes())
    except FileNotFoundError:
        raise DataFileError(f"there is no layout file {file}") from None
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise DataFileError(f"{file} is not a readable JSON file: {why}") from error
    except RecursionError:
        raise DataFileError(f"{file} is not a readable JSON file: its lists or objects are nested too deeply") from None
    if isinstance(content, dict) and "holes" in content:
        return {str(content.get("name", Path(file.name).stem)): content}
    layouts = content.get("layouts") if isinstance(content, dict) else None
    if not isinstance(layouts, dict) or not layouts:
        raise DataFileError(
            f'{file} holds no layouts: expected {{"layouts": {{name: ...}}}} or a single layout with "holes"'
        )
    return layouts


def _hole(hole: Any, entry: Any) -> tuple[float, float, float]:
    x, y, diameter = hole if len(hole) == 3 else (*hole, entry["hole_diameter"])
    return float(x), float(y), float(diameter)
