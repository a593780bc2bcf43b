"""The command `lowfc bench view`: what a view costs the loop beside it, and what it takes itself."""

import json
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from lowfc.programs.bench.view_loop import Cost, Reading

PERCENTILES = (50, 99)
LOG_MB = 250.0
"""Size of the recorder's logs; finished ones are deleted between two phases."""
HOUR_S = 3600.0
LOGGED_S = 15.0
"""Of the loop's log that is published afterwards, beside the seconds that are measured: for the view to begin."""


def bench_view(
    rate: Annotated[float, typer.Option(min=10, max=20_000, help="Frames per second.")] = 1000.0,
    seconds: Annotated[float, typer.Option(min=0.3, max=3600, help="For how long each phase is measured.")] = 8.0,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How often each phase is measured.")] = 5,
    rendered: Annotated[
        bool, typer.Option("--rendered", help="Also beside a viewer that draws, in software; it takes a processor.")
    ] = False,
    hour: Annotated[
        bool, typer.Option("--hour", help="Instead: memory of the view over an hour of traffic, as fast as it goes.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Measure what a view costs: the loop's frame to command beside one that works, hangs or dies; its own share.

    One simulated loop runs all the time, recorder included. A view of it, served for a browser, is off, starting, on,
    hung (SIGSTOP), on with its viewer hung, and killed, again and again, and the controller's timing of every frame
    tells what that changed. Each difference stands beside the run-to-run spread: the range of the same figure over
    the phases without a view.

    Example: lowfc bench view --seconds 2 --repeats 3
    """
    if hour:
        from lowfc.programs.bench.view_hour import measure_hour, render_hour

        figures = measure_hour(rate, HOUR_S)
        text = render_hour(figures)
    else:
        figures = measure(rate, seconds, repeats, rendered=rendered)
        text = render(figures)
    sys.stdout.write((json.dumps(figures) if as_json else text) + "\n")


def measure(rate_hz: float, seconds: float, repeats: int, *, rendered: bool = False) -> dict[str, Any]:
    """Measure every phase a number of times, each time beginning with another.

    Returns:
        rate_hz, seconds and repeats as asked; phases and spread_us, see `isolation`; view, see `cost`, with renewals,
        how often it began anew; view_alone, the same beside nothing but one process that publishes the loop's log, at
        its own rate: without a loop on the same processors; run, figures of the whole run, the changes between phases
        included.

    Raises:
        BusError, ProcessDiedError: the loop or the view did not come up, or ended.
    """
    import tempfile

    from rich.console import Console

    from lowfc.adapters.progress import passing_bar
    from lowfc.programs.bench.view_loop import LoopBesideView, Phase, loop_configuration

    phases = [phase for phase in Phase if rendered or phase is not Phase.RENDERED]
    readings: list[Reading] = []
    with tempfile.TemporaryDirectory(prefix="lowfc-bench-") as name:
        folder = Path(name)
        configuration = loop_configuration(rate_hz, folder, LOG_MB)
        loop = LoopBesideView(configuration, folder)
        with passing_bar(Console(stderr=True)) as bar, loop:
            task = bar.add_task("starting", total=repeats * len(phases))
            for repeat in range(repeats):
                first = repeat % len(phases)
                for phase in phases[first:] + phases[:first]:
                    bar.update(task, description=f"view {phase}")
                    readings.append(loop.read(phase, seconds))
                    for log in folder.glob("*.mcap"):
                        log.unlink()
                    bar.advance(task)
            loop.wait(LOGGED_S + seconds)
        run = loop.figures()
        with passing_bar(Console(stderr=True)) as bar:
            bar.add_task("view of its log", total=None)
            with LoopBesideView(configuration, folder, sorted(folder.glob("*.mcap"))) as player:
                alone = player.cost(seconds)
    kept = ("rate_hz", "frames_published", "frames_skipped", "frames_missing", "messages_recorded", "messages_lost")
    return {
        "rate_hz": rate_hz,
        "seconds": seconds,
        "repeats": repeats,
        **isolation(readings),
        "view": {**cost([one.cost for one in readings if one.cost is not None]), "renewals": loop.renewals},
        "view_alone": cost([alone]),
        "run": {key: run[key] for key in (*kept, "realtime_granted", "realtime_refused")},
    }


def isolation(readings: Sequence["Reading"]) -> dict[str, Any]:
    """What each phase did to frame-to-command.

    Args:
        readings: of all phases, among them `off`; as often as they were repeated.

    Returns:
        spread_us: range of p50 and of p99 over the repeats of `off`; None where there is one only.
        phases: for each the number of frames, what was skipped, missing and lost in all repeats, and p50_us and p99_us:
        median, lowest and highest of the repeats; difference and ratio of the median to that of `off`; within_spread,
        whether the difference is less than the spread (None for `off` itself, and without a spread).
    """
    import numpy as np

    grouped: dict[str, list[Reading]] = {}
    for reading in readings:
        grouped.setdefault(str(reading.phase), []).append(reading)
    found_us = {
        percentile: {
            phase: [float(np.percentile(one.frame_to_command_ns, percentile)) / 1e3 for one in ones]
            for phase, ones in grouped.items()
        }
        for percentile in PERCENTILES
    }
    spread_us = {
        percentile: max(by_phase["off"]) - min(by_phase["off"]) if len(by_phase["off"]) > 1 else None
        for percentile, by_phase in found_us.items()
    }
    return {
        "spread_us": {f"p{percentile}": spread for percentile, spread in spread_us.items()},
        "phases": {
            phase: {
                "frames": sum(len(one.frame_to_command_ns) for one in ones),
                "frames_skipped": sum(one.losses.skipped for one in ones),
                "frames_missing": sum(one.losses.missing for one in ones),
                "messages_lost": sum(one.losses.lost for one in ones),
                **{
                    f"p{percentile}_us": _compared(
                        found_us[percentile][phase],
                        found_us[percentile]["off"],
                        None if phase == "off" else spread_us[percentile],
                    )
                    for percentile in PERCENTILES
                },
            }
            for phase, ones in grouped.items()
        },
    }


def cost(costs: Sequence["Cost"]) -> dict[str, Any]:
    """What the view itself took while it worked.

    Returns:
        bridge_cpu_percent and viewer_cpu_percent (of one processor, all threads; median over the repeats) and
        bridge_mb and viewer_mb (resident; the most): of the view's process and of the viewer's server;
        moments_hz drawn, median: a view that gets no processor time is cheap.
    """
    return {
        "bridge_cpu_percent": 100 * statistics.median(one.bridge_share for one in costs),
        "viewer_cpu_percent": 100 * statistics.median(one.viewer_share for one in costs),
        "bridge_mb": max(one.bridge_bytes for one in costs) / 1e6,
        "viewer_mb": max(one.viewer_bytes for one in costs) / 1e6,
        "moments_hz": statistics.median(one.moments_hz for one in costs),
    }


def render(figures: dict[str, Any]) -> str:
    """The result of `measure` as a table."""
    lines = [f"{'view':<12} {'p50':>9} {'of off':>8} {'':<14} {'p99':>9} {'of off':>8} {'':<14} {'frames':>8} "
             f"{'skipped':>8} {'missing':>8} {'lost':>6}"]  # fmt: skip
    for phase, found in figures["phases"].items():
        columns = " ".join(
            f"{one['median']:>6.0f} us {one['ratio']:>6.3f} x {verdict(one['within_spread']):<14}"
            for one in (found["p50_us"], found["p99_us"])
        )
        lines.append(
            f"{phase:<12} {columns} {found['frames']:>8} {found['frames_skipped']:>8} {found['frames_missing']:>8} "
            f"{found['messages_lost']:>6}"
        )
    view = figures["view"]
    spreads = [f"{name} {'not known' if us is None else f'{us:.0f} us'}" for name, us in figures["spread_us"].items()]
    lines += [
        f"frame to command, medians of {figures['repeats']} times {figures['seconds']:g} s at {figures['rate_hz']:g} "
        f"Hz; run-to-run spread, the range without a view: {', '.join(spreads)}",
        *(
            f"{where}, the view takes {found['bridge_cpu_percent']:.1f} % of a processor and {found['bridge_mb']:.0f} "
            f"MB, its viewer {found['viewer_cpu_percent']:.1f} % and {found['viewer_mb']:.0f} MB; it drew "
            f"{found['moments_hz']:.0f} moments a second"
            for where, found in (("beside the loop", view), ("beside its log, published", figures["view_alone"]))
        ),
        f"the view began anew {view['renewals']} times",
    ]
    return "\n".join(lines)


def verdict(within_spread: bool | None) -> str:
    """The verdict in words; nothing where there is none."""
    return {None: "", True: "within spread", False: "beyond spread"}[within_spread]


def _compared(found_us: list[float], off_us: list[float], spread_us: float | None) -> dict[str, Any]:
    median_us, off_median_us = statistics.median(found_us), statistics.median(off_us)
    difference_us = median_us - off_median_us
    return {
        "median": median_us,
        "lowest": min(found_us),
        "highest": max(found_us),
        "difference": difference_us,
        "ratio": median_us / off_median_us,
        "within_spread": None if spread_us is None else abs(difference_us) < spread_us,
    }
