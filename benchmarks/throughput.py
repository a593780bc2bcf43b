"""The highest rate that the closed loop sustains, and what its processes use of the processors there.

A rate is sustained where at most one frame in a thousand is without a command, the recorder loses no message, and the
frames come within 1 % as fast as asked for. It is looked for on a geometric grid: by halves with one run each, then
around the edge with the majority of up to three, until a rate that holds stands beside one that does not. The commands
are those that a user has: `lowfc sim-loop`, and `lowfc latency`, which sends frames made beforehand. Of both the first
half second is left out, except of what the recorder lost.

Example:
    python -m benchmarks.throughput --markdown
    python -m benchmarks.throughput --seconds 2 --lowest 1000 --highest 4000 --way "prepared frames"
"""

import argparse
import contextlib
import json
import math
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from benchmarks import cells
from benchmarks.command import add_forms, occasion, run_main, say
from benchmarks.load import Watched
from lowfc.adapters.bus import Sample
from lowfc.adapters.clock import HostClock
from lowfc.adapters.progress import passing_bar
from lowfc.adapters.run import open_run
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.contract.messages import FRAME, HEALTH, Role, wire
from lowfc.programs.latency.figures import WARM_UP_S
from lowfc.programs.watch import topic_count

Figures = dict[str, Any]

SIMULATED, PREPARED = "sim-loop", "latency"
WAYS = {
    "simulated camera, recorder": [SIMULATED],
    "simulated camera": [SIMULATED, "--no-record"],
    "prepared frames, recorder": [PREPARED, "--record"],
    "prepared frames": [PREPARED],
}
"""What is searched for its highest rate, and the command behind it; --rate, --duration and --json are added."""
FREE_RUNNING = {
    "free-running, recorder": [PREPARED, "--free-running", "--record"],
    "free-running": [PREPARED, "--free-running"],
}
"""What finds its rate by itself: the next frame as soon as the last one's command is back."""

MOST_WITHOUT = 0.001
"""Part of the frames that may be without a command."""
RATE_WITHIN = 0.01
COMPARED_HZ = 1000.0

_LOOK_S = 0.05
_ROLES = ("camera", "controller", "mirror", "recorder")
_START_S, _SLOWEST = 60.0, 12.0


class Heard(NamedTuple):
    """When a Health came, and what it said."""

    at_s: float
    health: wire.Health


def measure(words: Sequence[str], rate_hz: float | None, seconds: float) -> Figures:
    """Run a loop once.

    Args:
        words: of the command; see `WAYS`.
        rate_hz: asked for; None where there is no schedule.
        seconds: of frames.

    Returns:
        asked_hz, rate_hz, frames, without_command, messages_lost (None without a recorder), frame_to_command_us (p50,
        p99), commands_late (part of them all, of a simulated camera), usage (share of one processor and processors, by
        role); or failure, what the command said last.
    """
    rate = [] if rate_hz is None else ["--rate", f"{rate_hz:g}"]
    command = [sys.executable, "-P", "-m", "lowfc", *words, *rate, "--duration", f"{seconds:g}", "--json"]
    heard: list[Heard] = []
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "said").open("w+") as said:
        environment = os.environ | {"XDG_RUNTIME_DIR": folder}
        process = subprocess.Popen(  # noqa: S603  # our own
            command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=said, text=True
        )
        try:
            with Watched(process.pid) as watched, _joined(Path(folder), process, heard):
                out, _ = process.communicate(timeout=_START_S + _SLOWEST * seconds)
        except subprocess.TimeoutExpired:
            return {"asked_hz": rate_hz, "failure": f"not done after {_START_S + _SLOWEST * seconds:g} s"}
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
        said.seek(0)
        last = said.read().strip().splitlines()[-1:]
    if process.returncode:
        return {"asked_hz": rate_hz, "failure": "; ".join(last) or f"exit status {process.returncode}"}
    usage = {role: used._asdict() for role, used in watched.shares(seconds).items()}
    return {"asked_hz": rate_hz, **account(json.loads(out)), **(steady(heard) or {}), "usage": usage}


