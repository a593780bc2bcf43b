"""Measure what docs/performance.md says of speed, each bench in turn; over an hour.

Example:
    python docs/measure_speed.py                    # measures, writes docs/speed.json, the picture and the sections
    python docs/measure_speed.py --only throughput  # one of them anew, the others as they were
    python docs/measure_speed.py --render           # the picture and the sections again from docs/speed.json
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from measure import ROOT, put

sys.path.insert(0, str(ROOT))

from benchmarks import curves, step, throughput
from benchmarks.peers import table as peers
from benchmarks.road import report
from lowfc.programs.latency import text as latency_text

MEASURED = ROOT / "docs" / "speed.json"
DOCUMENT = ROOT / "docs" / "performance.md"
PICTURE = ROOT / "docs" / "pictures" / "cost_curves.png"
LATENCY = ("lowfc", "latency", "--duration", "10", "--repeats", "5")
NEXT = "## What a view costs\n"
WATCHED = ("lowfc", "latency", "--duration", "60", "--record", "--view")


def _as_text(words: Sequence[str]) -> Callable[[dict[str, Any]], str]:
    return lambda result: f"```\n$ {shlex.join(words)}\n{latency_text.table(result)}\n```"


BENCHES: dict[str, tuple[Sequence[str], Callable[[dict[str, Any]], str]]] = {
    "latency": (LATENCY, _as_text(LATENCY)),
    "watched": (WATCHED, _as_text(WATCHED)),
    "step": (("benchmarks.step",), step.markdown),
    "peers": (("benchmarks.peers", "--seconds", "4"), peers.markdown),
    "curves": (("benchmarks.curves", "--seconds", "1", "--repeats", "2"), curves.markdown),
    "throughput": (("benchmarks.throughput", "--seconds", "6"), throughput.markdown),
    "road": (("benchmarks.road",), report.road_markdown),
    "loaded": (("benchmarks.road.loaded",), report.loaded_markdown),
}
"""What is run, as `python -m`, and how its `--json` becomes a part of the document."""
SECTIONS = {
    "latency": """
## From a frame to its command

The controller and the mirror as they run, frames made beforehand, at 1 kHz; [latency](latency.md) tells what each
line is.

""",
    "watched": """
The same for a minute, with the recorder and a view beside:

""",
    "step": """
## The control step

`python -m benchmarks.step`: decode, checks, law, limits and encode, from a frame's bytes to a command's, in one
process. The stages are timed one by one in steps of their own, which takes a little longer; the product R x is NumPy's,
in float32.

""",
    "peers": """
## Beside its peers

`python -m benchmarks.peers` drives all of them at the same sizes with the same frames, in turns, once in the normal
scheduling class and once under SCHED_FIFO with the processors kept awake for everybody; it needs an interpreter that
has `pyrtcao` (`--pyrtcao PYTHON`).

""",
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
    "road": """
## The road down

What each change to the loop bought, and what did not help. `python -m benchmarks.road` runs the loop of `lowfc latency`
(the real controller and mirror, frames made beforehand) as it is and, in turns with that, once for each change: without
it where it was kept, with it where it was not. Before and after are without and with the change in either case, so that
a ratio below 1 is a gain. `--only` takes names of changes. Kept changes are not independent: each is measured beside
all others. A change may move work from behind the command's put into it; frame to mirror, whose ratio is beside, then
stays as it was. Compiled code of our own in the loop is not in the table: it is out by design, so there is no patch for
it.

Frames go from the camera to the controller, and commands to the mirror, by sockets beside zenoh. A change that is
marked "by the bus alone" is tried in a loop in which both go through zenoh alone, as they do where there are no such
sockets, and compared with that loop. "Recording" is with the recorder beside, compared likewise.

""",
    "loaded": """
## On a loaded host

`python -m benchmarks.road.loaded` runs the same loop with its real-time set-up and without (`--plain-scheduling`),
beside a background load and alone, in turns.

""",
}


def marks(name: str) -> tuple[str, str]:
    """Between which a section's tables stand."""
    return f"<!-- {name}: begin -->\n", f"<!-- {name}: end -->"


def measure(name: str, extra: Sequence[str]) -> dict[str, Any]:
    """Run one of them; what its `--json` prints."""
    words = ["-m", *BENCHES[name][0], *extra, "--json"]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if not done.stdout:
        sys.exit(f"python {' '.join(words)} failed")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def render(name: str, result: dict[str, Any]) -> str:
    """The tables of one of them in Markdown."""
    return BENCHES[name][1](result) + "\n"


def place(document: Path, name: str, result: dict[str, Any]) -> None:
    """Put the tables into their section, which is added before `NEXT`, or at the end, where there is none yet."""
    begin, end = marks(name)
    if begin not in document.read_text():
        before, heading, after = document.read_text().partition(NEXT)
        after = f"\n{heading}{after}" if heading else ""
        document.write_text(f"{before.rstrip()}\n{SECTIONS[name]}{begin}{end}\n{after}")
    put(document, render(name, result), begin, end)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--render", action="store_true", help=f"use {MEASURED.relative_to(ROOT)} as it is")
    parser.add_argument("--only", choices=BENCHES, help="measure one of them")
    parser.add_argument("--pyrtcao", default=sys.executable, metavar="PYTHON", help="an interpreter that has pyrtcao")
    asked = parser.parse_args()
    found = json.loads(MEASURED.read_text()) if MEASURED.exists() else {}
    if not asked.render:
        for name in [asked.only] if asked.only else BENCHES:
            found[name] = measure(name, ["--pyrtcao", asked.pyrtcao] if name == "peers" else [])
            MEASURED.write_text(json.dumps(found, indent=1) + "\n")
    for name in BENCHES:
        if name in found:
            place(DOCUMENT, name, found[name])
    if "curves" in found:
        PICTURE.write_bytes(curves.picture(found["curves"]))


if __name__ == "__main__":
    main()
