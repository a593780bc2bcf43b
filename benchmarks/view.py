"""What a view costs the simulated loop beside it.

`lowfc sim-loop` runs with its recorder, once alone and once with a view served for a browser (`--web`), in turns; the
order changes from pair to pair. Each pair is compared with itself. The start of the view is part of the run.

Example:
    python -m benchmarks view --seconds 10 --repeats 9
"""

import argparse

from benchmarks.load import run_lowfc
from benchmarks.runner import Lines, Result, Tell, add_times, ranged
from lowfc.contract.errors import BusError

SIDES = {"without": (), "with": ("--web",)}
_SPANS = ("frame_to_command", "frame_to_mirror")
_LOST = ("frames_skipped", "frames_missing", "messages_lost")


def options(parser: argparse.ArgumentParser) -> None:
    """How long, how often, how fast."""
    add_times(parser, seconds=10.0, repeats=5)
    parser.add_argument("--rate", type=float, default=1000.0, help="frames per second (%(default)g)")


def measure(options: argparse.Namespace, tell: Tell) -> Result:
    """Run all pairs.

    Returns:
        pairs, each with the figures of `lowfc sim-loop --json` that are compared and usage, without and with a view;
        rate_hz and seconds.
    """
    pairs = []
    for number in range(options.repeats):
        pair = {}
        for side in sorted(SIDES, reverse=number % 2 == 0):
            tell(f"pair {number + 1} of {options.repeats}: {side} a view")
            found = run_lowfc(["sim-loop", "--rate", f"{options.rate:g}", *SIDES[side]], options.seconds)
            if "failure" in found:
                raise BusError(f"the loop {side} a view failed: {found['failure']}")
            pair[side] = {name: found[name] for name in ("frames_published", *_LOST, "latency_us", "usage")}
        pairs.append(pair)
    return {"pairs": pairs, "rate_hz": options.rate, "seconds": options.seconds}


def tables(result: Result) -> list[Lines]:
    """Latencies pair by pair, and what was lost."""
    lines = [["us", "without a view", "with a view", "with / without"]]
    for span in _SPANS:
        for at in ("p50", "p99"):
            without, with_ = ([pair[side]["latency_us"][span][at] for pair in result["pairs"]] for side in SIDES)
            ratios = [after / before for before, after in zip(without, with_, strict=True)]
            name = f"{span.replace('_', ' ')} {at}"
            lines.append([name, ranged(without), ranged(with_), ranged(ratios, "{:.3f}".format)])
    for name in _LOST:
        totals = [sum(pair[side][name] for pair in result["pairs"]) for side in SIDES]
        lines.append([name.replace("_", " "), *map(str, totals), ""])
    return [lines]


def about(result: Result) -> str:
    """What the view itself takes, and what the figures are."""
    views = [pair["with"]["usage"]["view"] for pair in result["pairs"] if "view" in pair["with"]["usage"]]
    used = (
        f"The view takes {ranged([100 * view['share'] for view in views])} % of one processor and "
        f"{ranged([view['mb'] for view in views])} MB. "
        if views
        else ""
    )
    return (
        f"{used}Medians over {len(result['pairs'])} pairs of {result['seconds']:g} s at {result['rate_hz']:g} Hz, in "
        "brackets the lowest and the highest; a ratio is of one pair, so that a range that includes 1 shows no cost "
        "beyond chance. Frames and messages are sums."
    )
