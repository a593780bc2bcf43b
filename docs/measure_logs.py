"""Measure recording and replay on this host and put the table into docs/logs.md; takes a quarter of an hour and 10 GB.

Example:
    python docs/measure_logs.py            # records, replays, writes docs/logs.json and the table of docs/logs.md
    python docs/measure_logs.py --render   # the table again from docs/logs.json
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from measure import ROOT, command_line, host

MEASURED = ROOT / "docs" / "logs.json"
DOCUMENT = ROOT / "docs" / "logs.md"

LOOP = ["sim-loop", "--rate", "1000", "--disturbance", "reaction-wheel", "--json", "--duration"]
SECONDS = ("60", "600")


def measure() -> dict[str, Any]:
    """Record at several rates; record a minute and ten, and replay them on one processor and on all."""
    found: dict[str, Any] = {"host": host(), "loop": ["lowfc", *LOOP], "logs": {}}
    with tempfile.TemporaryDirectory() as folder:
        found["recording"], _ = lowfc(folder, "bench", "record", "--json")
        for seconds in SECONDS:
            run, _ = lowfc(folder, *LOOP, seconds)
            alone, alone_bytes = lowfc(folder, "replay", "--jobs", "1", "--json", *run["logs"])
            together, _ = lowfc(folder, "replay", "--json", *run["logs"])
            logs = [Path(folder) / log for log in run["logs"]]
            found["logs"][seconds] = {
                "log_bytes": sum(log.stat().st_size for log in logs),
                **{key: run[key] for key in ("messages_recorded", "messages_lost", "frames_processed")},
                **{key: alone[key] for key in ("frames", "commands", "states", "unchecked", "identical")},
                "largest_difference_nm": alone["largest_difference_nm"],
                "replay_bytes": alone_bytes,
                "speed_one": alone["speed"],
                "speed_all": together["speed"],
            }
            for log in logs:
                log.unlink()
    return found


def lowfc(folder: str, *words: str) -> tuple[dict[str, Any], int]:
    """What a command prints with --json, and the most memory that it took."""
    process = subprocess.Popen([sys.executable, "-m", "lowfc", *words], cwd=folder, stdout=subprocess.PIPE, text=True)
    said = process.stdout.read() if process.stdout else ""
    _, status, used = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"lowfc {' '.join(words)} failed")
    figures: dict[str, Any] = json.loads(said)
    return figures, used.ru_maxrss * 1024


def render(measured: dict[str, Any]) -> str:
    """The tables in Markdown, with the host they were measured on."""
    rows = [
        "| recorded at 1 kHz | log | messages | lost | steps replayed | unchecked | largest difference "
        "| replayed, one process | all processors | memory, one process |",
        "|---" * 10 + "|",
    ]
    for seconds, log in measured["logs"].items():
        rows.append(
            f"| {seconds} s | {log['log_bytes'] / 1e6:.0f} MB | {log['messages_recorded']} | {log['messages_lost']} "
            f"| {log['frames']} of {log['frames_processed']} | {log['unchecked']} "
            f"| {log['largest_difference_nm']:g} nm "
            f"| {log['speed_one']:.1f} x | {log['speed_all']:.1f} x | {log['replay_bytes'] / 1e6:.0f} MB |"
        )
    rows += [
        "",
        "| recorder at | processor | of copying the payloads | messages | lost | longest wait | until flushed "
        "| longest write |",
        "|---" * 8 + "|",
    ]
    rows += [
        f"| {rate['offered_hz']:.0f} Hz | {100 * rate['cpu_share']:.0f} % | {rate['ratio']:.0f} x "
        f"| {rate['messages_published']} | {rate['messages_lost']} | {rate['longest_wait_ms']:.0f} ms "
        f"| {rate['longest_unflushed_ms']:.0f} ms | {rate['longest_write_ms']:.1f} ms |"
        for rate in measured["recording"]["rates"]
    ]
    about = measured["host"]
    where = (
        "Replay is in times as fast as it was. The recorder's share is of one processor, all its threads; waits are "
        "from a message's arrival to its being written, and to its surviving a kill. "
        f"Measured {about['date']} on {about['processors']} cores of {about['processor']} (a virtual machine, Linux "
        f"{about['kernel']}, Python {about['python']}, load {about['load_before']} before) by "
        f"`python docs/measure_logs.py`, which runs `{' '.join(measured['loop'])} ...`, `lowfc replay` and "
        "`lowfc bench record`."
    )
    return "\n".join([*rows, "", where, ""])


if __name__ == "__main__":
    command_line(__doc__, MEASURED, DOCUMENT, measure, render)
