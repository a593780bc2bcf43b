"""Tables of docs/measured/reliability.md: faults injected into the loop, hours of it, damaged inputs."""

from tempfile import TemporaryDirectory

from lowfc.programs.reliability.chaos.command import counts
from lowfc.programs.reliability.soak.figures import TOO_SHORT, latency_in_words, verdict
from tools.shared import Figures, columns, json_of, markdown

CHAOS = "lowfc chaos --all --seed N"
SEEDS = (1, 2, 3, 4, 5)


def chaos() -> Figures:
    """Every case once with every seed."""
    runs = []
    for seed in SEEDS:
        with TemporaryDirectory() as folder:
            cases = json_of(CHAOS.replace("N", str(seed)), folder)["cases"]
        runs.append({"seed": seed, **counts(cases), "cases": cases})
    return {"runs": runs}


def render_chaos(figures: Figures) -> str:
    """A line for each case, over all seeds, and one for each stall."""
    runs = figures["runs"]
    rows, stalls, steps_nm, recovered_s = [], [], [], []
    for cases in zip(*(run["cases"] for run in runs), strict=True):
        name, sentence = cases[0]["name"], cases[0]["sentence"]
        ended = counts(list(cases))
        why = f", {ended['skipped']} skipped ({cases[0]['skipped']})" if ended["skipped"] else ""
        found = [case["findings"].get("recovery", {}).get("found", "-") for case in cases]
        recovered = "; ".join(text.removeprefix("residual ").split(" nm,")[0] for text in found)
        rows.append((f"`{name}`", sentence, f"{ended['passed']} of {len(cases)}{why}", recovered))
        for each in (case["figures"] for case in cases):
            if "restart_step_nm" in each:
                steps_nm.append(each["restart_step_nm"])
            if name == "kill-controller" and "recovered_s" in each:
                recovered_s.append(each["recovered_s"])
            if "frame_to_command" in each:
                spans = ", ".join(f"{span['p99_us']:.0f}" for span in each["frame_to_command"].values())
                stalls.append((name.removeprefix("stall-"), spans, each.get("p99_during_over_calm", "-")))
    passed, failed, skipped = (sum(run[name] for run in runs) for name in ("passed", "failed", "skipped"))
    left_out = f", {skipped} skipped" if skipped else ""
    seeds = ", ".join(str(run["seed"]) for run in runs)
    parts = [
        f"{passed} of {passed + failed} passed{left_out}, seeds {seeds}.\n",
        markdown(("case", "what befalls the loop", "passed", "residual, nm rms: before -> after"), rows),
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
    if steps_nm:
        parts.append(
            f"Restarted controllers: {len(steps_nm)}; the first command of one moved an actuator by at most "
            f"{max(steps_nm):.1f} nm of surface.\n"
        )
    if recovered_s:
        parts.append(
            "Killed in closed loop and started anew, a controller had the residual back at most "
            f"{max(recovered_s):.2f} s after the first frame that it used ({len(recovered_s)} times).\n"
        )
    if stalls:
        head = (
            "stands still for 10 s",
            "frame to command, p99 us: before, during, after",
            "during over the mean of both",
        )
        parts.append(markdown(head, stalls))
    again = ", ".join(f"`{name}`" for name in figures.get("measured_again", ()))
    parts.append(f"Measured again after a change of what the case itself does: {again}." if again else "")
    return "\n".join(parts)


SOAK_COLUMNS = {
    "process": "{name}",
    "memory, MB: first -> last (most)": "{memory_first_mb:.1f} -> {memory_last_mb:.1f} ({memory_most_mb:.1f})",
    "MB per hour": "{growth}",
    "handles": "{handles_first} -> {handles_last} (most {handles_most})",
    "threads": "{threads_first} -> {threads_last}",
}
GROWTH = "{memory_mb_per_hour:+.2f} +- {memory_mb_per_hour_error:.2f}"


def render_soak(figures: Figures) -> str:
    """A line for each process."""
    rows = (
        one | {"name": name, "growth": TOO_SHORT if one["memory_mb_per_hour"] is None else GROWTH.format(**one)}
        for name, one in figures["processes"].items()
    )
    ended = "Nothing grew and nothing was lost." if figures["passed"] else f"{verdict(figures)}."
    return (
        f"{ended} {figures['hours']:g} h at {figures['rate_hz']:.0f} Hz: {figures['frames_published']} frames, "
        f"{figures['frames_skipped']} skipped, {figures['frames_missing']} missing; {figures['messages_recorded']} "
        f"messages in {figures['logs']} logs, {figures['messages_lost']} lost, {figures['gaps']} gaps. "
        f"Frame to command: {latency_in_words(figures['latency'])}.\n\n{columns(SOAK_COLUMNS, rows)}\n"
    )


def render_fuzz(figures: Figures) -> str:
    """A line for each decoder and reader."""
    head = ("what reads", "inputs", "refused", "crashes", "hangs", "memory grown, MB")
    rows, totals = [], [0, 0, 0]
    for one in figures["targets"]:
        counted = one["inputs"], len(one["crashes"]), len(one["hangs"])
        totals = [total + more for total, more in zip(totals, counted, strict=True)]
        rows.append((one["name"], counted[0], one["refused"], *counted[1:], f"{one['grown_bytes'] / 1e6:.0f}"))
    inputs, crashes, hangs = totals
    return (
        f"{inputs} inputs, {crashes} crashes, {hangs} hangs, in {figures['seconds'] / 60:.0f} minutes.\n\n"
        f"{markdown(head, rows)}\n"
    )
