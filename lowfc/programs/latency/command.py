"""The command `lowfc latency`: how long a frame takes to become a command, on this host or in a log."""

import json
import os
import shlex
import sys
import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.terminal import ConfigFile, LogsIfAny, configuration
from lowfc.adapters.whole_file import require_folder, write_whole
from lowfc.contract.errors import ConfigurationError, DataFileError

if TYPE_CHECKING:
    from lowfc.contract.configuration import Configuration

_RATE_HZ = 1000.0
_LEAK = 0.01


class Camera(StrEnum):
    """Where the frames come from."""

    PREPARED = "prepared"
    SIMULATED = "simulated"


def latency(
    logs: LogsIfAny = None,
    duration: Annotated[float, typer.Option(min=0.5, max=1e5, help="Seconds of each repeat.")] = 10.0,
    rate: Annotated[float | None, typer.Option(help="Frames per second; default: the file's, or 1000.")] = None,
    free_running: Annotated[
        bool, typer.Option("--free-running", help="Without a schedule: the next frame as soon as a command is back.")
    ] = False,
    camera: Annotated[Camera, typer.Option(help="Frames made beforehand, or the simulated camera.")] = Camera.PREPARED,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Loop and yardsticks in turns, so often.")] = 1,
    record: Annotated[bool, typer.Option("--record/--no-record", help="With the recorder beside.")] = False,
    view: Annotated[bool, typer.Option("--view/--no-view", help="With a view served for a browser beside.")] = False,
    plain_scheduling: Annotated[
        bool,
        typer.Option("--plain-scheduling", help="Without real-time class, own processors, locked memory."),
    ] = False,
    config: ConfigFile = None,
    plot: Annotated[Path | None, typer.Option(help="Draw histograms and latency against time (PNG).")] = None,
    compare: Annotated[
        tuple[Path, Path] | None, typer.Option(help="Compare two results of --json.", metavar="A.json B.json")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")] = False,
) -> None:
    """Time every frame through the real controller and mirror, and set that against what this host can do.

    A source of frames made beforehand takes the camera's place: on an absolute schedule, late frames counted, so that a
    stall hides nothing. In turns with the loop, a bare zenoh echo of the same sizes, one control step alone and the
    host's timer are measured. Times are from just before a frame's put to just after its command's.

    Example: lowfc latency --duration 10 --repeats 5 --json > latency.json
    """
    if compare is not None:
        _compare(compare, as_json=as_json)
        return
    require_folder(plot)
    if plot is not None:
        from lowfc.adapters.drawing import figure_class

        figure_class()  # before the work, where it is not there
    if logs:
        figures = _of_log(logs)
    else:
        settings = _configuration(config, rate, camera, plain=plain_scheduling)
        if camera is Camera.SIMULATED and free_running:
            raise ConfigurationError("the simulated camera has a schedule: leave out --free-running or --camera")
        figures = _measure(settings, duration, repeats, camera, free_running=free_running, record=record, view=view)
    _say(figures, plot, as_json=as_json)


def _say(figures: dict[str, Any], plot: Path | None, *, as_json: bool) -> None:
    from lowfc.programs.latency.text import picture, table

    if plot is not None:
        write_whole(plot, picture(figures))
    sys.stdout.write((json.dumps(figures) if as_json else table(figures)) + "\n")


def _configuration(file: Path | None, rate: float | None, camera: Camera, *, plain: bool) -> "Configuration":
    """The loop's configuration: closed, in real time, and where nothing answers to the mirror with a leak."""
    from lowfc.adapters.realtime import spread

    overrides: dict[str, Any] = {"camera.rate_hz": rate, "lockstep": False}
    if camera is Camera.PREPARED:  # the integrator would add up noise without end
        overrides |= {"control.tilt_leak": _LEAK, "control.leak": _LEAK}
    if plain:
        overrides |= {"realtime.priority": 0, "realtime.lock_memory": False, "realtime.stay_awake": False}
        overrides |= {f"realtime.{role}_cpus": [] for role in ("camera", "controller", "mirror", "recorder")}
    apart = spread(os.sched_getaffinity(0), simulated=camera is Camera.SIMULATED)
    defaults = {"control.start_mode": "closed", "camera.rate_hz": _RATE_HZ, **apart}
    return configuration(file, overrides, defaults)


def _measure(
    settings: "Configuration",
    duration_s: float,
    repeats: int,
    camera: Camera,
    *,
    free_running: bool,
    record: bool,
    view: bool,
) -> dict[str, Any]:
    """Run the loop and what it is set against."""
    from rich.console import Console

    from lowfc.adapters.clock import sharpen_sleep
    from lowfc.adapters.progress import passing_bar
    from lowfc.adapters.provenance import provenance
    from lowfc.programs.latency.run import Asked, prepared, run_repeats
    from lowfc.programs.latency.summary import together

    sharpen_sleep()
    load = os.getloadavg()[0]
    begun = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    asked = Asked(settings, duration_s, repeats, free_running, camera is Camera.SIMULATED, record, view)
    with prepared(settings) as run, passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task("starting", total=1 + 2 * repeats)
        done = run_repeats(asked, run, lambda what: bar.update(task, description=what, advance=1))
    return together(done) | {
        "settings": {
            "rate_hz": settings.camera.rate_hz,
            "duration_s": duration_s,
            "repeats": repeats,
            "free_running": free_running,
            "camera": camera.value,
            "record": record,
            "view": view,
            "realtime": settings.realtime.model_dump(),
        },
        "logs": [log for one in done for log in one["logs"]],
        "messages_lost": sum(one["messages_lost"] for one in done) if record else None,
        "date": begun,
        "command": shlex.join(["lowfc", *sys.argv[1:]]),
        "host": provenance()
        | {
            "clock_source": _clock_source(),
            "load": load,
            "granted": done[-1]["granted"],
            "refused": done[-1]["refused"],
        },
    }


def _clock_source() -> str:
    from lowfc.adapters.host import Host

    try:
        return Host().clock_source()
    except OSError:
        return ""


def _of_log(names: list[Path]) -> dict[str, Any]:
    """The same figures of a log."""
    from rich.console import Console

    from lowfc.adapters.log_parts import the_one, titled
    from lowfc.adapters.progress import reading_bar
    from lowfc.programs.latency.log import log_figures
    from lowfc.programs.latency.summary import together

    log = the_one(names)
    with reading_bar(Console(stderr=True)) as bar:
        task = bar.add_task(f"reading {titled(log)}", total=None)
        figures, host = log_figures(log, lambda position, size: bar.update(task, completed=position, total=size))
    return together([figures]) | {"settings": {"log": str(log[0])}, "host": host}


def _compare(files: tuple[Path, Path], *, as_json: bool) -> None:
    """Say which of two results is better, and whether by more than the repeats differ."""
    from lowfc.programs.latency.summary import compare
    from lowfc.programs.latency.text import compared

    try:
        found = compare(*(_result(file) for file in files))
    except (KeyError, TypeError) as fault:
        raise DataFileError(
            f"{files[0]} and {files[1]} should be results of `lowfc latency --json`: {fault!r} is not there"
        ) from None
    names = [str(file) for file in files]
    said = json.dumps(dict(zip("ab", names, strict=True)) | found) if as_json else compared(found, names)
    sys.stdout.write(said + "\n")


def _result(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as fault:
        raise DataFileError(f"{file} cannot be read: {getattr(fault, 'strerror', None) or fault}") from None
    except json.JSONDecodeError as fault:
        raise DataFileError(f"{file} should be a result of `lowfc latency --json`, and is no JSON: {fault}") from None
    if not isinstance(found, dict) or "latency_us" not in found:
        raise DataFileError(f"{file} should be a result of `lowfc latency --json`, and has no latency_us")
    return found
