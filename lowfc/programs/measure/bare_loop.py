"""A loop that does nothing, beside one of the real loop's processes: what holds up both is the host's.

It runs on the processor of that process, with a priority above it, so that nothing of ours holds it up. In the middle
between two frames it wakes, notes how late it is, and reads what the kernel counts of the processor and of the process.
"""

import json
import math
import time
from array import array
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.files.whole_file import being_written
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.host import Counters, Counts, busiest_thread
from lowfc.adapters.process.join import prepare
from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.arrays import Long
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import BusError
from lowfc.contract.messages import Role
from lowfc.programs.measure.frame_source import BEGIN_FILE
from lowfc.programs.measure.latency.figures import WARM_UP_S

PROCESSES_FILE = "processes.json"
"""In the run's directory: number of each role's process."""
TRACED = (Role.CAMERA, Role.CONTROLLER)
"""Processes that a bare loop stands beside."""

_HIGHEST = 99
_WAIT_S = 60.0
_LOOK_S = 0.01

app = new_app("A loop that does nothing.")


def trace_file(role: str) -> str:
    """File in the run's directory, of the bare loop beside a role: `latency.stalls.Trace`, a row for each waking."""
    return f"trace-{role}.npy"


@app.command()
def bare_loop(
    role: Annotated[Role, typer.Argument(help="Process to stand beside.")],
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    seconds: Annotated[float, typer.Option(help="Of frames.")] = 10.0,
) -> None:
    """Wake once between two frames, as long as there are frames, and note what the kernel counts."""
    settings = configuration(config)
    cpus = settings.realtime.controller_cpus if role is Role.CONTROLLER else settings.realtime.camera_cpus
    priority = settings.realtime.priority
    above = settings.realtime.model_copy(update={"priority": min(priority + 1, _HIGHEST) if priority else 0})
    prepare(settings.model_copy(update={"realtime": above}), cpus)
    folder = open_run(run, (settings.mirror.name,)).path
    process = json.loads(_awaited(folder / PROCESSES_FILE))[role]
    begin_ns = int(_awaited(folder / BEGIN_FILE))
    counters = Counters(process, busiest_thread(process, WARM_UP_S / 2), cpus)
    rows = _wake(settings, counters, begin_ns, seconds)
    with being_written(folder / trace_file(role)) as part, part.open("wb") as file:
        np.save(file, rows)


def _wake(config: Configuration, counters: Counters, begin_ns: int, seconds: float) -> Long:
    """A row for each waking: when it was due, when it came, and the counts; the first frame was due at `begin_ns`."""
    clock, period_ns = HostClock(), config.period_ns
    middle_ns = begin_ns + period_ns // 2
    first = (clock.host_ns() - middle_ns) // period_ns + 1
    rows = array("q")
    for index in range(first, math.ceil(seconds * config.camera.rate_hz)):
        due_ns = middle_ns + index * period_ns
        clock.sleep_until_ns(due_ns)
        woke_ns = clock.host_ns()
        try:
            rows.extend((due_ns, woke_ns, *counters.read()))
        except OSError:  # it has ended
            break
    return np.array(rows, np.int64).reshape(-1, 2 + len(Counts._fields))


def _awaited(file: Path) -> str:
    deadline_s = time.monotonic() + _WAIT_S
    while not file.exists():
        if time.monotonic() > deadline_s:
            raise BusError(f"no frame came in {_WAIT_S:g} s; nothing is traced without")
        time.sleep(_LOOK_S)
    return file.read_text()


if __name__ == "__main__":
    run_app(app)
