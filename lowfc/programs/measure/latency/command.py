"""The command `lowfc latency`: the latency from frame to command, on this host or in a log."""

import contextlib
import json
import os
import shlex
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from lowfc.adapters.files.whole_file import require_folder, write_whole
from lowfc.adapters.process.terminal import ConfigFile, Json, LogsOrMeasure, configuration, options_set
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import ConfigurationError, DataFileError, raised_as
from lowfc.programs.cli.output import print_result

if TYPE_CHECKING:
    from lowfc.contract.configuration import Configuration
    from lowfc.programs.measure.latency.run import LatencyOptions

_RATE_HZ = 1000.0  # frame rate if none is configured
_LEAK = 0.01  # of all modes with prepared frames

Kernels = Literal["numpy", "fused", "both"]
Camera = Literal["prepared", "simulated"]


def latency(
    context: typer.Context,
    logs: LogsOrMeasure = None,
    duration: Annotated[float, typer.Option(min=0.5, max=1e5, help="Duration of each repeat, seconds.")] = 10.0,
    rate: Annotated[float | None, typer.Option(help="Frames per second; default: as configured, or 1000.")] = None,
    camera: Annotated[Camera, typer.Option(help="Prepared frames, or the simulated camera.")] = "prepared",
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Number of repeats of loop and references.")] = 1,
    record: Annotated[bool, typer.Option("--record/--no-record", help="Run the recorder, too.")] = False,
    view: Annotated[bool, typer.Option("--view/--no-view", help="Run a view for a browser, too.")] = False,
    plain_scheduling: Annotated[
        bool, typer.Option("--plain-scheduling", help="Without SCHED_FIFO, pinned processors, locked memory.")
    ] = False,
    kernel: Annotated[
        Kernels | None, typer.Option(help="Implementation of the control step; default: as configured.")
    ] = None,
    trace: Annotated[
        bool, typer.Option("--trace", help="Trace stalls to their causes, with bare loops as reference.")
    ] = False,
    config: ConfigFile = None,
    plot: Annotated[Path | None, typer.Option(help="Plot histograms and latency against time (PNG).")] = None,
    compare: Annotated[
        tuple[Path, Path] | None, typer.Option(help="Compare two results of --json.", metavar="A.json B.json")
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure the latency of every frame through controller and mirror, and compare it with the host's limits.

    Prepared frames are sent on an absolute schedule and late frames are counted, so that stalls are not hidden. A bare
    zenoh echo of messages of the same sizes, one control step alone and the host's timer are measured in turns with
    the loop. The latency from frame to command begins just before the frame is published, and ends just after its
    command is sent.

    Example: lowfc latency --duration 10 --repeats 5 --json > latency.json
    """
    from lowfc.programs.measure.latency.text import compared, picture, table

    if compare is not None:
        _refuse_others(context, "--compare", "--json")
        comparison = _compare(compare)
        print_result(comparison, compared(comparison), as_json=as_json)
        return
    if logs:
        _refuse_others(context, "logs", "--plot", "--json")
    require_folder(plot)
    if plot is not None:
        from lowfc.adapters.files.drawing import figure_class

        figure_class()  # without matplotlib, fail before the measurement
    if logs:
        results = _from_log(logs)
    else:
        settings = _configuration(config, rate, camera, plain=plain_scheduling)
        from lowfc.adapters.process import compiled
        from lowfc.control.kernel.tables import FUSED, KERNELS
        from lowfc.programs.measure.latency.run import LatencyOptions

        simulated = camera == "simulated"
        kernels = KERNELS if kernel == "both" else (kernel,) if kernel is not None else ()
        if FUSED in kernels and not compiled.available():
            raise ConfigurationError(compiled.advice())
        if trace and simulated:
            raise ConfigurationError("--trace requires prepared frames: omit --trace or --camera simulated")
        results = _measure(LatencyOptions(settings, duration, repeats, simulated, record, view, kernels, trace))
    print_result(results, table(results), as_json=as_json)
    if plot is not None:
        write_whole(plot, picture(results))


def _refuse_others(context: typer.Context, chosen: str, *allowed: str) -> None:
    """Refuse the options that have no effect with the option or argument `chosen`; `allowed` have one."""
    for option in options_set(context):
        if option not in (chosen, *allowed):
            raise ConfigurationError(f"{option} has no effect with {chosen}: omit it")


def _configuration(file: Path | None, rate: float | None, camera: Camera, *, plain: bool) -> "Configuration":
    """The loop's configuration: closed, real-time, and with a leak if the frames do not respond to the mirror."""
    from lowfc.adapters.process.realtime import spread
    from lowfc.contract.configuration import FIXED_GAINS

    overrides: dict[str, Any] = {"camera.rate_hz": rate, "lockstep": False}
    if camera == "prepared":  # without a leak, the integrator would accumulate noise
        overrides |= {"control.tilt_leak": _LEAK, "control.leak": _LEAK}
    if plain:
        overrides |= {"realtime.priority": 0, "realtime.lock_memory": False, "realtime.disable_cpu_idle": False}
        overrides |= {f"realtime.{role}_cpus": [] for role in ("camera", "controller", "mirror", "recorder")}
    pinning = spread(os.sched_getaffinity(0), simulated=camera == "simulated")
    defaults = {"control.start_mode": "closed", **FIXED_GAINS, "camera.rate_hz": _RATE_HZ, **pinning}
    return configuration(file, overrides, defaults)


def _measure(options: "LatencyOptions") -> dict[str, Any]:
    from rich.console import Console

    from lowfc.adapters.process.host import Host
    from lowfc.adapters.process.progress import passing_bar
    from lowfc.adapters.process.provenance import provenance
    from lowfc.programs.measure.latency.run import prepared, run_repeats
    from lowfc.programs.measure.latency.summary import kernel_summary

    host: dict[str, Any] = {**provenance(), "clock_source": "", "load": os.getloadavg()[0]}
    with contextlib.suppress(OSError):
        host["clock_source"] = Host().clock_source()
    begun = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    with prepared(options.config) as run, passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task("starting", total=1 + 2 * options.repeats * max(1, len(options.kernels)))
        repeats = run_repeats(options, run, lambda what: bar.update(task, description=what, advance=1))
    return kernel_summary(repeats) | {
        "settings": {
            "rate_hz": options.config.camera.rate_hz,
            **{name: getattr(options, name) for name in ("duration_s", "repeats", "record", "view", "trace")},
            "camera": "simulated" if options.simulated else "prepared",
            "realtime": options.config.realtime.model_dump(),
        },
        "logs": [log for repeat in repeats for log in repeat["logs"]],
        "date": begun,
        "command": shlex.join(["lowfc", *sys.argv[1:]]),
        "host": host | {name: repeats[-1][name] for name in ("granted", "refused")},
    }


def _from_log(names: list[Path]) -> dict[str, Any]:
    from rich.console import Console

    from lowfc.adapters.logs.parts import named_log, titled
    from lowfc.adapters.process.progress import reading_bar
    from lowfc.programs.measure.latency.log import log_statistics
    from lowfc.programs.measure.latency.summary import combine

    log = named_log(names)
    with reading_bar(Console(stderr=True)) as count:
        results, log_facts = log_statistics(log, partial(count, f"reading {titled(log)}"))
    return combine([results]) | log_facts


def _compare(files: tuple[Path, Path]) -> dict[str, Any]:
    """Comparison of the results in two files with their spread over the repeats, and the names of the files."""
    from lowfc.programs.measure.latency.summary import compare

    try:
        comparison = compare(*(_result(file) for file in files))
    except (LookupError, TypeError, ValueError, AttributeError) as fault:
        raise DataFileError(
            f"{files[0]} and {files[1]} must be results of `lowfc latency --json`, but at least one is not: {fault!r}"
        ) from None
    return dict(zip("ab", map(str, files), strict=True)) | comparison


def _result(file: Path) -> dict[str, Any]:
    """The result of `lowfc latency --json` in a file; DataFileError if it has none."""
    expected = f"{file} must be a result of `lowfc latency --json`"
    with raised_as(DataFileError, OSError, f"{file} cannot be read"):
        content = input_file.read_whole(file, 1 << 28)
    with raised_as(DataFileError, (ValueError, RecursionError), f"{expected}, but is not JSON"):  # or not UTF-8
        result = json.loads(content)
    if not isinstance(result, dict) or "latency_us" not in result:
        raise DataFileError(f"{expected}, but has no latency_us")
    return result
