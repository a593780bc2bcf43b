"""The highest rate that the closed loop sustains, and what its processes use of the processors there.

A rate is sustained where at most one frame in a thousand is without a command, the recorder loses no message, and the
frames come within 1 % as fast as asked for. It is looked for on a geometric grid: by halves with one run each, then
around the edge with the majority of up to three, until a rate that holds stands beside one that does not. The loops are
those of `lowfc latency`, which leaves the first half second out, except of what the recorder lost and of late commands.

Example:
    python -m benchmarks throughput --markdown
    python -m benchmarks throughput --seconds 2 --lowest 1000 --highest 4000 --way "prepared frames"
"""

import argparse
import math
import shlex
from collections.abc import Callable, Sequence

from benchmarks.load import run_lowfc
from benchmarks.runner import Lines, Result, Tell, add_times
from lowfc.contract.errors import ConfigurationError

WAYS = {
    "simulated camera, recorder": ["--camera", "simulated", "--record"],
    "simulated camera": ["--camera", "simulated"],
    "prepared frames, recorder": ["--record"],
    "prepared frames": [],
}
"""What is searched for its highest rate, and the options of `lowfc latency` for it."""
FREE_RUNNING = {"free-running, recorder": ["--free-running", "--record"], "free-running": ["--free-running"]}
"""What finds its rate by itself: the next frame as soon as the last one's command is back."""

MOST_WITHOUT = 0.001
"""Part of the frames that may be without a command."""
RATE_WITHIN = 0.01
COMPARED_HZ = 1000.0

_ROLES = ("camera", "controller", "mirror", "recorder")


def options(parser: argparse.ArgumentParser) -> None:
    """The grid of rates, and which loops."""
    add_times(parser, seconds=10.0)
    parser.add_argument("--lowest", type=float, default=500.0, help="rate of the grid, Hz (%(default)g)")
    parser.add_argument("--highest", type=float, default=10_000.0, help="rate of the grid, Hz (%(default)g)")
    parser.add_argument("--step", type=float, default=1.1, help="from one rate to the next (%(default)g times)")
    parser.add_argument("--way", action="append", choices=[*WAYS, *FREE_RUNNING], help="only this one; repeat")


def measure(asked: argparse.Namespace, tell: Tell) -> Result:
    """Look for the highest rate of each way.

    Returns:
        ways (of each what `find` returns), free_running (of each what `run_once` returns), seconds and rates_hz.
    """
    if not (0 < asked.lowest <= asked.highest and asked.step > 1):
        raise ConfigurationError("--lowest must be above 0 and at most --highest, and --step above 1")
    rates = grid(asked.lowest, asked.highest, asked.step)
    ways, free = {}, {}
    for name in asked.way or [*WAYS, *FREE_RUNNING]:
        tell(name)
        if name in FREE_RUNNING:
            free[name] = run_once(FREE_RUNNING[name], None, asked.seconds)
        else:
            ways[name] = find(WAYS[name], rates, asked.seconds, tell)
    return {"ways": ways, "free_running": free, "seconds": asked.seconds, "rates_hz": rates}


def run_once(words: Sequence[str], rate_hz: float | None, seconds: float) -> Result:
    """Run a loop once.

    Args:
        words: options of `lowfc latency`; see `WAYS`.
        rate_hz: asked for; None where there is no schedule.
        seconds: of frames.

    Returns:
        asked_hz, rate_hz, frames, without_command, messages_lost (None without a recorder), frame_to_command_us (p50,
        p99), commands_late (part of them all, of a simulated camera), usage (see `shares`); or failure, what the
        command said last.
    """
    rate = [] if rate_hz is None else ["--rate", f"{rate_hz:g}"]
    found = run_lowfc(["latency", *words, *rate], seconds)
    if "failure" in found:
        return {"asked_hz": rate_hz, "failure": found["failure"]}
    own = {
        "asked_hz": rate_hz,
        "rate_hz": found["rate_hz"],
        "frames": found["frames"],
        "without_command": found["frames_without_command"],
        "messages_lost": found["messages_lost"],
        "frame_to_command_us": {name: found["latency_us"]["frame_to_command"][name] for name in ("p50", "p99")},
        "usage": found["usage"],
    }
    if found["commands_late"] is not None:
        own["commands_late"] = found["commands_late"] / (found["frames"] + found["warm_up_frames"])
    return own


def complaints(run: Result) -> list[str]:
    """Why this rate was not sustained; none where it was."""
    if "failure" in run:
        return [run["failure"]]
    found = []
    if abs(run["rate_hz"] - run["asked_hz"]) > RATE_WITHIN * run["asked_hz"]:
        found.append(f"{run['rate_hz']:.0f} frames a second")
    if run["without_command"] > MOST_WITHOUT * run["frames"]:
        found.append(f"{100 * run['without_command'] / run['frames']:.2g} % of the frames without a command")
    if run["messages_lost"]:
        found.append(f"{run['messages_lost']} messages lost")
    return found


