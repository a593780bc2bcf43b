"""Run the contest and print one table: python -m benchmarks.peers, from the root of the repository."""

import argparse
import importlib.metadata
import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.command import add_forms, run_main, say
from benchmarks.host import host
from benchmarks.peers.contest import PRIORITY, SCHEDULING, Rules, hold, may_run_first, processors
from benchmarks.peers.contestants import CONTESTANTS
from benchmarks.peers.problem import ACTUATORS, MODES, SHAPE
from benchmarks.peers.table import DEFINITIONS, markdown, summary, text
from lowfc.adapters.progress import passing_bar

_SIZES = f"{SHAPE[0]} x {SHAPE[1]} uint16 pixels, {MODES} modes, {ACTUATORS} actuators"


def main() -> int:
    """The command line; returns its exit status."""
    asked = _parser().parse_args()
    result = json.loads(asked.render.read_text()) if asked.render else measure(asked)
    say(result, asked, text, markdown)
    return 1 if any(row["failures"] for row in result["rows"]) else 0


def measure(asked: argparse.Namespace) -> dict[str, Any]:
    """Hold the contest that the command line asks for; the object that --json prints."""
    rules = Rules(asked.seconds, asked.warm_up, asked.rate_hz, asked.pyrtcao)
    chosen = [one for one in CONTESTANTS if any(word in one.name for word in asked.only)] if asked.only else CONTESTANTS
    if not chosen:
        raise SystemExit(f"--only: none of {'; '.join(one.name for one in CONTESTANTS)}")
    classes, notes = list(SCHEDULING), []
    if not may_run_first():
        classes.remove("FIFO")
        notes.append(f"FIFO: this host does not allow SCHED_FIFO {PRIORITY} (LimitRTPRIO=, CAP_SYS_NICE).")
    if len(set(processors())) == 1:
        notes.append("Both ends shared one processor: there is no other.")
    words = ["PYTHON" if word == asked.pyrtcao else word for word in sys.argv[1:]]  # its path is nobody's business
    load_before = os.getloadavg()[0]
    with passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task("contest", total=None)
        rows = hold(chosen, rules, asked.repeats, classes, lambda what: bar.update(task, description=what))
    for row in rows:
        if row["repeats"]:
            row["summary"] = summary(row)
    return {
        "rows": rows,
        "rules": {name: getattr(asked, name) for name in ("repeats", "seconds", "warm_up", "rate_hz")},
        "sizes": _SIZES,
        "definitions": DEFINITIONS,
        "scheduling": {
            name: f"SCHED_FIFO {level}, idle processors kept awake" if level else "SCHED_OTHER"
            for name, level in SCHEDULING.items()
        },
        "notes": notes,
        "host": {**host(), "load_before": round(load_before, 2)},
        "pinned_to": list(processors()),
        "versions": versions(rules.pyrtcao),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "command_line": shlex.join(["python", "-m", "benchmarks.peers", *words]),
    }


def versions(pyrtcao: str) -> dict[str, str]:
    """Of the packages in the contest; pyrtcao's where it is installed."""
    found = {name: importlib.metadata.version(name) for name in ("lowfc", "eclipse-zenoh", "numpy")}
    asked = "import importlib.metadata as m; print(m.version('pyrtcao'))"
    try:
        done = subprocess.run([pyrtcao, "-c", asked], capture_output=True, text=True, check=False)  # noqa: S603
    except OSError:
        return found
    return found if done.returncode else found | {"pyrtcao": done.stdout.strip()}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--seconds", type=float, default=8.0, help="measured of each run (%(default)g)")
    parser.add_argument("--repeats", type=int, default=5, help="of everything (%(default)s)")
    parser.add_argument("--warm-up", type=int, default=500, help="frames before (%(default)s)")
    parser.add_argument("--rate", dest="rate_hz", type=float, default=1000.0, help="frames per second (%(default)g)")
    parser.add_argument("--only", action="append", metavar="WORD", help="contestants with this in their name; repeat")
    parser.add_argument("--pyrtcao", default=sys.executable, metavar="PYTHON", help="an interpreter that has pyrtcao")
    add_forms(parser)
    parser.add_argument("--render", type=Path, metavar="JSON", help="measure nothing: print what is in this file")
    return parser


if __name__ == "__main__":
    run_main(main)
