"""Compare the verdicts of several logs and the residual of every mode in nm rms of wavefront.

Example: python examples/compare_nights.py logs/20270101T220000Z.mcap logs/20270102T220000Z.mcap
"""

import json
import subprocess
import sys
from typing import Any


def report(log: str) -> dict[str, Any]:
    """Return the output of `lowfc report LOG --json`."""
    command = [sys.executable, "-m", "lowfc", "report", log, "--json"]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE)  # noqa: S603  # this Python's own lowfc
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def rows(nights: list[dict[str, Any]]) -> dict[str, list[str]]:
    """Return the texts of all nights in their order, by the name of the quantity."""
    found: dict[str, list[str]] = {}
    for index, night in enumerate(nights):
        texts = {"verdict": night["verdict"]["heading"]}
        texts |= {check["name"]: check["text"] for check in night["verdict"]["checks"]}
        for mode in night["residual"]["modes"]:
            residual_nm = mode["residual_rms_nm"] if mode["residual_rms_nm"] is not None else mode["error_rms_nm"]
            texts[f"Z{mode['noll']} {mode['name']}, nm"] = "-" if residual_nm is None else f"{residual_nm:.2f}"
        for name, text in texts.items():
            found.setdefault(name, ["-"] * len(nights))[index] = text
    return found


if __name__ == "__main__":
    for name, texts in rows([report(log) for log in sys.argv[1:]]).items():
        sys.stdout.write(f"{name}\n" + "".join(f"    {text}\n" for text in texts))
