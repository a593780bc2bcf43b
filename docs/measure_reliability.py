"""Run the chaos cases, the soak and the fuzzing, and put the tables into docs/reliability.md.

Example:
    python docs/measure_reliability.py                    # all of it; goes on with the seeds that are missing
    python docs/measure_reliability.py --parts chaos      # chaos, soak, fuzz: what to measure, the rest stays
    python docs/measure_reliability.py --again frames-truncated  # after a change that is of this case alone
    python docs/measure_reliability.py --render           # the tables again from docs/reliability.json
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from measure import ROOT, host, put

from lowfc.programs.chaos.cases import CASES
from lowfc.programs.chaos.command import counts
from lowfc.programs.soak.figures import TOO_SHORT, told_latency, verdict

MEASURED = ROOT / "docs" / "reliability.json"
LOGS = ROOT / "logs" / "reliability"
DOCUMENT = ROOT / "docs" / "reliability.md"
SEEDS = (1, 2, 3, 4, 5)
HOURS = 0.5
INPUTS = 1_000_000


def chaos(seeds: tuple[int, ...], found: dict[str, Any], save: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Every case once with every seed; saved after each seed, so that another call goes on where one was interrupted.

    Two cases run at a time, but for the stalls, whose latencies are compared: a loop of 250 Hz leaves much of two
    processors idle, and what starts or is judged has no real-time priority.
    """
    source = source_of_the_loop()
    if not source or found.get("source") != source:
        found = {"host": host(), "command": "lowfc chaos --all --seed N", "source": source, "runs": []}
    alone = [name for name in CASES if name.startswith("stall-")]
    beside = [name for name in CASES if name not in alone]
    for seed in sorted({*seeds} - {run["seed"] for run in found["runs"]}):
        with ThreadPoolExecutor() as pool:
            rows = [row for half in pool.map(partial(cases, seed), (beside[::2], beside[1::2])) for row in half]
        rows = sorted(rows + cases(seed, alone), key=lambda row: list(CASES).index(row["name"]))
        found["runs"].append({"seed": seed, **counts(rows), "cases": rows})
        found["runs"].sort(key=lambda run: run["seed"])
        save(found)
    return found


def chaos_again(names: list[str], found: dict[str, Any]) -> dict[str, Any]:
    """These cases anew with every seed; the figures say which, and of what source."""
    for run in found["runs"]:
        anew = {row["name"]: row for row in cases(run["seed"], names)}
        run["cases"] = [anew.get(row["name"], row) for row in run["cases"]]
        run |= counts(run["cases"])
    found["again"] = found.get("again", {}) | dict.fromkeys(names, source_of_the_loop())
    return found


def cases(seed: int, names: list[str]) -> list[dict[str, Any]]:
    """What came of some cases; the logs of those that fail stay in logs/reliability/chaos-logs."""
    LOGS.mkdir(parents=True, exist_ok=True)
    words = [word for name in names for word in ("--case", name)]
    figures = _json([sys.executable, "-m", "lowfc", "chaos", *words, "--seed", str(seed)], LOGS)
    if len(figures["cases"]) < len(names):
        raise SystemExit(f"interrupted; of seed {seed} nothing is kept")
    rows: list[dict[str, Any]] = figures["cases"]
    return rows


def source_of_the_loop() -> str:
    """Which source the loop is of, whatever the documents say; empty where it is no commit's."""
    parts = ("lowfc", "sim_camera", "sim_dm")

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", ROOT, *words], capture_output=True, text=True, check=False).stdout  # noqa: S607

    return "" if git("status", "--porcelain", "--", *parts) else " ".join(git("ls-tree", "HEAD", *parts).split()[2::4])


def soak(hours: float) -> dict[str, Any]:
    """The loop for hours."""
    words = ["soak", "--hours", f"{hours:g}", "--json"]
    about = host()
    return {"host": about, "command": f"lowfc {' '.join(words[:-1])}"} | _json([sys.executable, "-m", "lowfc", *words])


