"""A bare loop: it only sleeps and reads clocks, beside a loop process. If both are late, the host is the cause.

It runs on the processors of that process, in real-time scheduling at a higher priority, so that lowfc does not delay
it. Halfway between two frames it wakes, notes how late it is, and reads the kernel's counters of processor and process.
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
from lowfc.programs.measure.latency.frame_statistics import WARM_UP_S

PROCESSES_FILE = "processes.json"
"""File in the run's directory: process id of each role."""
TRACED = (Role.CAMERA, Role.CONTROLLER)
"""Processes beside which a bare loop runs."""

_TIMEOUT_S = 60.0
_POLL_S = 0.01

app = new_app("A loop that only sleeps and reads clocks, beside a process of the control loop.")


def trace_file(role: str) -> str:
    """File in the run's directory with the trace of the bare loop beside a role: a row for each waking."""
    return f"trace-{role}.npy"


@app.command()
def bare_loop(
    role: Annotated[Role, typer.Argument(help="Process beside which the bare loop runs.")],
    run: RunId = DEFAULT_RUN,
    config: ConfigFile = None,
    seconds: Annotated[float, typer.Option(help="Seconds for which frames are sent.")] = 10.0,
) -> None:
    """Wake once between two frames, as long as frames are sent, and record the kernel's counters."""
    if role not in TRACED:
        raise typer.BadParameter(f"a bare loop runs beside {' or '.join(TRACED)}, not {role}")
    settings = configuration(config)
    cpus = settings.realtime.controller_cpus if role is Role.CONTROLLER else settings.realtime.camera_cpus
    priority = settings.realtime.priority
    higher_priority = settings.realtime.model_copy(update={"priority": priority + 1 if priority else 0})
    prepare(settings.model_copy(update={"realtime": higher_priority}), role, cpus)
    folder = open_run(run, (settings.mirror.name,)).path
    pid = json.loads(_wait_and_read(folder / PROCESSES_FILE))[role]
    begin_ns = int(_wait_and_read(folder / BEGIN_FILE))
    HostClock().sleep_until_ns(begin_ns)  # before the first frame, another thread may be the busiest
    counters = Counters(pid, busiest_thread(pid, WARM_UP_S / 2), cpus)
    rows = _record_wakings(settings, counters, begin_ns, seconds)
    with being_written(folder / trace_file(role)) as part, part.open("wb") as file:
        np.save(file, rows)


def _record_wakings(config: Configuration, counters: Counters, begin_ns: int, seconds: float) -> Long:
    """A row for each waking: due time, wake-up time and counts. The first frame is due at `begin_ns`."""
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
        except OSError:  # the process has ended
            break
    return np.array(rows, np.int64).reshape(-1, 2 + len(Counts._fields))


def _wait_and_read(file: Path) -> str:
    """The text of a file once it exists; BusError if it does not exist within `_TIMEOUT_S`."""
    deadline_s = time.monotonic() + _TIMEOUT_S
    while not file.exists():
        if time.monotonic() > deadline_s:
            raise BusError(f"no {file.name} in the run's directory after {_TIMEOUT_S:g} s: nothing can be traced")
        time.sleep(_POLL_S)
    return file.read_text()


if __name__ == "__main__":
    run_app(app)
