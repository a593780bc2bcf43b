"""Generate the tables and pictures of the documentation, from measurements and from the code.

A table is generated between `]]]` and `[[[end]]]`; the line with `[[[cog` names it. Measured tables come from the JSON
files in `tools/measured`, the others from the code; a test checks that every page is up to date.

Example:
    python -m tools.measure                # regenerate the pages from stored measurements and the code
    python -m tools.measure laws sensors   # repeat these measurements, then regenerate the pages
    python -m tools.measure pictures       # the pictures of the views, with real processes
    python -m tools.measure console        # the pictures of the console
    python -m tools.measure layouts        # the layouts for rerun in deploy/layouts
"""

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from benchmarks import curves, kernels, step, streams, throughput
from benchmarks.peers import comparison
from benchmarks.runner import Benchmark, in_markdown
from lowfc.programs.measure.latency import text as latency_text
from tools import (
    console,
    dark_hole,
    guard,
    laws,
    layouts,
    loop,
    no_harm,
    pictures,
    reliability,
    sensors,
    slow_modes,
    targets,
    world,
)
from tools.declared import DECLARED
from tools.shared import ROOT, Results, host, json_of, provenance_text

MEASURED = ROOT / "tools" / "measured"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
COST_CURVES = ROOT / "docs" / "pictures" / "cost_curves.png"


class Measurement(NamedTuple):
    """One table of the documentation.

    Attributes:
        commands: commands that the measurement runs, as printed with the table.
        measure: returns its results.
        render: returns the table of the results.
        has_provenance: whether the table itself names command and host, so that no sentence is added.
    """

    commands: tuple[str, ...]
    measure: Callable[[], Results]
    render: Callable[[Results], str]
    has_provenance: bool = False


def _command_measurement(command: str, render: Callable[[Results], str], has_provenance: bool = False) -> Measurement:
    return Measurement((command,), partial(json_of, command), render, has_provenance)


def _latency(command: str) -> Measurement:
    return _command_measurement(
        command, lambda results: f"```\n$ {command}\n{latency_text.table(results)}\n```\n", has_provenance=True
    )


def _bench(command: str, benchmark: Benchmark) -> Measurement:
    return _command_measurement(command, partial(in_markdown, benchmark))


MEASUREMENTS = {
    "loop": Measurement((loop.LOOP,), loop.measure, loop.render),
    "logs": Measurement(loop.LOG_COMMANDS, loop.measure_logs, loop.render_logs),
    "sensors": Measurement((sensors.COMMAND,), sensors.measure, sensors.render),
    "laws": Measurement((), laws.measure, laws.render),
    "no_harm": Measurement((), no_harm.measure, no_harm.render),
    "guard": Measurement((), guard.measure, guard.render),
    "world": Measurement((), world.measure, world.render),
    "slow_modes": Measurement((), slow_modes.measure, slow_modes.render),
    "zero_point": Measurement((dark_hole.COMMAND,), dark_hole.measure, dark_hole.render),
    "chaos": Measurement((reliability.CHAOS,), reliability.chaos, reliability.render_chaos),
    "soak": _command_measurement("lowfc soak --hours 0.5", reliability.render_soak),
    "fuzz": _command_measurement("python -m tests.support.fuzzing --inputs 1000000", reliability.render_fuzz),
    "latency": _latency("lowfc latency --duration 10 --repeats 5"),
    "watched": _latency("lowfc latency --duration 60 --record --view"),
    "kernels": _bench("python -m benchmarks kernels", kernels),
    "stalls": _latency("lowfc latency --duration 60 --kernel fused --trace"),
    "step": _bench("python -m benchmarks step", step),
    "streams": _bench("python -m benchmarks streams", streams),
    "peers": _bench("python -m benchmarks peers", comparison),
    "curves": _bench("python -m benchmarks curves --seconds 1 --repeats 2", curves),
    "throughput": _bench("python -m benchmarks throughput --seconds 6", throughput),
}


COMPOSED: dict[str, Callable[[], str]] = {
    "loop in short": lambda: loop.short(measured("loop")),
    "targets": lambda: targets.render(measured),
}
"""Tables composed of other measurements."""


def table(name: str) -> str:
    """A table of the documentation by its name."""
    if name in DECLARED:
        return DECLARED[name]()
    if name in COMPOSED:
        return COMPOSED[name]()
    measurement, results = MEASUREMENTS[name], measured(name)
    text = measurement.render(results)
    if measurement.has_provenance:
        return text
    between = "" if text.endswith("\n") else " "
    return f"{text}{between}{provenance_text(name, results)}\n"


def measured(name: str) -> Results:
    """Results of the last measurement."""
    results: Results = json.loads((MEASURED / f"{name}.json").read_text())
    return results


def generated(page: Path) -> str:
    """A page with its tables regenerated."""
    from cogapp import Cog

    cog = Cog()
    cog.options.prologue = "from tools.measure import table"
    text: str = cog.process_string(page.read_text(), str(page))
    return text


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    makers = {"pictures": pictures.make, "console": console.make, "layouts": layouts.make}
    choices = (*MEASUREMENTS, *makers)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of {', '.join(choices)}")
    names = parser.parse_args().names
    if unknown := [name for name in names if name not in choices]:
        parser.error(f"there is no {unknown[0]!r}; there are {', '.join(choices)}")
    for name in names:
        if name in makers:
            makers[name]()
        else:
            about = {"host": host(), "commands": MEASUREMENTS[name].commands}
            results = about | MEASUREMENTS[name].measure()
            (MEASURED / f"{name}.json").write_text(json.dumps(results, indent=1) + "\n")
    for page in PAGES:
        page.write_text(generated(page))
    COST_CURVES.write_bytes(curves.picture(measured("curves")))


if __name__ == "__main__":
    main()