def fuzz(inputs: int) -> dict[str, Any]:
    """Damaged inputs for every decoder and reader."""
    words = ["tests/fuzz/fuzzing.py", "--inputs", str(inputs)]
    about = host()
    return {"host": about, "command": f"python {' '.join(words)}"} | _json(
        [sys.executable, ROOT / words[0], *words[1:]]
    )


def _json(words: list[Any], folder: Path = ROOT) -> dict[str, Any]:
    """What a command prints, which leaves nothing in the folder; a case that failed is a result too."""
    if "--json" not in words:
        words = [*words, "--json"]
    done = subprocess.run(words, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def chaos_tables(measured: dict[str, Any]) -> str:
    """One line for each case, over all seeds, and the stalls."""
    runs = measured["runs"]
    rows = ["| case | what befalls the loop | passed | residual, nm rms: before -> after |", "|---|---|---|---|"]
    stalls = [
        "| stands still for 10 s | frame to command, p99 us: before, during, after | during over the mean of both |",
        "|---|---|---|",
    ]
    steps_nm, recovered_s = [], []
    for cases in zip(*(run["cases"] for run in runs), strict=True):
        name, sentence = cases[0]["name"], cases[0]["sentence"]
        ended = counts(list(cases))
        why = f", {ended['skipped']} skipped ({cases[0]['skipped']})" if ended["skipped"] else ""
        found = [case["findings"].get("recovery", {}).get("found", "-") for case in cases]
        recovered = "; ".join(text.removeprefix("residual ").split(" nm,")[0] for text in found)
        rows.append(f"| `{name}` | {sentence} | {ended['passed']} of {len(cases)}{why} | {recovered} |")
        for case in cases:
            if "restart_step_nm" in case["figures"]:
                steps_nm.append(case["figures"]["restart_step_nm"])
            if name == "kill-controller" and "recovered_s" in case["figures"]:
                recovered_s.append(case["figures"]["recovered_s"])
            if "frame_to_command" in case["figures"]:
                spans = case["figures"]["frame_to_command"].values()
                figures = ", ".join(f"{span['p99_us']:.0f}" for span in spans)
                ratio = case["figures"].get("p99_during_over_calm", "-")
                stalls.append(f"| {name.removeprefix('stall-')} | {figures} | {ratio} |")
    passed, failed, skipped = (sum(run[name] for run in runs) for name in ("passed", "failed", "skipped"))
    failures = [
        f"- `{case['name']}`, seed {run['seed']}: {rule}: {one['found']}"
        for run in runs
        for case in run["cases"]
        for rule, one in case["findings"].items()
        if not one["held"]
    ]
    left_out = f", {skipped} skipped" if skipped else ""
    seeds = ", ".join(str(run["seed"]) for run in runs)
    text = [f"{passed} of {passed + failed} passed{left_out}, seeds {seeds}.", "", *rows, ""]
    if failures:
        text += ["What failed:", "", *failures, ""]
    if steps_nm:
        text += [
            f"Restarted controllers: {len(steps_nm)}; the first command of one moved an actuator by at most "
            f"{max(steps_nm):.1f} nm of surface.",
            "",
        ]
    if recovered_s:
        text += [
            "Killed in closed loop and started anew, a controller had the residual back at most "
            f"{max(recovered_s):.2f} s after the first frame that it used ({len(recovered_s)} times).",
            "",
        ]
    if len(stalls) > 2:
        text += [*stalls, ""]
    again = ", ".join(f"`{name}`" for name in measured.get("again", {}))
    later = f" Measured again after a change of what the case itself does: {again}." if again else ""
    return "\n".join([*text, where(measured) + later, ""])


def soak_table(measured: dict[str, Any]) -> str:
    """A line for each process."""
    rows = [
        "| process | memory, MB: first -> last (most) | MB per hour | handles | threads |",
        "|---|---|---|---|---|",
    ]
    for name, one in measured["processes"].items():
        rows.append(
            f"| {name} | {one['memory_first_mb']:.1f} -> {one['memory_last_mb']:.1f} ({one['memory_most_mb']:.1f}) "
            f"| {per_hour(one)} "
            f"| {one['handles_first']} -> {one['handles_last']} (most {one['handles_most']}) "
            f"| {one['threads_first']} -> {one['threads_last']} |"
        )
    ended = "Nothing grew and nothing was lost." if measured["passed"] else f"{verdict(measured)}."
    text = (
        f"{ended} {measured['hours']:g} h at {measured['rate_hz']:.0f} Hz: {measured['frames_published']} frames, "
        f"{measured['frames_skipped']} skipped, {measured['frames_missing']} missing; {measured['messages_recorded']} "
        f"messages in {measured['logs']} logs, {measured['messages_lost']} lost, {measured['gaps']} gaps. "
        f"Frame to command: {told_latency(measured['latency'])}."
    )
    return "\n".join([text, "", *rows, "", where(measured), ""])


def per_hour(one: dict[str, Any]) -> str:
    """How a process's memory changes."""
    slope_mb, error_mb = one["memory_mb_per_hour"], one["memory_mb_per_hour_error"]
    return TOO_SHORT if slope_mb is None else f"{slope_mb:+.2f} +- {error_mb:.2f}"


def fuzz_table(measured: dict[str, Any]) -> str:
    """A line for each decoder and reader."""
    targets = measured["targets"]
    rows = ["| what reads | inputs | refused | crashes | hangs | memory grown, MB |", "|---|---|---|---|---|---|"]
    rows += [
        f"| {one['name']} | {one['inputs']} | {one['refused']} | {len(one['crashes'])} | {len(one['hangs'])} "
        f"| {one['grown_bytes'] / 1e6:.0f} |"
        for one in targets
    ]
    totals = [sum(one["inputs"] for one in targets)]
    totals += [sum(len(one[name]) for one in targets) for name in ("crashes", "hangs")]
    text = f"{totals[0]} inputs, {totals[1]} crashes, {totals[2]} hangs, in {measured['seconds'] / 60:.0f} minutes."
    return "\n".join([text, "", *rows, "", where(measured), ""])


def where(measured: dict[str, Any]) -> str:
    """On which host, by which command."""
    about = measured["host"]
    return (
        f"Measured {about['date']} on {about['processors']} cores of {about['processor']} (a virtual machine, Linux "
        f"{about['kernel']}, Python {about['python']}, load {about['load_before']} before) by `{measured['command']}`."
    )


PARTS: dict[str, Callable[[dict[str, Any]], str]] = {"chaos": chaos_tables, "soak": soak_table, "fuzz": fuzz_table}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--render", action="store_true", help=f"use {MEASURED.relative_to(ROOT)} as it is")
    parser.add_argument("--parts", nargs="+", choices=[*PARTS], default=[*PARTS])
    parser.add_argument("--seeds", nargs="+", type=int, default=[*SEEDS])
    parser.add_argument("--again", nargs="+", choices=[*CASES], help="only these chaos cases, with the seeds there are")
    parser.add_argument("--hours", type=float, default=HOURS)
    parser.add_argument("--inputs", type=int, default=INPUTS)
    asked = parser.parse_args()
    measured: dict[str, Any] = json.loads(MEASURED.read_text()) if MEASURED.exists() else {}

    def save(part: str, found: dict[str, Any]) -> None:
        measured[part] = found
        MEASURED.write_text(json.dumps(measured, indent=1) + "\n")

    measure: dict[str, Callable[[], dict[str, Any]]] = {
        "chaos": lambda: chaos(tuple(asked.seeds), measured.get("chaos", {}), partial(save, "chaos")),
        "soak": lambda: soak(asked.hours),
        "fuzz": lambda: fuzz(asked.inputs),
    }
    if asked.again:
        save("chaos", chaos_again(asked.again, measured["chaos"]))
    for part in () if asked.render or asked.again else asked.parts:
        save(part, measure[part]())
    for part, render in PARTS.items():
        table = render(measured[part]) if part in measured else "Not measured yet.\n"
        put(DOCUMENT, table, f"<!-- {part}: begin -->\n", f"<!-- {part}: end -->")


if __name__ == "__main__":
    main()