@contextlib.contextmanager
def _joined(folder: Path, process: "subprocess.Popen[str]", heard: list[Heard]) -> Iterator[None]:
    """Hear the Health of the processes of a simulated loop; `lowfc latency` leaves its start out by itself."""
    if SIMULATED not in process.args:  # type: ignore[operator]  # a list
        yield
        return

    def hear(sample: Sample) -> None:
        heard.append(Heard(time.monotonic(), wire.Health.FromString(sample.payload)))

    while not (made := list(folder.glob("lowfc/[a-z0-9]*/config.toml"))) and process.poll() is None:
        time.sleep(_LOOK_S)
    with contextlib.ExitStack() as stack:
        if made:
            run = open_run(made[0].parent.name, (), made[0].parent.parent)
            bus = ZenohBus(run.links, Role.OPERATOR, HostClock())
            stack.callback(bus.close)
            bus.subscribe(HEALTH, hear)
        yield


def steady(heard: Sequence[Heard]) -> Figures | None:
    """Of a simulated loop without its start: rate_hz, frames and without_command; None where it was too short."""
    running = [one.at_s for one in heard if one.health.process == Role.CAMERA and one.health.state == "running"]
    if not running:
        return None
    inside = [one.health for one in heard if running[0] + WARM_UP_S <= one.at_s <= running[-1]]
    camera = [health for health in inside if health.process == Role.CAMERA]
    controller = [health for health in inside if health.process == Role.CONTROLLER]
    if min(len(camera), len(controller)) < 2:
        return None
    first, last = (topic_count(controller[place], FRAME.key) for place in (0, -1))
    published = [topic_count(camera[place], FRAME.key).published for place in (0, -1)]
    return {
        "rate_hz": (published[1] - published[0]) * 1e9 / (camera[-1].uptime_ns - camera[0].uptime_ns),
        "frames": last.received + last.missing - first.received - first.missing,
        "without_command": last.skipped + last.missing - first.skipped - first.missing,
    }


def account(said: Figures) -> Figures:
    """What `--json` of either command says of the frames."""
    if "frames_published" in said:  # sim-loop
        own = {
            "frames": said["frames_published"],
            "without_command": said["frames_published"] - said["frames_processed"],
            "frame_to_command_us": said["latency_us"]["frame_to_command"],
            "commands_late": said["commands_late"] / said["frames_published"],
        }
        if said["recording_failure"]:
            own["failure"] = said["recording_failure"]
    else:
        own = {
            "frames": said["frames"],
            "without_command": said["frames_without_command"],
            "frame_to_command_us": said["latency_us"]["frame_to_command"],
        }
    own["frame_to_command_us"] = {name: own["frame_to_command_us"][name] for name in ("p50", "p99")}
    return {"rate_hz": said["rate_hz"], "messages_lost": said["messages_lost"], **own}


def complaints(run: Figures) -> list[str]:
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


def find(words: Sequence[str], rates: Sequence[float], seconds: float, told: Callable[[str], None]) -> Figures:
    """Look for the highest rate of one way.

    Returns:
        command, highest_hz (None where not even the lowest is sustained), at_highest (a sustained run there), above (a
        run that was not, one step faster; None where the grid ends), compared (a run at `COMPARED_HZ`) and all runs.
    """
    command = shlex.join(["lowfc", *words])
    runs: list[Figures] = []

    def sustains(place: int) -> bool:
        told(f"{command}: {rates[place]:g} Hz")
        runs.append(measure(words, rates[place], seconds) | {"place": place})
        return not complaints(runs[-1])

    place = search(sustains, len(rates))
    told(f"{command}: {COMPARED_HZ:g} Hz")
    return {
        "command": command,
        "highest_hz": rates[place] if place >= 0 else None,
        "at_highest": next((run for run in runs if run["place"] == place and not complaints(run)), None),
        "above": next((run for run in runs if run["place"] == place + 1 and complaints(run)), None),
        "compared": measure(words, COMPARED_HZ, seconds),
        "runs": runs,
    }


