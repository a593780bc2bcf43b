"""The files of a search for a sparse aperture mask: layouts, the state to resume from, and the front."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lowfc.adapters.files.drawing import figure_class, png
from lowfc.adapters.files.layouts import parse_layout
from lowfc.adapters.files.whole_file import require_folder, write_whole
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.design.paper import TABLE3_WAVES, TABLE4_MAS
from lowfc.design.sam_search import Chain
from lowfc.optics.chain.sam import Layout
from lowfc.programs.design.sam_request import Search

_MAX_BYTES = 1 << 26  # largest state file that is read
UNITS = "pupil diameters, origin at the pupil centre, x to the right (columns), y up the row index"


@dataclass(frozen=True)
class FoundLayout:
    """A layout that a search found, with its merit, its predictions for Tables 3 and 4, and its throughput."""

    layout: Layout
    merit: float
    table3_waves: float
    table4_mas: float
    throughput: float


def check_files(out: Path, resume: Path | None, *others: Path | None) -> Path:
    """Check before the search that its files can be written, and return the state file.

    Args:
        out: Layout file.
        resume: State file of the search to continue; None for a new search.
        others: Other files to be written.

    Raises:
        ConfigurationError, DataFileError: A file cannot be written, `out` does not end in .json, or a new search would
            overwrite the state of an interrupted one.
    """
    if out.suffix != ".json":
        raise ConfigurationError(f"--out must end in .json, the only type read as a layout file; got {out}")
    state = resume if resume is not None else out.with_name(f"{out.name}.state.json")
    require_folder(out, state, *others)
    if resume is None and state.exists():
        advice = f"continue with --resume {state} --out {out}, or delete it"
        raise ConfigurationError(f"{state} holds an interrupted search: {advice}")
    return state


def write_state(path: Path, search: Search, digest: str, chains: Sequence[Chain]) -> None:
    """Write the state from which a search can be resumed, with the digest of its pupil."""
    state = {"search": asdict(search), "pupil": digest, "chains": [asdict(chain) for chain in chains]}
    write_whole(path, json.dumps(state).encode())


def read_state(path: Path, digest: str) -> tuple[Search, list[Chain]]:
    """Read the search and chains of a state file; DataFileError if it has none, or the digest of another pupil."""
    try:
        state = json.loads(input_file.read_whole(path, _MAX_BYTES))
        search = Search(**state["search"])
        chains = [Chain(**{key: _as_tuple(value) for key, value in chain.items()}) for chain in state["chains"]]
        searched_digest = state["pupil"]
        if len(chains) != search.chains:
            raise ValueError(f"{len(chains)} chains, expected {search.chains}")
    except FileNotFoundError:
        raise DataFileError(f"there is no search to resume in {path}") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataFileError(f"{path} is not the state of a search: {type(error).__name__}: {error}") from error
    if searched_digest != digest:
        raise DataFileError(f"{path} belongs to a search with another shaped pupil; start a new one without --resume")
    return search, chains


def write_layouts(path: Path, points: Sequence[FoundLayout], search: Search, command: str) -> None:
    """Write layouts in the format that the loop reads, each with the command of the search."""
    entries = {point.layout.name: _entry(point, search, command) for point in points}
    content = json.dumps({"units": UNITS, "layouts": entries}, indent=1) + "\n"
    for name, entry in json.loads(content)["layouts"].items():
        parse_layout(path, name, entry)  # refused here, not by the loop that reads the file
    write_whole(path, content.encode())


def write_front(path: Path, points: Sequence[FoundLayout]) -> None:
    """Write a table of the layouts (CSV); those on the front are marked."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["layout", "holes", "table3_waves", "table4_mas", "throughput", "merit", "on_front"])
    on_front = front(points)
    for point in sorted(points, key=lambda point: point.table3_waves):
        values = (point.table3_waves, point.table4_mas, point.throughput, point.merit)
        table.writerow([point.layout.name, len(point.layout.holes), *values, int(point in on_front)])
    write_whole(path, text.getvalue().encode())


def write_plot(path: Path, points: Sequence[FoundLayout], search: Search) -> None:
    """Plot the prediction for Table 4 against that for Table 3, for the layouts and the paper's sensor (PNG)."""
    figure = figure_class()(figsize=(6.4, 4.8), layout="constrained")
    axes = figure.subplots()
    on_front = sorted(front(points), key=lambda point: point.table3_waves)
    axes.plot([p.table3_waves for p in points], [p.table4_mas for p in points], ".", color="0.6", label="searched")
    axes.plot([p.table3_waves for p in on_front], [p.table4_mas for p in on_front], "o-", label="front")
    paper = TABLE3_WAVES[search.focal_masks[0]][search.goal.modes][0]
    axes.plot([paper], [TABLE4_MAS["sam"][1]], "k*", markersize=12, label="paper")
    axes.set(xscale="log", yscale="log", xlabel="Table 3: residual (waves rms)", ylabel="Table 4: tilt (mas)")
    axes.set_title(f"{search.goal.modes} modes, {search.focal_masks[0]}, {search.goal.estimator}")
    axes.legend()
    write_whole(path, png(figure, 150))


def front(points: Sequence[FoundLayout]) -> list[FoundLayout]:
    """The Pareto front: all layouts that no other layout beats in one table and at least equals in the other."""
    return [
        point
        for point in points
        if not any(
            other.table3_waves <= point.table3_waves
            and other.table4_mas <= point.table4_mas
            and (other.table3_waves, other.table4_mas) != (point.table3_waves, point.table4_mas)
            for other in points
        )
    ]


def _as_tuple(value: Any) -> Any:
    """Convert JSON's lists to tuples, at any depth."""
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value


def _entry(point: FoundLayout, search: Search, command: str) -> dict[str, Any]:
    layout = point.layout
    diameters = sorted({hole[2] for hole in layout.holes})
    entry: dict[str, Any] = {
        "purpose": layout.purpose,
        "merit": search.goal.merit,
        "seed": search.seed,
        "command": command,
    }
    if len(diameters) == 1:
        return {**entry, "hole_diameter": diameters[0], "holes": [hole[:2] for hole in layout.holes]}
    return {**entry, "holes": list(layout.holes)}
