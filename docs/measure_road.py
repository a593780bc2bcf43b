"""Measure what each change bought, and what the real-time set-up does on a busy host; takes twenty minutes.

Example:
    python docs/measure_road.py            # measures, writes docs/road.json and the tables of docs/performance.md
    python docs/measure_road.py --render   # the tables again from docs/road.json
"""

import json
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

from measure import ROOT, put

sys.path.insert(0, str(ROOT))

from benchmarks.road import table
from benchmarks.road.measure import SELDOM

MEASURED = ROOT / "docs" / "road.json"
DOCUMENT = ROOT / "docs" / "performance.md"
MODULES = {"road": "benchmarks.road", "loaded": "benchmarks.road.loaded"}


def measure() -> dict[str, Any]:
    """Run both; keep what `--json` prints."""
    found = {}
    for name, module in MODULES.items():
        words = [sys.executable, "-m", module, "--json"]
        done = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
        found[name] = json.loads(done.stdout)
    return found


def render(measured: Mapping[str, Any]) -> dict[str, str]:
    """Each table in Markdown, with how and where it was measured."""
    return {"road": road(measured["road"]), "loaded": loaded(measured["loaded"])}


def road(found: Mapping[str, Any]) -> str:
    """What each change bought."""
    how = found["settings"]
    elsewhere = min(how["repeats"], SELDOM)
    where = (
        f"Frame to command at {how['rate_hz']:g} Hz, runs of {how['seconds']:g} s. Each run of a change stands between "
        f"two of its loop as that is, {how['repeats']} times where most was to be expected, {elsewhere} "
        "times elsewhere: medians over the runs, in brackets the lowest and the highest. A ratio is of a run "
        "to its two neighbours; where its range includes 1, nothing is shown. "
        f"{_host(found)}"
    )
    return "\n".join([table.markdown(table.HEADINGS, table.road(found)), "", where, ""])


def loaded(found: Mapping[str, Any]) -> str:
    """With the real-time set-up and without."""
    how = found["settings"]
    share = next(kind["load_share"] for kind in found["kinds"] if kind["load"] and not kind["plain"])
    where = (
        f"{table.ratios(found)} Medians over {how['repeats']} runs of {how['seconds']:g} s at {how['rate_hz']:g} Hz, "
        "one kind after the other, in brackets the lowest and the highest; a frame without a command has no time, and "
        f"is counted apart. The load is, {found['load']}; beside the loop in real time it took "
        f"{100 * share['median']:.0f} % of the processors. {_host(found)}"
    )
    return "\n".join([table.markdown(table.LOADED_HEADINGS, table.loaded(found)), "", where, ""])


def _host(found: Mapping[str, Any]) -> str:
    about = found["host"]
    granted = found.get("granted") or next(kind["granted"] for kind in found["kinds"] if not kind["plain"])
    return (
        f"Granted by the host: {', '.join(granted)}. Measured {found['date']} on {about['processors']} cores of "
        f"{about['processor']} (a virtual machine, Linux {about['kernel']}, clock {about['clock_source']}, Python "
        f"{about['python']}, load {about['load_before']} before) by `python docs/measure_road.py`, which runs "
        f"`{found['command']}`."
    )


def marks(name: str) -> tuple[str, str]:
    """Where a table begins in the document, and where it ends."""
    return f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"


if __name__ == "__main__":
    if "--render" not in sys.argv:
        MEASURED.write_text(json.dumps(measure(), indent=1) + "\n")
    for one, text in render(json.loads(MEASURED.read_text())).items():
        put(DOCUMENT, text, *marks(one))
