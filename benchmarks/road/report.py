"""The road and the loaded host for a document: each table, and how and where it was measured."""

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks import cells
from benchmarks.road import table
from benchmarks.road.measure import SELDOM


def road_markdown(result: Mapping[str, Any]) -> str:
    """What each change bought."""
    how = result["settings"]
    elsewhere = min(how["repeats"], SELDOM)
    return (
        f"{cells.markdown(table.road(result))}\n\n"
        f"Frame to command at {how['rate_hz']:g} Hz, runs of {how['seconds']:g} s. Each run of a change stands between "
        f"two of its loop as that is, {how['repeats']} times where most was to be expected, {elsewhere} "
        "times elsewhere: medians over the runs, in brackets the lowest and the highest. A ratio is of a run "
        "to its two neighbours; where its range includes 1, nothing is shown. "
        f"{_where(result, result['granted'])}"
    )


def loaded_markdown(result: Mapping[str, Any]) -> str:
    """With the real-time set-up and without."""
    how = result["settings"]
    full = [kind for kind in result["kinds"] if not kind["plain"]]
    share = next(kind["load_share"] for kind in full if kind["load"])
    return (
        f"{cells.markdown(table.loaded(result))}\n\n"
        f"{table.ratios(result)} Medians over {how['repeats']} runs of {how['seconds']:g} s at {how['rate_hz']:g} Hz, "
        "one kind after the other, in brackets the lowest and the highest; a frame without a command has no time, and "
        f"is counted apart. The load is, {result['load']}; beside the loop in real time it took "
        f"{100 * share['median']:.0f} % of the processors. {_where(result, full[0]['granted'])}"
    )


def _where(result: Mapping[str, Any], granted: Sequence[str]) -> str:
    host = result["host"]
    return (
        f"Granted by the host: {', '.join(granted)}. Measured {result['date']} on {host['processors']} processors of "
        f"{host['processor']}, Linux {host['kernel']}, clock source {host['clock_source']}, Python {host['python']}, "
        f"load {host['load_before']} before, by `{result['command']}`."
    )