def grid(lowest_hz: float, highest_hz: float, step: float) -> list[float]:
    """Rates from the lowest on, each this many times the last, up to the highest."""
    count = math.floor(math.log(highest_hz / lowest_hz) / math.log(step) + 1e-9)
    return [round(lowest_hz * step**index) for index in range(count + 1)]


def search(sustains: Callable[[int], bool], count: int) -> int:
    """Place of the last rate of `count` that is sustained, taking it that slower ones are too; -1 for none.

    By halves with one verdict each; then the majority of up to three decides on either side of the edge found, which
    moves by one until the rate below it holds and that above it does not.
    """
    votes: list[list[bool]] = [[] for _ in range(count)]

    def ask(place: int) -> bool:
        votes[place].append(sustains(place))
        return votes[place][-1]

    def settled(place: int) -> bool:
        while max(votes[place].count(True), votes[place].count(False)) < 2:
            ask(place)
        return votes[place].count(True) >= 2

    low, high = -1, count
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if ask(middle) else (low, middle)
    while low >= 0 and not settled(low):
        low -= 1
    while low + 1 < count and settled(low + 1):
        low += 1
    return low


def find(words: Sequence[str], rates: Sequence[float], seconds: float, tell: Tell) -> Result:
    """Look for the highest rate of one way.

    Returns:
        command, highest_hz (None where not even the lowest is sustained), at_highest (a sustained run there), above (a
        run that was not, one step faster; None where the grid ends), compared (a run at `COMPARED_HZ`) and all runs.
    """
    command = shlex.join(["lowfc", "latency", *words])
    runs: list[Result] = []

    def sustains(place: int) -> bool:
        tell(f"{command}: {rates[place]:g} Hz")
        runs.append(run_once(words, rates[place], seconds) | {"place": place})
        return not complaints(runs[-1])

    place = search(sustains, len(rates))
    tell(f"{command}: {COMPARED_HZ:g} Hz")
    return {
        "command": command,
        "highest_hz": rates[place] if place >= 0 else None,
        "at_highest": next((run for run in runs if run["place"] == place and not complaints(run)), None),
        "above": next((run for run in runs if run["place"] == place + 1 and complaints(run)), None),
        "compared": run_once(words, COMPARED_HZ, seconds),
        "runs": runs,
    }


HEADINGS = ("loop", "highest rate, Hz", "frame to command p50, us", "p99", "commands late", "one step faster")
USE_HEADINGS = ("loop", "at, Hz", *_ROLES, "on one processor")


def tables(result: Result) -> list[Lines]:
    """Rates, and what the processes used."""
    rates, use = [list(HEADINGS)], [list(USE_HEADINGS)]
    for name, way in result["ways"].items():
        run, above = way["at_highest"], way["above"]
        highest = "none" if run is None else f"{way['highest_hz']:g}"
        why = "not tried" if above is None else f"{above['asked_hz']:g} Hz: {', '.join(complaints(above))}"
        rates.append([name, highest, *_latency(run), why])
        use += [_use(name, one) for one in (run, way["compared"]) if one is not None]
    for name, run in result["free_running"].items():
        why = run.get("failure") or f"{run['without_command']} of {run['frames']} frames without a command" + (
            f", {run['messages_lost']} messages lost" if run["messages_lost"] is not None else ""
        )
        rates.append([name, f"{run['rate_hz']:.0f}" if "rate_hz" in run else "none", *_latency(run), why])
        use.append(_use(name, run))
    return [rates, use]


def _latency(run: Result | None) -> list[str]:
    if run is None or "frame_to_command_us" not in run:
        return [""] * 3
    late = f"{100 * run['commands_late']:.3g} %" if "commands_late" in run else ""
    return [*(f"{run['frame_to_command_us'][name]:.0f}" for name in ("p50", "p99")), late]


def _use(name: str, run: Result) -> list[str]:
    used = run.get("usage", {})
    rate_hz = run["asked_hz"] or run.get("rate_hz")
    together: dict[str, float] = {}
    found = []
    for role in _ROLES:
        if role not in used:
            found.append("")
            continue
        share, where = 100 * used[role]["share"], used[role]["processors"]
        found.append(f"{share:.0f} % ({where})")
        if where.isdecimal():
            together[where] = together.get(where, 0) + share
    sums = ", ".join(f"{where}: {share:.0f} %" for where, share in sorted(together.items()))
    return [name, "" if rate_hz is None else f"{rate_hz:.0f}", *found, sums]


def about(result: Result) -> str:
    """What the figures are."""
    rates = result["rates_hz"]
    runs = sum(len(way["runs"]) for way in result["ways"].values())
    return (
        f"Sustained over {result['seconds']:g} s: at most {100 * MOST_WITHOUT:g} % of the frames without a command, no "
        f"message lost by the recorder, the rate within {100 * RATE_WITHIN:g} % of that asked for; {runs} runs on a "
        f"grid of {len(rates)} rates from {rates[0]:g} to {rates[-1]:g} Hz. Latencies are of one run at that rate; "
        "late are commands that were not there when the next exposure began, which the simulated camera sees. Percent "
        "are of one processor, all threads of the process, over the last four fifths of a run; in brackets the "
        "processors that it may run on, and at the end the sum of those that may run on one only."
    )
