"""Measure the cost curves and the highest rates on this host into docs/performance.md; forty minutes.

Example:
    python docs/measure_speed.py                    # measures, writes docs/speed.json, the picture and the sections
    python docs/measure_speed.py --only throughput  # one of the two anew, the other as it was
    python docs/measure_speed.py --render           # the picture and the sections again from docs/speed.json
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from measure import ROOT, put

sys.path.insert(0, str(ROOT))

from benchmarks import curves, throughput

MEASURED = ROOT / "docs" / "speed.json"
DOCUMENT = ROOT / "docs" / "performance.md"
PICTURE = ROOT / "docs" / "pictures" / "cost_curves.png"
BENCHES = {"curves": curves, "throughput": throughput}
SECTIONS = {
    "curves": """
## What a frame costs

`python -m benchmarks.curves` times one control step, from a frame's bytes to a command's, and the loop around it,
against the numbers of pixels, modes and actuators. The calibrations are random numbers in arrays of each size; the loop
is the real one, its source of frames, controller and mirror each a process.

A step cannot be faster than its bytes can be read: the reconstructor, for each pixel the reference, the dark and the
mask, the frame, and the modes' shapes. That limit is measured in the same run, on as many bytes, so that what fits into
a cache is read from a cache in both. Beside it stand the two matrix-vector products alone.

![Three panels: time for each frame against pixels, modes and actuators](pictures/cost_curves.png)

""",
    "throughput": """
## How fast the loop can go

`python -m benchmarks.throughput` looks for the highest rate that the closed loop sustains: with the simulated camera,
which has an optical model to compute for every frame, and with frames made beforehand, each with the recorder and
without. Free-running, the next frame is sent as soon as the last one's command is back. What each process uses of the
processors says what stands in the way: the camera's own arithmetic, controller and mirror on one processor, or
neither, where it is frames that come in a burst.

""",
}


def marks(name: str) -> tuple[str, str]:
    """Between which a section's tables stand."""
    return f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"


def measure(name: str) -> dict[str, Any]:
    """Run one of the two; what its `--json` prints."""
    words = ["-m", BENCHES[name].__name__, "--json"]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if not done.stdout:
        sys.exit(f"python {' '.join(words)} failed")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def render(name: str, result: dict[str, Any]) -> str:
    """The tables of one of the two in Markdown."""
    return BENCHES[name].markdown(result) + "\n"


def place(document: Path, name: str, result: dict[str, Any]) -> None:
    """Put the tables into their section, which is added at the document's end where there is none yet."""
    begin, end = marks(name)
    if begin not in document.read_text():
        with document.open("a") as file:
            file.write(f"{SECTIONS[name]}{begin}{end}\n")
    put(document, render(name, result), begin, end)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--render", action="store_true", help=f"use {MEASURED.relative_to(ROOT)} as it is")
    parser.add_argument("--only", choices=BENCHES, help="measure one of the two")
    asked = parser.parse_args()
    found = json.loads(MEASURED.read_text()) if MEASURED.exists() else {}
    if not asked.render:
        for name in [asked.only] if asked.only else BENCHES:
            found[name] = measure(name)
            MEASURED.write_text(json.dumps(found, indent=1) + "\n")
    for name in BENCHES:
        if name in found:
            place(DOCUMENT, name, found[name])
    if "curves" in found:
        PICTURE.write_bytes(curves.picture(found["curves"]))


if __name__ == "__main__":
    main()
