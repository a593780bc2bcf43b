"""Measure the simulated loop on this host and put the table into the README.

Example:
    python docs/measure.py            # runs the loops, writes docs/measured.json and the README's table
    python docs/measure.py --render   # the README's table again from docs/measured.json
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lowfc.adapters.provenance import provenance
from lowfc.contract.configuration import Configuration, load
from sim_camera.prediction import tilt_residual_mas

ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "docs" / "measured.json"
README = ROOT / "README.md"
BEGIN, END = "<!-- measured: begin -->\n", "<!-- measured: end -->"

NORMAL = "[realtime]\npriority = 0\nlock_memory = false\nstay_awake = false\n"
COMMON = ["--disturbance", "reaction-wheel", "--star-magnitude", "2", "--sensor", "sam27d10_bal14", "--duration", "20"]
RUNS: tuple[tuple[str, list[str], str], ...] = (
    ("250 Hz, SCHED_FIFO", ["--rate", "250"], ""),
    ("250 Hz, normal scheduling", ["--rate", "250"], NORMAL),
    ("500 Hz, SCHED_FIFO", ["--rate", "500"], ""),
    ("1000 Hz, SCHED_FIFO", ["--rate", "1000"], ""),
    ("1000 Hz, normal scheduling", ["--rate", "1000"], NORMAL),
    ("1000 Hz of simulated time, in lockstep", ["--rate", "1000", "--lockstep"], ""),
)


def host() -> dict[str, Any]:
    """What the figures depend on."""
    known = provenance()
    return {
        "processor": known["processor"],
        "processors": int(known["processors"]),
        "kernel": known["kernel"],
        "python": known["python"],
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "load_before": round(os.getloadavg()[0], 2),
    }


def measure() -> dict[str, Any]:
    """Run every loop once and keep what `--json` prints."""
    found: dict[str, Any] = {"host": host(), "command": ["lowfc", "sim-loop", *COMMON], "runs": {}}
    for name, arguments, toml in RUNS:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "run.toml"
            file.write_text(toml)
            words = [sys.executable, "-m", "lowfc", "sim-loop", "--config", "run.toml", *COMMON, *arguments, "--json"]
            done = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
            run = json.loads(done.stdout) | {"log": None, "logs": []}
            run["tilt_predicted_mas"] = round(predicted_mas(load(file, overrides(arguments)), run), 4)
            found["runs"][name] = run
    return found


def overrides(arguments: list[str]) -> dict[str, Any]:
    """The configuration keys behind the command line."""
    return {
        "camera.rate_hz": float(arguments[arguments.index("--rate") + 1]),
        "disturbance.preset": "reaction-wheel",
        "star.magnitude": 2.0,
        "sensor.sam": "sam27d10_bal14",
    }


def predicted_mas(config: Configuration, run: dict[str, Any]) -> float:
    """The tilt residual that theory gives for the delay as measured: one frame, two where commands were late."""
    return tilt_residual_mas(config, 1 + run["commands_late"] / run["frames_published"])


def render(measured: dict[str, Any]) -> str:
    """The table in Markdown, with the host it was measured on."""
    rows = [
        "| loop | rate | tilt per axis, mas rms | predicted | frame to command, us | frame to mirror, us "
        "| frames skipped or missing | messages lost |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, run in measured["runs"].items():
        command, mirror = (
            " / ".join(f"{run['latency_us'][stage][p]:.0f}" for p in ("p50", "p99", "p99_9"))
            for stage in ("frame_to_command", "frame_to_mirror")
        )
        dropped = run["frames_skipped"] + run["frames_missing"]
        rows.append(
            f"| {name} | {run['rate_hz']:.1f} Hz | {run['tilt_residual_mas']:.2f} of {run['tilt_disturbance_mas']:.1f} "
            f"| {run['tilt_predicted_mas']:.2f} "
            f"| {command} | {mirror} | {dropped} of {run['frames_published']} "
            f"| {run['messages_lost']} of {run['messages_lost'] + run['messages_recorded']} |"
        )
    about = measured["host"]
    where = (
        "Latencies are p50 / p99 / p99.9; predicted is for the delay as measured, without the frames that were lost; "
        "the rate is that of the host's clock. "
        f"Measured {about['date']} on {about['processors']} cores of "
        f"{about['processor']} (a virtual machine, Linux {about['kernel']}, Python {about['python']}, load "
        f"{about['load_before']} before) by `python docs/measure.py`, which runs `{' '.join(measured['command'])}`."
    )
    return "\n".join([*rows, "", where, ""])


def put(document: Path, table: str, begin: str = BEGIN, end: str = END) -> None:
    """Replace what is between a document's marks."""
    before, _, rest = document.read_text().partition(begin)
    _, _, after = rest.partition(end)
    document.write_text(f"{before}{begin}{table}{end}{after}")


def command_line(
    about: str | None,
    measured: Path,
    document: Path,
    measure: Callable[[], dict[str, Any]],
    render: Callable[[dict[str, Any]], str],
    begin: str = BEGIN,
    end: str = END,
) -> None:
    """Measure into a JSON file unless told to take it as it is, and put its table between a document's marks."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--render", action="store_true", help=f"use {measured.relative_to(ROOT)} as it is")
    if not parser.parse_args().render:
        measured.write_text(json.dumps(measure(), indent=1) + "\n")
    put(document, render(json.loads(measured.read_text())), begin, end)


if __name__ == "__main__":
    command_line(__doc__, MEASURED, README, measure, render)
