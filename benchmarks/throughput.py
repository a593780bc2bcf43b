"""The highest rate that the closed loop sustains, and the processor time of its processes there.

A run sustains a rate if at most one frame in a thousand is without a command, the recorder loses no message, and the
frame rate is within 1 % of the requested one. A rate is sustained if two of up to three runs sustain it. The highest
such rate of a geometric grid is found by bisection. `lowfc latency` runs the loops. Its results leave out the first
half second, but the counts of lost messages and late commands include it.

Example:
    python -m benchmarks throughput
    python -m benchmarks throughput --seconds 2 --lowest 1000 --highest 4000 --loop "prepared frames"
"""

import argparse
import math
import shlex
from bisect import bisect_left
from collections.abc import Callable, Sequence

from benchmarks.load import run_lowfc
from benchmarks.runner import Lines, Report, Result, add_times
from lowfc.contract.errors import ConfigurationError

LOOPS = {
    "simulated camera, recorder": ["--camera", "simulated", "--record"],
    "simulated camera": ["--camera", "simulated"],
    "prepared frames, recorder": ["--record"],
    "prepared frames": [],
    "prepared frames, fused": ["--kernel", "fused"],
}
"""Options of `lowfc latency` for each loop."""
MAX_WITHOUT_COMMAND = 0.001
RATE_TOLERANCE = 0.01
COMMON_HZ = 1000.0
"""Rate at which the processor times of all loops are compared."""

_ROLES = ("camera", "controller", "mirror", "recorder")


def options(parser: argparse.ArgumentParser) -> None:
    """Add the grid of rates and the loops."""
    add_times(parser, seconds=10.0)
    parser.add_argument("--lowest", type=float, default=500.0, help="lowest rate of the grid, Hz (%(default)g)")
    parser.add_argument("--highest", type=float, default=10_000.0, help="upper end of the grid, Hz (%(default)g)")
    parser.add_argument("--step", type=float, default=1.1, help="ratio of one rate to the one before (%(default)g)")
    parser.add_argument("--loop", action="append", choices=LOOPS, help="only this loop; the option may be repeated")


def measure(options: argparse.Namespace, report: Report) -> Result:
    """Find the highest rate of each loop: loops (results of `highest_rate`), seconds and rates_hz."""
    if not (0 < options.lowest <= options.highest < math.inf and options.step > 1):
        raise ConfigurationError("--lowest must be above 0 and at most --highest, which is finite; --step above 1")
    rates = grid(options.lowest, options.highest, options.step)
    loops = {}
    for name in options.loop or LOOPS:
        report(name)
        loops[name] = highest_rate(LOOPS[name], rates, options.seconds, report)
    return {"loops": loops, "seconds": options.seconds, "rates_hz": rates}


def run_once(loop_options: Sequence[str], rate_hz: float, seconds: float) -> Result:
    """Run a loop once with these options of `lowfc latency`.

    `failure` has the last line of its standard error, or the timeout, if it failed. messages_lost is None without a
    recorder. commands_late_fraction is the number of late commands over the number of frames, warm-up included; only
    with a simulated camera.
    """
    found = run_lowfc(["latency", *loop_options, "--rate", f"{rate_hz:g}"], seconds)
    if "failure" in found:
        return {"requested_hz": rate_hz, "failure": found["failure"]}
    values = {
        "requested_hz": rate_hz,
        "rate_hz": found["rate_hz"],
        "frames": found["frames"],
        "without_command": found["frames_without_command"],
        "messages_lost": found["messages_lost"],
        "frame_to_command_us": {name: found["latency_us"]["frame_to_command"][name] for name in ("p50", "p99")},
        "usage": found["usage"],
    }
    if found["commands_late"] is not None:
        values["commands_late_fraction"] = found["commands_late"] / (found["frames"] + found["warm_up_frames"])
    return values


def complaints(run: Result) -> list[str]:
    """Why this rate was not sustained; empty if it was."""
    if "failure" in run:
        return [run["failure"]]
    reasons = []
    if abs(run["rate_hz"] - run["requested_hz"]) > RATE_TOLERANCE * run["requested_hz"]:
        reasons.append(f"{run['rate_hz']:.0f} frames a second")
    if run["without_command"] > MAX_WITHOUT_COMMAND * run["frames"]:
        reasons.append(f"{100 * run['without_command'] / run['frames']:.2g} % of the frames without a command")
    if run["messages_lost"]:
        reasons.append(f"{run['messages_lost']} messages lost")
    return reasons


