"""The command `lowfc bench twin`."""

from lowfc.adapters.process.terminal import Json
from lowfc.programs.cli.output import put


def bench_twin(as_json: Json = False) -> None:
    """Time the real-time twin against the full optical chain, both on one thread, in the same run.

    Example: lowfc bench twin --json
    """
    from lowfc.programs.measure.bench.twin import bench_twin as measure
    from lowfc.programs.measure.bench.twin import render

    figures = measure()
    put(figures, render(figures), as_json=as_json)