HEADINGS = ("loop", "highest rate, Hz", "frame to command p50, us", "p99", "commands late", "one step faster")
USE_HEADINGS = ("loop", "at, Hz", *_ROLES, "on one processor")


def tables(result: Figures) -> list[list[list[str]]]:
    """Rates, and what the processes used; headings first."""
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


def _latency(run: Figures | None) -> list[str]:
    if run is None or "frame_to_command_us" not in run:
        return [""] * 3
    late = f"{100 * run['commands_late']:.3g} %" if "commands_late" in run else ""
    return [*(f"{run['frame_to_command_us'][name]:.0f}" for name in ("p50", "p99")), late]


def _use(name: str, run: Figures) -> list[str]:
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


def about(result: Figures) -> str:
    """What the figures are, and of which host."""
    where, rates = result["host"], result["rates_hz"]
    runs = sum(len(way["runs"]) for way in result["ways"].values())
    return (
        f"Sustained over {result['seconds']:g} s: at most {100 * MOST_WITHOUT:g} % of the frames without a command, no "
        f"message lost by the recorder, the rate within {100 * RATE_WITHIN:g} % of that asked for; {runs} runs on a "
        f"grid of {len(rates)} rates from {rates[0]:g} to {rates[-1]:g} Hz. Latencies are of one run at that rate; "
        "late are commands that were not there when the next exposure began, which the simulated camera sees. Percent "
        "are of one processor, all threads of the process, over the last four fifths of a run; in brackets the "
        "processors that it may run on, and at the end the sum of those that may run on one only. "
        f"Measured {result['date']} on {where['processors']} processors of {where['processor']}, Linux "
        f"{where['kernel']}, Python {where['python']}, load {result['load_before']:g} before, by `{result['command']}`."
    )


def text(result: Figures) -> str:
    """The result for a terminal."""
    return "\n\n".join([*map(cells.text, tables(result)), about(result)])


def markdown(result: Figures) -> str:
    """The result for a document."""
    return "\n\n".join([*map(cells.markdown, tables(result)), about(result)])


def main() -> int:
    """The command line; returns its exit status."""
    asked = _parser().parse_args()
    if not (0 < asked.lowest <= asked.highest and asked.step > 1):
        raise SystemExit("--lowest must be above 0 and at most --highest, and --step above 1")
    every = WAYS | FREE_RUNNING
    chosen = asked.way or list(every)
    measured = occasion("python -m benchmarks.throughput")
    rates = grid(asked.lowest, asked.highest, asked.step)
    ways: Figures = {}
    free: Figures = {}
    with passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task("throughput", total=None)
        for name in chosen:
            bar.update(task, description=name)
            if name in FREE_RUNNING:
                free[name] = measure(every[name], None, asked.seconds)
            else:
                ways[name] = find(every[name], rates, asked.seconds, lambda what: bar.update(task, description=what))
    result = {
        "ways": ways,
        "free_running": free,
        "seconds": asked.seconds,
        "rates_hz": rates,
        **measured,
    }
    say(result, asked, text, markdown)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.throughput", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run (%(default)g)")
    parser.add_argument("--lowest", type=float, default=500.0, help="rate of the grid, Hz (%(default)g)")
    parser.add_argument("--highest", type=float, default=10_000.0, help="rate of the grid, Hz (%(default)g)")
    parser.add_argument("--step", type=float, default=1.1, help="from one rate to the next (%(default)g times)")
    parser.add_argument("--way", action="append", choices=[*WAYS, *FREE_RUNNING], help="only this one; repeat")
    add_forms(parser, "the tables")
    return parser


if __name__ == "__main__":
    run_main(main)