def grid(lowest_hz: float, highest_hz: float, step: float) -> list[float]:
    """Rates, Hz, from the lowest up to at most the highest, each `step` times the one before."""
    count = math.floor(math.log(highest_hz / lowest_hz) / math.log(step) + 1e-9)
    return [round(lowest_hz * step**index) for index in range(count + 1)]


def search(sustains: Callable[[int], bool], count: int) -> int:
    """Index of the highest of `count` rates sustained in two of three runs, by bisection; -1 for none."""

    def fails(index: int) -> bool:
        first, second = sustains(index), sustains(index)
        return not (first if first == second else sustains(index))

    return bisect_left(range(count), True, key=fails) - 1


def highest_rate(loop_options: Sequence[str], rates: Sequence[float], seconds: float, report: Report) -> Result:
    """Find the highest rate of one loop.

    highest_hz: None if not even the lowest is sustained; run: a sustained run at that rate; above: a run one step
    faster that was not sustained (None at the end of the grid); compared: a run at `COMMON_HZ`.
    """
    command = shlex.join(["lowfc", "latency", *loop_options])
    runs: list[Result] = []

    def sustains(index: int) -> bool:
        report(f"{command}: {rates[index]:g} Hz")
        runs.append(run_once(loop_options, rates[index], seconds))
        return not complaints(runs[-1])

    def run_at(index: int, *, sustained: bool) -> Result | None:
        if not 0 <= index < len(rates):
            return None
        at_rate = (run for run in runs if run["requested_hz"] == rates[index])
        return next((run for run in at_rate if sustained is not bool(complaints(run))), None)

    index = search(sustains, len(rates))
    report(f"{command}: {COMMON_HZ:g} Hz")
    return {
        "command": command,
        "highest_hz": rates[index] if index >= 0 else None,
        "run": run_at(index, sustained=True),
        "above": run_at(index + 1, sustained=False),
        "compared": run_once(loop_options, COMMON_HZ, seconds),
        "runs": runs,
    }


HEADINGS = (
    "loop",
    "highest rate, Hz",
    "frame to command p50, us",
    "frame to command p99, us",
    "commands late",
    "why the next rate fails",
)
USE_HEADINGS = ("loop", "rate, Hz", *_ROLES, "by processor")


def tables(result: Result) -> list[Lines]:
    """Tables of rates and of processor time."""
    rates, use = [list(HEADINGS)], [list(USE_HEADINGS)]
    for name, loop in result["loops"].items():
        run, above = loop["run"], loop["above"]
        why = "not tried" if above is None else f"{above['requested_hz']:g} Hz: {', '.join(complaints(above))}"
        rates.append([name, "none" if run is None else f"{loop['highest_hz']:g}", *_latency(run), why])
        use += [_use(name, one) for one in (run, loop["compared"]) if one is not None]
    return [rates, use]


def _latency(run: Result | None) -> list[str]:
    if run is None:
        return [""] * 3
    late = f"{100 * run['commands_late_fraction']:.3g} %" if "commands_late_fraction" in run else ""
    return [*(f"{run['frame_to_command_us'][name]:.0f}" for name in ("p50", "p99")), late]


def _use(name: str, run: Result) -> list[str]:
    used = run.get("usage", {})
    by_processor: dict[str, float] = {}
    for one in used.values():
        if one["processors"].isdecimal():
            by_processor[one["processors"]] = by_processor.get(one["processors"], 0) + 100 * one["share"]
    each = [used.get(role) for role in _ROLES]
    cells = [f"{100 * one['share']:.0f} % ({one['processors']})" if one else "" for one in each]
    sums = ", ".join(f"{where}: {share:.0f} %" for where, share in sorted(by_processor.items()))
    return [name, f"{run['requested_hz']:.0f}", *cells, sums]


def about(result: Result) -> str:
    """Definitions of the measured quantities."""
    rates = result["rates_hz"]
    runs = sum(len(loop["runs"]) for loop in result["loops"].values())
    return (
        f"Sustained over {result['seconds']:g} s: at most {100 * MAX_WITHOUT_COMMAND:g} % of the frames without a "
        f"command, no message lost by the recorder, the rate within {100 * RATE_TOLERANCE:g} % of the requested one; "
        f"{runs} runs on a grid of {len(rates)} rates from {rates[0]:g} to {rates[-1]:g} Hz. Latencies are of one "
        "sustained run at the highest rate. A command is late if it arrives after the start of the next exposure "
        "(known for the simulated camera). The second table has the processor time of each process, all its threads, "
        "in per cent of one processor, over the last four fifths of a run; the processors that it may run on are in "
        "brackets. The last column is the sum of the processes bound to one processor."
    )
