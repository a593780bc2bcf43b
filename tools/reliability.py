"""Tables of docs/measured/reliability.md: injected faults, long runs, damaged inputs.

Example:
    python -m tools.reliability --seed 1              # run the chaos cases missing from the table, with this seed
    python -m tools.reliability --seed 1 kill-camera  # run this case again; `python -m tools.measure` makes the page
"""

import argparse
import json
from collections.abc import Sequence
from tempfile import TemporaryDirectory
from typing import Any

from lowfc.control.loop.wording import counted
from lowfc.programs.reliability.chaos.cases import CASES
from lowfc.programs.reliability.chaos.command import counts
from lowfc.programs.reliability.soak.evaluation import TOO_SHORT, latency_in_words, verdict
from tools.shared import ROOT, Results, formatted_table, host, host_in_words, json_of, markdown

CHAOS = "lowfc chaos --all --seed N"
SEEDS = (1, 2, 3, 4, 5)
CASES_FILE = ROOT / "tools" / "measured" / "chaos.json"
_STALL = ("before", "during", "after")
_PHASES = {
    "without": "not started",
    "flooded and frozen": "flooded and suspended (SIGSTOP)",
    "frozen": "suspended (SIGSTOP)",
    "flood without": "gone; flood continues",
}
"""Phases of the case `console`, as the page names them."""


def chaos() -> Results:
    """Every case once with every seed."""
    return {"runs": [{"seed": seed, **_run("--all", seed)} for seed in SEEDS]}


def _run(cases: str, seed: int) -> Results:
    with TemporaryDirectory() as folder:
        rows = json_of(f"lowfc chaos {cases} --seed {seed}", folder)["cases"]
    return {**counts(rows), "cases": rows}


def measure_again(results: Results, seed: int, names: Sequence[str]) -> Results:
    """Run the named cases with a seed, or all without a result; return all results of that seed."""
    run: Results = next(one for one in results["runs"] if one["seed"] == seed)
    kept = {case["name"]: case for case in run["cases"] if case["name"] in CASES}
    if missing := list(names) or [name for name in CASES if name not in kept]:
        about = host()
        new_cases = _run(" ".join(f"--case {name}" for name in missing), seed)["cases"]
        kept |= {case["name"]: {**case, "host": about} for case in new_cases}
    cases = list(kept.values())
    return run | counts(cases) | {"cases": cases}


def render_chaos(results: Results) -> str:
    """A table with a row for each case; tables of the latencies during stalls and with a console."""
    runs = results["runs"]
    all_cases = [case for run in runs for case in run["cases"]]
    by_name: dict[str, list[Results]] = {}
    for case in all_cases:
        by_name.setdefault(case["name"], []).append(case)
    passed, failed, skipped = (sum(run[name] for run in runs) for name in ("passed", "failed", "skipped"))
    skipped_text = f", {skipped} skipped" if skipped else ""
    seeds = ", ".join(str(run["seed"]) for run in runs)
    parts = [
        f"{passed} of {passed + failed} passed{skipped_text}, seeds {seeds}.\n",
        markdown(("case", "injected fault", "passed", "residual by seed, nm rms: before -> after"), _rows(by_name)),
    ]
    failures = [
        f"- `{case['name']}`, seed {run['seed']}: {rule}: {one['found']}"
        for run in runs
        for case in run["cases"]
        for rule, one in case["findings"].items()
        if not one["held"]
    ]
    if failures:
        parts.append("\n".join(["What failed:", "", *failures, ""]))
    if steps_nm := _measurements(all_cases, "restart_step_nm"):
        parts.append(
            f"The first command of a restarted controller moved an actuator by at most {max(steps_nm):.1f} nm of "
            f"surface ({len(steps_nm)} restarts).\n"
        )
    if recovered_s := _measurements(by_name.get("kill-controller", []), "recovered_s"):
        parts.append(
            "After a kill and restart in closed loop, the residual (rms over 50 frames) was within the recovery limit "
            f"{1e3 * max(recovered_s):.0f} ms after the controller's first used frame or earlier "
            f"({counted(len(recovered_s), 'restart')}).\n"
        )
    parts += [*_stalls(by_name), *_consoles(by_name.get("console", []))]
    again = ", ".join(f"`{name}`" for name in results.get("measured_again", ()))
    parts.append(f"Measured again after a change of the case itself: {again}." if again else "")
    hosts: dict[str, dict[str, list[int]]] = {}
    for run in runs:
        for case in run["cases"]:
            if "host" in case:
                hosts.setdefault(host_in_words(case["host"]), {}).setdefault(case["name"], []).append(run["seed"])
    for about, found in hosts.items():
        names = (f"`{name}` (seeds {', '.join(map(str, seeds))})" for name, seeds in found.items())
        parts.append(f"Measured {about} by `python -m tools.reliability`: {', '.join(names)}.")
    return "\n".join(parts)


def _recovery(found: str) -> str:
    """Residuals before and after a fault, from the text that the rule `recovery` found; release 0.1 wrote "safed"."""
    return found.removeprefix("residual ").split(" nm,")[0].replace("safed", "safe")


