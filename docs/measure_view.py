"""Measure what a view costs on this host and put the tables into docs/performance.md; takes half an hour.

Example:
    python docs/measure_view.py            # measures, writes docs/view.json and the tables of docs/performance.md
    python docs/measure_view.py --render   # the tables again from docs/view.json
"""

import json
import subprocess
import sys
from typing import Any

from measure import ROOT, host, put

MEASURED = ROOT / "docs" / "view.json"
DOCUMENT = ROOT / "docs" / "performance.md"
BEGIN, END = "<!-- view: begin -->\n", "<!-- view: end -->"
COMMANDS = {"beside": ["bench", "view", "--seconds", "4", "--json"], "hour": ["bench", "view", "--hour", "--json"]}


def measure() -> dict[str, Any]:
    """Run the bench beside a loop, then over an hour of traffic; keep what `--json` prints."""
    found: dict[str, Any] = {"host": host(), "commands": {}}
    for name, words in COMMANDS.items():
        done = subprocess.run([sys.executable, "-m", "lowfc", *words], stdout=subprocess.PIPE, text=True, check=True)
        found["commands"][name] = " ".join(["lowfc", *words])
        found[name] = json.loads(done.stdout)
    return found


def render(measured: dict[str, Any]) -> str:
    """The tables in Markdown, with the host they were measured on."""
    beside, hour, about = measured["beside"], measured["hour"], measured["host"]
    view, alone, run = beside["view"], beside["view_alone"], beside["run"]
    rows = [
        "| the view is | p50, us | of off | difference, us | less than the spread | p99, us | of off | difference, us "
        "| less than the spread | frames | skipped or missing | messages lost |",
        "|---" * 12 + "|",
    ]
    for phase, found in beside["phases"].items():
        columns = " ".join(f"| {course(found[percentile])}" for percentile in ("p50_us", "p99_us"))
        dropped = found["frames_skipped"] + found["frames_missing"]
        rows.append(f"| {phase} {columns} | {found['frames']} | {dropped} | {found['messages_lost']} |")
    spreads = ", ".join(
        f"{name} {'not known' if us is None else f'{us:.0f} us'}" for name, us in beside["spread_us"].items()
    )
    rows += [
        "",
        f"Frame to command at {beside['rate_hz']:g} Hz: the median over {beside['repeats']} times "
        f"{beside['seconds']:g} s, and from the lowest to the highest of them. The run-to-run spread, the range of the "
        f"times without a view, is {spreads}. In the whole run, changes between phases included, "
        f"{run['frames_skipped'] + run['frames_missing']} of {run['frames_published']} frames were skipped or missing, "
        f"and {run['messages_lost']} of {run['messages_lost'] + run['messages_recorded']} messages lost.",
        "",
        "| process | share of one processor, alone | beside the loop | memory | most in the hour | bound "
        "| growth over its second half |",
        "|---" * 7 + "|",
    ]
    for name, title in (("bridge", "the view"), ("viewer", "its viewer, serving")):
        memory = hour[name]
        rows.append(
            f"| {title} | {alone[f'{name}_cpu_percent']:.1f} % | {view[f'{name}_cpu_percent']:.1f} % "
            f"| {view[f'{name}_mb']:.0f} MB "
            f"| {memory['most_mb']:.0f} MB | {memory['bound_mb']:.0f} MB "
            f"| {memory['growth_mb_per_hour']:.1f} MB per hour |"
        )
    where = (
        f"Alone: the log of this loop is published at its own rate, and {alone['moments_hz']:.0f} moments a second are "
        f'drawn. Beside the loop: in the phase "on", in which loop and recorder leave it processor time for '
        f"{view['moments_hz']:.0f} a second; it began anew {view['renewals']} times. The hour is "
        f"{hour['traffic_s']:.0f} s of traffic, {hour['messages']} messages, drawn in {hour['took_s']:.0f} s; the "
        "view's memory has in it the log that is played. The viewer is told to keep "
        f"{hour['viewer_limit_mb']:.0f} MB, as it counts. Granted by the host: "
        f"{', '.join(run['realtime_granted']) or 'nothing'}. "
        f"Measured {about['date']} on {about['processors']} cores of {about['processor']} (a virtual machine, Linux "
        f"{about['kernel']}, Python {about['python']}, load {about['load_before']} before) by "
        f"`python docs/measure_view.py`, which runs `{measured['commands']['beside']}` and "
        f"`{measured['commands']['hour']}`."
    )
    return "\n".join([*rows, "", where, ""])


def course(found: dict[str, Any]) -> str:
    """Four columns of one percentile in one phase."""
    within = {None: "", True: "yes", False: "no"}[found["within_spread"]]
    return (
        f"{found['median']:.0f} ({found['lowest']:.0f} to {found['highest']:.0f}) | {found['ratio']:.3f} "
        f"| {found['difference']:+.0f} | {within}"
    )


if __name__ == "__main__":
    if "--render" not in sys.argv:
        MEASURED.write_text(json.dumps(measure(), indent=1) + "\n")
    put(DOCUMENT, render(json.loads(MEASURED.read_text())), BEGIN, END)