def _rows(by_name: dict[str, list[Results]]) -> list[Sequence[object]]:
    rows: list[Sequence[object]] = []
    for name, cases in by_name.items():
        ended = counts(cases)
        reason = next((case["skipped"] for case in cases if case["skipped"]), "")
        why = f", {ended['skipped']} skipped ({reason})" if reason else ""
        found = [case["findings"].get("recovery", {}).get("found", "-") for case in cases]
        recovered = "; ".join(_recovery(text) for text in found)
        description = CASES[name].description if name in CASES else cases[0]["sentence"]
        rows.append((f"`{name}`", description, f"{ended['passed']} of {len(cases)}{why}", recovered))
    return rows


def _measurements(cases: Sequence[Results], name: str) -> list[Any]:
    return [case["figures"][name] for case in cases if name in case["figures"]]


def _stalls(by_name: dict[str, list[Results]]) -> list[str]:
    rows = []
    for name, cases in by_name.items():
        for each in (case["figures"] for case in cases if name.startswith("stall-")):
            if "p99_during_over_calm" in each:  # a case that failed early lacks it
                spans = ", ".join(f"{each['frame_to_command'][span]['p99_us']:.0f}" for span in _STALL)
                rows.append((name.removeprefix("stall-"), spans, each["p99_during_over_calm"]))
    head = "stalled", "frame to command, p99, us: before, during, after", "during / mean of before and after"
    return [markdown(head, rows)] if rows else []


def _consoles(cases: Sequence[Results]) -> list[str]:
    """Latencies with a console, in the phases of its case, and the console's share of a processor."""
    each = [case["figures"] for case in cases if "console" in case["figures"]]
    if not each:
        return []
    rows = []
    for span in each[0]["frame_to_command"]:
        found = [one["frame_to_command"][span] for one in each if span in one["frame_to_command"]]
        rows.append(
            (_PHASES.get(span, span), *(", ".join(f"{one[key]:.0f}" for one in found) for key in ("p50_us", "p99_us")))
        )
    starts_s, shares = (sorted(one["console"][key] for one in each) for key in ("start_s", "share"))
    cost = (
        f"At 1 kHz a console displayed the loop at most {starts_s[-1]:.1f} s after its start, and used at most "
        f"{100 * shares[-1]:.0f} % of a processor ({counted(len(each), 'start')}).\n"
    )
    return [markdown(("the console is", "frame to command, p50, us, by seed", "p99, us, by seed"), rows), cost]


SOAK_COLUMNS = {
    "process": "{name}",
    "memory, MB: first -> last (largest)": "{memory_first_mb:.1f} -> {memory_last_mb:.1f} ({memory_most_mb:.1f})",
    "slope of memory, MB per hour": "{growth}",
    "handles: first -> last (largest)": "{handles_first} -> {handles_last} ({handles_most})",
    "threads: first -> last": "{threads_first} -> {threads_last}",
}
GROWTH = "{memory_mb_per_hour:+.2f} +- {memory_mb_per_hour_error:.2f}"


def render_soak(results: Results) -> str:
    """A row for each process."""
    rows = (
        one | {"name": name, "growth": TOO_SHORT if one["memory_mb_per_hour"] is None else GROWTH.format(**one)}
        for name, one in results["processes"].items()
    )
    ended = "No growth beyond these limits, no loss." if results["passed"] else f"{verdict(results)}."
    return (
        f"{ended} {results['hours']:g} h at {results['rate_hz']:.0f} Hz: {results['frames_published']} frames, "
        f"{results['frames_skipped']} skipped, {results['frames_missing']} missing; {results['messages_recorded']} "
        f"messages in {results['logs']} logs, {results['messages_lost']} lost, {results['gaps']} gaps. "
        f"Frame to command: {latency_in_words(results['latency'])}.\n\n{formatted_table(SOAK_COLUMNS, rows)}\n"
    )


def render_fuzz(results: Results) -> str:
    """A row for each decoder and reader."""
    head = ("reader", "inputs", "inputs refused with an error", "crashes", "hangs", "memory growth, MB")
    rows, totals = [], [0, 0, 0]
    for one in results["targets"]:
        numbers = one["inputs"], len(one["crashes"]), len(one["hangs"])
        totals = [total + more for total, more in zip(totals, numbers, strict=True)]
        rows.append((one["name"], numbers[0], one["refused"], *numbers[1:], f"{one['grown_bytes'] / 1e6:.0f}"))
    inputs, crashes, hangs = totals
    return (
        f"{inputs} inputs, {crashes} crashes, {hangs} hangs, in {results['seconds'] / 60:.0f} minutes.\n\n"
        f"{markdown(head, rows)}\nReaders that raise no error refuse damaged input with a reason or event, or return "
        "the readable part.\n"
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="CASE", help="case of `lowfc chaos`; default: all without a result")
    parser.add_argument("--seed", type=int, choices=SEEDS, required=True)
    options = parser.parse_args()
    if unknown := set(options.names) - set(CASES):
        parser.error(f"no case is called {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    run = measure_again(json.loads(CASES_FILE.read_text()), options.seed, options.names)
    results = json.loads(CASES_FILE.read_text())  # read again: another seed may have been measured meanwhile
    results["runs"] = [run if one["seed"] == options.seed else one for one in results["runs"]]
    CASES_FILE.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
